// Gates and filters of maps. References: small_components of dhtorch/geometry/components.py, _filter of
// dhtorch/pipeline/map_filters.py, _gate and _merge of dhtorch/pipeline/dense.py; the same results bit for bit, except for
// square roots, of which torch does not always give the nearest number. One thread, no gradient. The dispatch checks
// dtypes and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace {

using Mask = std::vector<uint8_t>;  // one byte a pixel, 0 or 1

// Mark in `small` (h, w) the pixels of `mask` whose component has fewer than n_pixels. right (h, w - 1) and down
// (h - 1, w): whether a pixel is connected to its right and its lower neighbour. Components are joined from runs, the
// connected pixels of a row.
template <typename Flag>
void mark_small(const Flag* mask, const Flag* right, const Flag* down, int64_t h, int64_t w, int64_t n_pixels, Flag* small) {
  struct Run {
    int64_t first, length;
    int32_t parent;
    int64_t size;  // pixels of the component, at its root
  };
  std::vector<Run> runs;
  const auto root = [&](int32_t i) {
    while (runs[i].parent != i) i = runs[i].parent = runs[runs[i].parent].parent;
    return i;
  };
  std::vector<int32_t> above(w, -1), here(w, -1);  // the run of each pixel of a row
  for (int64_t y = 0; y < h; ++y) {
    const Flag *row = mask + y * w, *across = right + y * (w - 1), *along = down + (y - 1) * w;
    for (int64_t x = 0; x < w; ++x) {
      small[y * w + x] = Flag{};
      here[x] = -1;
      if (!row[x]) continue;
      if (x == 0 || !row[x - 1] || !across[x - 1]) {
        const auto next = static_cast<int32_t>(runs.size());
        runs.push_back({y * w + x, 0, next, 0});
      }
      here[x] = static_cast<int32_t>(runs.size()) - 1;
      ++runs[here[x]].length;
      ++runs[here[x]].size;
    }
    for (int64_t x = 0; y > 0 && x < w; ++x) {
      if (here[x] < 0 || above[x] < 0 || !along[x]) continue;
      if (x > 0 && along[x - 1] && here[x] == here[x - 1] && above[x] == above[x - 1]) continue;
      const int32_t a = root(here[x]), b = root(above[x]);
      if (a == b) continue;
      runs[a].parent = b;
      runs[b].size += runs[a].size;
    }
    std::swap(above, here);
  }
  for (size_t i = 0; i < runs.size(); ++i) {
    if (runs[root(static_cast<int32_t>(i))].size < n_pixels) std::fill_n(small + runs[i].first, runs[i].length, Flag{1});
  }
}

// mask (B, h, w), right (B, h, w - 1) and down (B, h - 1, w) bool, as of mark_small. Output: small (B, h, w) bool.
void small_components(Tensor mask, Tensor right, Tensor down, Tensor small, int64_t n_pixels) {
  const int64_t B = mask.size(0), h = mask.size(1), w = mask.size(2), N = h * w;
  for (int64_t k = 0; k < B; ++k) {
    mark_small(data<bool>(mask) + N * k, data<bool>(right) + h * (w - 1) * k, data<bool>(down) + (h - 1) * w * k, h, w,
               n_pixels, data<bool>(small) + N * k);
  }
}

// x (h, w) with a margin of zeros.
inline std::vector<float> with_margin(const float* x, int64_t h, int64_t w, int64_t margin) {
  std::vector<float> out((h + 2 * margin) * (w + 2 * margin));
  for (int64_t y = 0; y < h; ++y) std::copy_n(x + y * w, w, out.begin() + (y + margin) * (w + 2 * margin) + margin);
  return out;
}

// Extreme by `pick` of the window around each pixel of x (h, w); beyond the border its pixels repeat. Computed from two
// windows half as wide, along rows and then along columns.
template <typename T, typename Pick>
std::vector<T> window_extreme(const std::vector<T>& x, int64_t h, int64_t w, int64_t radius, Pick pick) {
  const int64_t side = 2 * radius + 1, rows = h + 2 * radius;
  std::vector<T> padded(rows * w), row(w + 2 * radius);
  const auto widen = [&](T* at, int64_t length, int64_t stride) {
    for (int64_t width = 1; width < side;) {
      const int64_t shift = std::min(width, side - width);
      length -= shift;
#pragma GCC ivdep
      for (int64_t i = 0; i < length * stride; ++i) at[i] = pick(at[i], at[i + shift * stride]);
      width += shift;
    }
  };
  for (int64_t y = 0; y < h; ++y) {
    const T* from = x.data() + y * w;
    std::fill_n(row.begin(), radius, from[0]);
    std::copy_n(from, w, row.begin() + radius);
    std::fill_n(row.begin() + radius + w, radius, from[w - 1]);
    widen(row.data(), w + 2 * radius, 1);
    std::copy_n(row.begin(), w, padded.begin() + (y + radius) * w);
  }
  for (int64_t k = 0; k < radius; ++k) {
    std::copy_n(padded.begin() + radius * w, w, padded.begin() + k * w);
    std::copy_n(padded.begin() + (radius + h - 1) * w, w, padded.begin() + (radius + h + k) * w);
  }
  widen(padded.data(), rows, w);
  padded.resize(h * w);
  return padded;
}

// The fields of DenseOptions that the filters read.
struct Limits {
  int64_t halo_radius, background_radius, speck, hole_radius, max_gap, min_rim;
  float step_ratio, step_sigmas, grey_similarity, fattened_ratio, seam_sigmas_squared, seam_ratio, surface_ratio,
      surface_sigmas, rim_ratio, min_determinant, min_inverse_depth;
};

// The merged map in inverse depth (1/m), 0 where it is unanswered.
struct Map {
  int64_t h, w;
  std::vector<float> q, sigma;
  Mask usable, swept;  // a return; a swept depth and no return
  const bool* within;  // a return within the sensor's reach
  const float* grey;
  const Limits& limits;

  Mask answered() const {
    Mask out(h * w);
    for (int64_t n = 0; n < h * w; ++n) out[n] = usable[n] | swept[n];
    return out;
  }

  void silence(const Mask& which) {
    for (int64_t n = 0; n < h * w; ++n) {
      swept[n] = swept[n] & !which[n];
      q[n] = which[n] ? 0.0f : q[n];
      sigma[n] = which[n] ? 0.0f : sigma[n];
    }
  }

  // q where `of`, `elsewhere` in other places.
  template <typename Flag>
  std::vector<float> only(const Flag* of, float elsewhere = 0.0f) const {
    std::vector<float> out(h * w);
    for (int64_t n = 0; n < h * w; ++n) out[n] = of[n] ? q[n] : elsewhere;
    return out;
  }

  // Call visit(lane count, pixels, indices) for as many pixels `which` at a time as a vector has lanes: their indices in
  // the map, and those in a map with a margin of the halo's radius of the upper left pixels of their windows. Lanes
  // without a pixel repeat the last.
  template <typename Visit>
  void in_vectors(const Mask& which, Visit visit) const {
    const int64_t wide = w + 2 * limits.halo_radius;
    int64_t count = 0;
    Bits pixels = {}, first = {};
    for (int64_t n = 0; n <= h * w; ++n) {
      if (n < h * w) {
        if (!which[n]) continue;
        pixels[count] = static_cast<int32_t>(n);
        first[count] = static_cast<int32_t>(n / w * wide + n % w);
        if (++count < LANES) continue;
      }
      if (count == 0) continue;
      for (int64_t i = count; i < LANES; ++i) {
        pixels[i] = pixels[count - 1];
        first[i] = first[count - 1];
      }
      visit(count, pixels, first);
      count = 0;
    }
  }

  // Call visit(offset) for every second pixel of a window, row by row, until it returns true; as in_vectors counts.
  template <typename Visit>
  void window(Visit visit) const {
    const int64_t r = limits.halo_radius, wide = w + 2 * r;
    for (int64_t dy = 0; dy <= 2 * r; dy += 2) {
      for (int64_t dx = 0; dx <= 2 * r; dx += 2) {
        if (visit(static_cast<int32_t>(dy * wide + dx))) return;
      }
    }
  }

  // Pixels `which` with one of `of` (1/m, 0 = none) at their depth in the window.
  Mask has_neighbour(const Mask& which, const std::vector<float>& of) const {
    Mask out(h * w);
    const auto padded = with_margin(of.data(), h, w, limits.halo_radius);
    in_vectors(which, [&](int64_t count, Bits pixels, Bits first) {
      const Vector own = gather(q.data(), pixels), low = own / limits.step_ratio, high = own * limits.step_ratio;
      Bits met = {};
      window([&](int32_t offset) {
        const Vector other = gather(padded.data() + offset, first);
        met |= (other > low) & (other < high);
        int32_t all = -1;
        for (int64_t i = 0; i < LANES; ++i) all &= met[i];
        return all != 0;
      });
      for (int64_t i = 0; i < count; ++i) out[pixels[i]] = met[i] != 0;
    });
    return out;
  }

  // Pixels between two of the mask, one or two pixels wide, in their row or column.
  bool in_gap(const Mask& mask, int64_t y, int64_t x) const {
    const int64_t n = y * w + x;
    const bool left = x > 0 && mask[n - 1], right = x + 1 < w && mask[n + 1], above = y > 0 && mask[n - w],
               under = y + 1 < h && mask[n + w];
    return (right && (left || (x > 1 && mask[n - 2]))) || (left && x + 2 < w && mask[n + 2]) ||
           (under && (above || (y > 1 && mask[n - 2 * w]))) || (above && y + 2 < h && mask[n + 2 * w]);
  }

  // Swept pixels at the depth of returns within the reach beside them, without a return.
  Mask halo() const {
    const auto either = [](uint8_t a, uint8_t b) { return static_cast<uint8_t>(a | b); };
    Mask near = window_extreme(Mask(within, within + h * w), h, w, limits.halo_radius, either);
    for (int64_t n = 0; n < h * w; ++n) near[n] &= swept[n];
    Mask beside = has_neighbour(near, only(within)), others = swept;
    if (std::find(beside.begin(), beside.end(), 1) == beside.end()) return beside;
    for (int64_t n = 0; n < h * w; ++n) others[n] &= !beside[n];
    const auto farthest = farthest_swept(limits.background_radius);
    const Mask goes_on = has_neighbour(beside, only(others.data()));
    for (int64_t y = 0, n = 0; y < h; ++y) {
      for (int64_t x = 0; x < w; ++x, ++n) {
        if (beside[n]) beside[n] = farthest[n] * limits.step_ratio < q[n] || !(goes_on[n] || in_gap(usable, y, x));
      }
    }
    return beside;
  }

  std::vector<float> farthest_swept(int64_t radius) const {
    const auto less = [](float a, float b) { return a < b ? a : b; };
    return window_extreme(only(swept.data(), std::numeric_limits<float>::infinity()), h, w, radius, less);
  }

  // Swept pixels beside something farther, which they resemble more than their own surface.
  Mask fattened() const {
    const auto farthest = farthest_swept(limits.halo_radius);
    Mask edge(h * w);
    for (int64_t n = 0; n < h * w; ++n) {
      const float step = std::max(q[n] - q[n] / limits.step_ratio, limits.step_sigmas * sigma[n]);
      edge[n] = swept[n] & (q[n] - farthest[n] > step);
    }
    const auto depths = with_margin(q.data(), h, w, limits.halo_radius), shades = with_margin(grey, h, w, limits.halo_radius);
    in_vectors(edge, [&](int64_t count, Bits pixels, Bits first) {
      const Vector own = gather(q.data(), pixels), shade = gather(grey, pixels);
      Vector near = {}, far = {}, n_near = {}, n_far = {};
      window([&](int32_t offset) {
        const Vector other = gather(depths.data() + offset, first), scaled = other * limits.step_ratio,
                     differ = (gather(shades.data() + offset, first) - shade) / limits.grey_similarity,
                     alike = 1.0f / (1.0f + differ * differ);
        const Bits is_near = scaled > own, is_far = (other > 0.0f) & (scaled < own);
        near += is_near ? alike : Vector{};
        far += is_far ? alike : Vector{};
        n_near += is_near ? Vector{} + 1.0f : Vector{};
        n_far += is_far ? Vector{} + 1.0f : Vector{};
        return false;
      });
      const Bits resembles = far * n_near > limits.fattened_ratio * near * n_far;
      for (int64_t i = 0; i < count; ++i) edge[pixels[i]] = resembles[i] != 0;
    });
    return edge;
  }

  // Swept pixels within two pixels of a return, without an edge of the picture between, that are inconsistent with it.
  Mask torn() const {
    const auto differs = [&](int64_t n, int64_t m) {
      const float apart = std::fabs(q[n] - q[m]);
      return usable[m] && apart * apart > limits.seam_sigmas_squared * (sigma[n] * sigma[n] + sigma[m] * sigma[m]) &&
             std::max(q[n], q[m]) < limits.seam_ratio * std::min(q[n], q[m]) &&
             std::fabs(grey[n] - grey[m]) < limits.grey_similarity;
    };
    Mask out(h * w);
    if (std::find(usable.begin(), usable.end(), 1) == usable.end()) return out;
    for (int64_t y = 0, n = 0; y < h; ++y) {
      for (int64_t x = 0; x < w; ++x, ++n) {
        for (int64_t step = 1; step <= 2 && swept[n] && !out[n]; ++step) {
          out[n] = (x + step < w && differs(n, n + step)) || (x >= step && differs(n, n - step)) ||
                   (y + step < h && differs(n, n + step * w)) || (y >= step && differs(n, n - step * w));
        }
      }
    }
    return out;
  }

  // Swept pixels in lines one pixel wide, and in specks that remain without those.
  Mask unsupported() const {
    Mask mask = answered(), right(h * (w - 1)), down((h - 1) * w);
    const auto same = [&](int64_t n, int64_t m) {
      const float here = std::max(limits.surface_ratio * q[n], limits.surface_sigmas * sigma[n]),
                  there = std::max(limits.surface_ratio * q[m], limits.surface_sigmas * sigma[m]);
      return mask[n] & mask[m] & (std::fabs(q[m] - q[n]) <= std::min(there, here));
    };
    for (int64_t y = 0; y < h; ++y) {
      for (int64_t x = 0; x + 1 < w; ++x) right[y * (w - 1) + x] = same(y * w + x, y * w + x + 1);
    }
    for (int64_t n = 0; n + w < h * w; ++n) down[n] = same(n, n + w);
    Mask block(h * w), small(h * w);
    for (int64_t y = 0; y + 1 < h; ++y) {
      for (int64_t x = 0; x + 1 < w; ++x) {
        const int64_t n = y * w + x, r = y * (w - 1) + x;
        const uint8_t corner = right[r] & right[r + w - 1] & down[n] & down[n + 1];
        block[n] |= corner, block[n + 1] |= corner, block[n + w] |= corner, block[n + w + 1] |= corner;
      }
    }
    for (int64_t n = 0; n < h * w; ++n) mask[n] &= !(swept[n] & !block[n]);
    for (int64_t y = 0; y < h; ++y) {
      for (int64_t x = 0; x + 1 < w; ++x) right[y * (w - 1) + x] &= mask[y * w + x] & mask[y * w + x + 1];
    }
    for (int64_t n = 0; n + w < h * w; ++n) down[n] &= mask[n] & mask[n + w];
    mark_small(mask.data(), right.data(), down.data(), h, w, limits.speck, small.data());
    for (int64_t n = 0; n < h * w; ++n) small[n] = swept[n] & (!block[n] | small[n]);
    return small;
  }

  // Pixels with one of the mask within the radius on each of the four sides.
  Mask enclosed(const Mask& mask, int64_t radius) const {
    Mask out(h * w);
    std::vector<int32_t> above(w, -1), under(h * w), left(w);
    const auto far = static_cast<int32_t>(radius);
    const auto outside = std::numeric_limits<int32_t>::max() / 2;
    std::vector<int32_t> below(w, outside);
    for (int64_t y = h - 1; y >= 0; --y) {
      for (int64_t x = 0; x < w; ++x) {
        under[y * w + x] = below[x] - static_cast<int32_t>(y);
        below[x] = mask[y * w + x] ? static_cast<int32_t>(y) : below[x];
      }
    }
    std::fill(above.begin(), above.end(), -outside);
    for (int64_t y = 0; y < h; ++y) {
      const uint8_t* row = mask.data() + y * w;
      int32_t last = -outside, next = outside;
      for (int64_t x = 0; x < w; ++x) {
        left[x] = static_cast<int32_t>(x) - last;
        last = row[x] ? static_cast<int32_t>(x) : last;
      }
      for (int64_t x = w - 1; x >= 0; --x) {
        out[y * w + x] = (left[x] <= far) & (next - static_cast<int32_t>(x) <= far) &
                         (static_cast<int32_t>(y) - above[x] <= far) & (under[y * w + x] <= far);
        next = row[x] ? static_cast<int32_t>(x) : next;
        above[x] = row[x] ? static_cast<int32_t>(y) : above[x];
      }
    }
    return out;
  }

  // Pixels to fill from the plane of their rim, and its inverse depth and sigma there.
  struct Filled {
    Mask where;
    std::vector<float> q, sigma;
  };

  Filled fill() const {
    const Mask mask = answered();
    Mask open = enclosed(mask, limits.hole_radius);
    Filled out = {Mask(h * w), std::vector<float>(h * w), std::vector<float>(h * w)};
    Mask fits(h * w);
    for (int64_t y = 0, n = 0; y < h; ++y) {
      for (int64_t x = 0; x < w; ++x, ++n) {
        if (!mask[n] && (open[n] || in_gap(mask, y, x))) fits[n] = fit_rim(mask, y, x, &out.q[n], &out.sigma[n]);
      }
    }
    Mask both(h * w);
    for (int64_t y = 0, n = 0; y < h; ++y) {
      for (int64_t x = 0; x < w; ++x, ++n) {  // beside a pixel that stays unanswered it would be an island's edge
        const auto silent = [&](int64_t m) { return !mask[m] && !fits[m]; };
        out.where[n] = fits[n] && !(x + 1 < w && silent(n + 1)) && !(x > 0 && silent(n - 1)) &&
                       !(y + 1 < h && silent(n + w)) && !(y > 0 && silent(n - w));
        both[n] = mask[n] | out.where[n];
      }
    }
    const auto full = [&](int64_t n) { return both[n] && both[n + 1] && both[n + w] && both[n + w + 1]; };
    for (int64_t y = 0, n = 0; y < h; ++y) {
      for (int64_t x = 0; x < w; ++x, ++n) {
        if (!out.where[n]) continue;
        const bool left = x > 0, right = x + 1 < w, above = y > 0, under = y + 1 < h;
        out.where[n] = (right && under && full(n)) || (left && under && full(n - 1)) || (right && above && full(n - w)) ||
                       (left && above && full(n - w - 1));
      }
    }
    return out;
  }

  // Whether the rim of pixel (y, x), the answered pixels that are met first in eight directions, lies on one plane.
  bool fit_rim(const Mask& mask, int64_t y, int64_t x, float* depth, float* spread) const {
    constexpr int64_t STEPS[8][2] = {{0, 1}, {0, -1}, {1, 0}, {-1, 0}, {1, 1}, {-1, -1}, {1, -1}, {-1, 1}};
    float n = 0, sx = 0, sy = 0, xx = 0, xy = 0, yy = 0, sq = 0, xq = 0, yq = 0, noise = 0;
    float us[8] = {}, vs[8] = {}, met[8] = {}, values[8] = {};
    int64_t widths[8];
    bool refuted = false;
    for (int64_t i = 0; i < 8; ++i) {
      widths[i] = limits.max_gap + 1;
      for (int64_t k = 1; k <= limits.hole_radius; ++k) {
        const int64_t v = y + k * STEPS[i][0], u = x + k * STEPS[i][1], m = v * w + u;
        if (v < 0 || v >= h || u < 0 || u >= w) break;
        if (!mask[m]) continue;
        widths[i] = k;
        met[i] = 1.0f;
        us[i] = static_cast<float>(k * STEPS[i][1]);
        vs[i] = static_cast<float>(k * STEPS[i][0]);
        values[i] = q[m];
        noise += sigma[m];
        refuted |= within[m];
        break;
      }
      n += met[i], sx += us[i], sy += vs[i], sq += values[i];
      xx += us[i] * us[i], xy += us[i] * vs[i], yy += vs[i] * vs[i], xq += us[i] * values[i], yq += vs[i] * values[i];
    }
    int64_t narrowest = std::numeric_limits<int64_t>::max();
    for (int64_t i = 0; i < 8; i += 2) narrowest = std::min(narrowest, widths[i] + widths[i + 1] - 1);
    const float aa = xx * yy - xy * xy, ab = xy * sy - sx * yy, ac = sx * xy - xx * sy;
    const float bb = n * yy - sy * sy, bc = sx * sy - n * xy, cc = n * xx - sx * sx;
    const float det = n * aa + sx * ab + sy * ac;
    if (!(det > limits.min_determinant)) return false;
    const float scale = 1.0f / det, a = (aa * sq + ab * xq + ac * yq) * scale, b = (ab * sq + bb * xq + bc * yq) * scale,
                c = (ac * sq + bc * xq + cc * yq) * scale;
    const float count = std::max(n, 1.0f), own = noise / count;
    float farthest = 0, square = 0;
    for (int64_t i = 0; i < 8; ++i) {
      const float off = std::fabs(values[i] - (a * met[i] + b * us[i] + c * vs[i]));
      farthest = std::max(farthest, off);
      square += off * off;
    }
    *depth = a;
    *spread = own + std::sqrt(square / count);
    return !(refuted && narrowest > limits.max_gap) && n >= static_cast<float>(limits.min_rim) && a > limits.min_inverse_depth &&
           farthest <= std::max(limits.rim_ratio * a, limits.surface_sigmas * own);
  }
};

// The swept map (B, h, w) without the answers that its neighbours or the returns refute, and with those that they imply,
// in place: depth, sigma, score float32, source, gate int32. near_depth, near_sigma, grey (B, h, w) float32, usable and
// within bool: the returns, and those within the reach. The numbers are the fields of DenseOptions and the least determinant and
// inverse depth of the plane of a rim.
void filter_map(Tensor depth, Tensor sigma, Tensor score, Tensor source, Tensor gate, Tensor near_depth, Tensor near_sigma,
                Tensor usable, Tensor within, Tensor grey, int64_t halo_radius, int64_t background_radius, int64_t speck,
                int64_t hole_radius, int64_t max_gap, int64_t min_rim, double step_ratio, double step_sigmas,
                double grey_similarity, double fattened_ratio, double seam_sigmas, double seam_ratio, double surface_ratio,
                double surface_sigmas, double rim_ratio, double min_determinant, double min_inverse_depth) {
  const int64_t B = depth.size(0), h = depth.size(1), w = depth.size(2), N = h * w;
  const auto single = [](double x) { return static_cast<float>(x); };
  const Limits limits = {halo_radius, background_radius, speck, hole_radius, max_gap, min_rim, single(step_ratio),
                         single(step_sigmas), single(grey_similarity), single(fattened_ratio), single(seam_sigmas * seam_sigmas),
                         single(seam_ratio), single(surface_ratio), single(surface_sigmas), single(rim_ratio),
                         single(min_determinant), single(min_inverse_depth)};
  for (int64_t k = 0; k < B; ++k) {
    float *z = data<float>(depth) + N * k, *s = data<float>(sigma) + N * k, *certain = data<float>(score) + N * k;
    int32_t *kind = data<int32_t>(source) + N * k, *reason = data<int32_t>(gate) + N * k;
    const float *near = data<float>(near_depth) + N * k, *noise = data<float>(near_sigma) + N * k;
    const bool* returned = data<bool>(usable) + N * k;
    Map map = {h, w, std::vector<float>(N), std::vector<float>(N), Mask(returned, returned + N), Mask(N),
               data<bool>(within) + N * k, data<float>(grey) + N * k, limits};
    for (int64_t n = 0; n < N; ++n) {
      const bool keep = reason[n] == GATE_ANSWER && !returned[n], either = keep || returned[n];
      const float q = either ? 1.0f / (returned[n] ? near[n] : z[n]) : 0.0f;
      map.swept[n] = keep;
      map.q[n] = q;
      map.sigma[n] = either ? (returned[n] ? noise[n] : s[n]) * (q * q) : 0.0f;
    }
    const Mask before = map.swept;
    map.silence(map.halo());
    map.silence(map.fattened());
    map.silence(map.torn());
    map.silence(map.unsupported());
    const auto found = map.fill();
    for (int64_t n = 0; n < N; ++n) {
      if (found.where[n]) {
        const float at = 1.0f / found.q[n], relative = found.sigma[n] * at;
        z[n] = at;
        s[n] = found.sigma[n] * (at * at);
        certain[n] = 1.0f / (0.1f + relative) * 0.1f;
        kind[n] = SOURCE_FILLED;
        reason[n] = GATE_ANSWER;
      } else if (before[n] && !map.swept[n]) {
        z[n] = s[n] = std::numeric_limits<float>::quiet_NaN();
        certain[n] = 0.0f;
        kind[n] = SOURCE_NONE;
        reason[n] = GATE_UNCERTAIN;
      }
    }
  }
}

// Depth, sigma, score, source and gate of the pixels of a fitted surface, and their variances by cause (B, h, w); see
// _gate of dhtorch/pipeline/dense.py. q, own, shared, correlation float32, seen, known, beyond, alone bool (B, h, w),
// pair_gate int32 and scale_error float32 (B); near_depth, near_sigma float32, usable bool (B, h, w).
void gate_map(Tensor q, Tensor own, Tensor shared, Tensor correlation, Tensor seen, Tensor known, Tensor beyond, Tensor alone,
              Tensor pair_gate, Tensor scale_error, Tensor near_depth, Tensor near_sigma, Tensor usable, Tensor depth,
              Tensor sigma, Tensor score, Tensor source, Tensor gate, Tensor track, Tensor pose, Tensor reference,
              double min_correlation, double max_sigma_rel, double refuting_sigmas, double refuting_ratio,
              int64_t min_overlap, double min_inverse_depth) {
  const int64_t B = q.size(0), N = q.size(1) * q.size(2);
  const auto least = static_cast<float>(min_inverse_depth), fit = static_cast<float>(min_correlation),
             most = static_cast<float>(max_sigma_rel), sigmas = static_cast<float>(refuting_sigmas),
             ratio = static_cast<float>(refuting_ratio), nan = std::numeric_limits<float>::quiet_NaN();
  for (int64_t k = 0; k < B; ++k) {
    const int64_t first = N * k;
    const int32_t all = data<int32_t>(pair_gate)[k];
    const float scale = data<float>(scale_error)[k];
    const float *__restrict at = data<float>(q) + first, *__restrict mine = data<float>(own) + first,
                *__restrict common = data<float>(shared) + first, *__restrict alike = data<float>(correlation) + first,
                *__restrict near = data<float>(near_depth) + first, *__restrict noise = data<float>(near_sigma) + first;
    const bool *__restrict visible = data<bool>(seen) + first, *__restrict has_ray = data<bool>(known) + first,
               *__restrict nearer = data<bool>(beyond) + first, *__restrict unique = data<bool>(alone) + first,
               *__restrict returned = data<bool>(usable) + first;
    float *__restrict z = data<float>(depth) + first, *__restrict s = data<float>(sigma) + first,
          *__restrict certain = data<float>(score) + first, *__restrict by_track = data<float>(track) + first,
          *__restrict by_pose = data<float>(pose) + first, *__restrict by_sensor = data<float>(reference) + first;
    int32_t *__restrict kind = data<int32_t>(source) + first, *__restrict reason = data<int32_t>(gate) + first;
    int64_t overlap = 0, wrong = 0;
    for (int64_t n = 0; n < N; ++n) {
      const float far = 1.0f / (at[n] < least ? least : at[n]), relative = std::sqrt(mine[n] + common[n]) * far;
      const bool untracked = !has_ray[n] | !visible[n] | nearer[n] | (alike[n] < fit),
                 uncertain = !(relative <= most) | !unique[n];
      int32_t code = untracked ? GATE_NO_TRACK : uncertain ? GATE_UNCERTAIN : GATE_ANSWER;
      code = all != GATE_ANSWER ? all : code;
      const bool keep = code == GATE_ANSWER;
      const float steep = (far * far) * (far * far), deviation = keep ? relative * far : nan;
      const float moved = scale * (keep ? far : nan);
      z[n] = keep ? far : nan;
      certain[n] = keep ? 1.0f / (0.1f + relative) * 0.1f : 0.0f;
      kind[n] = keep ? SOURCE_SWEPT : 0;
      reason[n] = code;
      by_track[n] = mine[n] * steep;
      by_pose[n] = common[n] * steep;
      by_sensor[n] = moved * moved;
      const float error = std::fabs(far - near[n]), error_sigma = std::sqrt(deviation * deviation + noise[n] * noise[n]);
      const bool both = keep & returned[n];
      overlap += both;
      wrong += both & (error > sigmas * error_sigma) & (error > ratio * near[n]);
      s[n] = std::sqrt(deviation * deviation + by_sensor[n]);
    }
    if (overlap < min_overlap || 2 * wrong <= overlap) continue;
    for (int64_t n = 0; n < N; ++n) reason[n] = reason[n] == GATE_ANSWER ? GATE_CONTRADICTED : reason[n];
  }
}

// Returns where they are usable, else the answered pixels of a map (B, h, w), in place: depth, sigma, score, near_depth,
// near_sigma, confidence float32, source, gate int32, usable bool.
void merge_maps(Tensor depth, Tensor sigma, Tensor score, Tensor source, Tensor gate, Tensor near_depth, Tensor near_sigma,
                Tensor confidence, Tensor usable) {
  const int64_t N = depth.size(0) * depth.size(1) * depth.size(2);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  const bool* returned = data<bool>(usable);
  float *z = data<float>(depth), *s = data<float>(sigma), *certain = data<float>(score);
  int32_t *kind = data<int32_t>(source), *reason = data<int32_t>(gate);
  const float *near = data<float>(near_depth), *noise = data<float>(near_sigma), *trust = data<float>(confidence);
#pragma GCC ivdep
  for (int64_t n = 0; n < N; ++n) {
    const bool keep = reason[n] == GATE_ANSWER, sensed = returned[n];
    z[n] = sensed ? near[n] : keep ? z[n] : nan;
    s[n] = sensed ? noise[n] : keep ? s[n] : nan;
    certain[n] = sensed ? trust[n] : keep ? certain[n] : 0.0f;
    kind[n] = sensed ? SOURCE_SENSOR : keep ? kind[n] : SOURCE_NONE;
    reason[n] = sensed ? GATE_ANSWER : reason[n];
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def("small_components(Tensor mask, Tensor right, Tensor down, Tensor(a!) small, int n_pixels) -> ()");
  m.def(
      "filter_map(Tensor(a!) depth, Tensor(b!) sigma, Tensor(c!) score, Tensor(d!) source, Tensor(e!) gate, "
      "Tensor near_depth, Tensor near_sigma, Tensor usable, Tensor within, Tensor grey, int halo_radius, "
      "int background_radius, int speck, int hole_radius, int max_gap, int min_rim, float step_ratio, float step_sigmas, "
      "float grey_similarity, float fattened_ratio, float seam_sigmas, float seam_ratio, float surface_ratio, "
      "float surface_sigmas, float rim_ratio, float min_determinant, float min_inverse_depth) -> ()");
  m.def(
      "gate_map(Tensor q, Tensor own, Tensor shared, Tensor correlation, Tensor seen, Tensor known, Tensor beyond, "
      "Tensor alone, Tensor pair_gate, Tensor scale_error, Tensor near_depth, Tensor near_sigma, Tensor usable, "
      "Tensor(a!) depth, Tensor(b!) sigma, Tensor(c!) score, Tensor(d!) source, Tensor(e!) gate, Tensor(f!) track, "
      "Tensor(g!) pose, Tensor(h!) reference, float min_correlation, float max_sigma_rel, float refuting_sigmas, "
      "float refuting_ratio, int min_overlap, float min_inverse_depth) -> ()");
  m.def(
      "merge_maps(Tensor(a!) depth, Tensor(b!) sigma, Tensor(c!) score, Tensor(d!) source, Tensor(e!) gate, "
      "Tensor near_depth, Tensor near_sigma, Tensor confidence, Tensor usable) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("small_components", TORCH_BOX(&small_components));
  m.impl("filter_map", TORCH_BOX(&filter_map));
  m.impl("gate_map", TORCH_BOX(&gate_map));
  m.impl("merge_maps", TORCH_BOX(&merge_maps));
}
