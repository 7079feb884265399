// The Lucas-Kanade search from coarse to fine, one point after another on each level. Reference: search_displacements in
// dhtorch/geometry/lucas_kanade.py; the same cells, maps, steps and criteria. Sums over a window are taken in another order,
// so that displacements agree up to rounding; a point's result does not depend on the others. One thread, no gradient. The
// dispatch checks dtypes and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

constexpr int64_t MAX_NODES = 2 * MAX_MAP_RADIUS_PX + 2;  // along a side of the largest map
static_assert(MAX_NODES * MAX_NODES <= 64);               // one bit each

struct Level {
  const float* pixels;
  int64_t planes, rows, width, pad, margin;  // margin: pixels outside the image where a point may be

  Level(const Tensor& x, int64_t pad, int64_t margin)
      : pixels(data<float>(x)), planes(x.size(1)), rows(x.size(2)), width(x.size(3)), pad(pad), margin(margin) {}

  // The pixel left of (axis 0) or above (1) a position, on the level or in the margin around it.
  float corner(float place, int axis) const {
    const float most = static_cast<float>((axis ? rows : width) - 2 * pad - 1 + margin), least = static_cast<float>(-margin);
    const float whole = std::floor(place);
    return whole > least ? std::min(whole, most) : least;
  }
  const float* at(int64_t batch, int64_t plane, float u, float v, int64_t before) const {
    const int64_t column = static_cast<int64_t>(u) + pad - before, row = static_cast<int64_t>(v) + pad - before;
    return pixels + ((planes * batch + plane) * rows + row) * width + column;
  }
};

// Rows of one plane of a level from a window's first pixel on, read between pixels where `exactly`.
//
// Rows are read in whole vectors, past their end but not past the image's: a level has more padding than a window reaches.
template <bool exactly>
struct Rows {
  const float* from;
  int64_t width;
  float right;

  Vector at(int64_t i, int64_t j) const {
    const float* pixel = from + i * width + j;
    const Vector here = kept_in_register(load(pixel));
    return exactly ? fused(right, load(pixel + 1) - here, here) : here;
  }
};

// Bilinear value between two of its rows.
inline Vector between(Vector above, Vector below, float down) { return fused(down, below - above, above); }

// Columns of windows of `size` pixels as whole vectors: row length, and the lanes of the last vector within the window.
struct Columns {
  int64_t size, wide;
  Bits last;

  explicit Columns(int64_t size) : size(size), wide((size + LANES - 1) / LANES * LANES) {
    for (int64_t i = 0; i < LANES; ++i) last[i] = wide - LANES + i < size ? -1 : 0;
  }
  Bits kept(int64_t j) const { return j + LANES < wide ? ~Bits{} : last; }
};

inline Vector masked(Vector x, Bits kept) { return reinterpret_cast<Vector>(reinterpret_cast<Bits>(x) & kept); }

// The window of image 0 as three planes g_x, g_y, T of `size` rows, padded with zeros to whole vectors, after the
// normalisation; and sums over it: g T, A, T T.
struct Window : Columns {
  int64_t count;
  std::vector<Lanes> planes;
  float moments[6];

  explicit Window(int64_t size) : Columns(size), count(size * wide), planes(3 * count / LANES) {}

  float* plane(int64_t k) { return planes.front().of + k * count; }
  const float* plane(int64_t k) const { return planes.front().of + k * count; }

  // Products of g_x, g_y and T, summed over the window.
  struct Products {
    Vector of[6] = {};

    void add(Vector g_x, Vector g_y, Vector T) {
      of[0] = fused(g_x, T, of[0]);
      of[1] = fused(g_y, T, of[1]);
      of[2] = fused(g_x, g_x, of[2]);
      of[3] = fused(g_y, g_x, of[3]);
      of[4] = fused(g_y, g_y, of[4]);
      of[5] = fused(T, T, of[5]);
    }
    void sum(float* to) const {
      totals(of[0], of[1], of[2], of[3], to);
      to[4] = total(of[4]);
      to[5] = total(of[5]);
    }
  };

  // The window as it is, and its moments.
  template <bool exactly>
  void read(const Level& level, float x, float y, int64_t batch) {
    const float u = level.corner(x, 0), v = level.corner(y, 1), down = y - v;
    Rows<exactly> rows[3];
    for (int64_t k = 0; k < 3; ++k) rows[k] = {level.at(batch, (k + 1) % 3, u, v, size / 2), level.width, x - u};
    Products products;
    for (int64_t j = 0; j < wide; j += LANES) {
      const Bits inside = kept(j);
      Vector above[3];
      for (int64_t k = 0; k < 3; ++k) above[k] = rows[k].at(0, j);
      float* to = plane(0) + j;
      for (int64_t i = 0; i < size; ++i, to += wide) {
        Vector here[3];
        for (int64_t k = 0; k < 3; ++k) {
          const Vector below = rows[k].at(exactly ? i + 1 : i, j);
          here[k] = masked(exactly ? between(above[k], below, down) : below, inside);
          above[k] = below;
          store(here[k], to + k * count);
        }
        products.add(here[0], here[1], here[2]);
      }
    }
    products.sum(moments);
  }

  // Subtract from each plane what `change` says of its values; and the moments of the result.
  template <typename Change>
  void subtract(const Change& change) {
    Products products;
    for (int64_t j = 0; j < wide; j += LANES) {
      const Bits inside = kept(j);
      for (float* at = plane(0) + j; at < plane(1); at += wide) {
        Vector here[3] = {load(at), load(at + count), load(at + 2 * count)};
        change(here);
        for (int64_t k = 0; k < 3; ++k) {
          here[k] = masked(here[k], inside);
          store(here[k], at + k * count);
        }
        products.add(here[0], here[1], here[2]);
      }
    }
    products.sum(moments);
  }

  void project(bool remove_bias, bool estimate_gain) {
    if (remove_bias) {
      float mean[3];
      for (int64_t k = 0; k < 3; ++k) {
        Vector sum = {};
        for (int64_t i = 0; i < count; i += LANES) sum += load(plane(k) + i);
        mean[k] = total(sum) / static_cast<float>(size * size);
      }
      subtract([&](Vector* here) {
        for (int64_t k = 0; k < 3; ++k) here[k] -= mean[k];
      });
    }
    if (estimate_gain) {
      const float energy = moments[5], by = energy > 0.0f ? energy : 1.0f, slope[2] = {moments[0] / by, moments[1] / by};
      subtract([&](Vector* here) {
        for (int64_t k = 0; k < 2; ++k) here[k] -= slope[k] * here[2];
      });
      moments[5] = energy;
    }
  }
};

// The correlation map of one point: the window's K planes correlated with J (rows of `stride` pixels) at n x n offsets from
// the target's pixel `corner`, as Gauss-Newton steps. Only a few nodes are read, so each is computed on first use.
template <int K>
struct Map {
  const Window& window;
  const float *inverse, *moments, *J;
  int64_t stride, n;
  float corner[2];
  uint64_t known;  // one bit per node
  float field[K][MAX_NODES * MAX_NODES];  // of known nodes, in rows of MAX_NODES
  float cell[2], around[4][K];  // the position and the field of the first of four nodes, and of the others

  Map(const Window& window, const float* inverse)
      : window(window), inverse(inverse), moments(window.moments), J(nullptr), stride(0), n(0), corner{}, known(0) {}

  // Begin a map at another corner. A node of the map before that lies on it stays known.
  void begin(const float* first, int64_t nodes) {
    const int64_t right = static_cast<int64_t>(first[0] - corner[0]), down = static_cast<int64_t>(first[1] - corner[1]);
    float before[K][MAX_NODES * MAX_NODES];
    if (known) std::memcpy(before, field, sizeof(field));
    uint64_t left = known;
    known = 0;
    for (; left; left &= left - 1) {
      const int64_t node = __builtin_ctzll(left), row = node / MAX_NODES - down, column = node % MAX_NODES - right;
      if (row < 0 || row >= nodes || column < 0 || column >= nodes) continue;
      const int64_t to = row * MAX_NODES + column;
      for (int k = 0; k < K; ++k) field[k][to] = before[k][node];
      known |= uint64_t{1} << to;
    }
    n = nodes;
    std::copy_n(first, 2, corner);
    cell[0] = NAN;
  }

  // R x M nodes (R at most 2), the first at row v and column u. A row of J is multiplied by the window's row for the first
  // row of nodes and by the one above it for the second. Few nodes have several sums, which do not wait for each other.
  template <int R, int M>
  void correlate(int64_t v, int64_t u) {
    constexpr int COUNT = K * R * M, CHAINS = COUNT > 4 ? 1 : 8 / COUNT;
    Vector sums[CHAINS][COUNT] = {};
    for (int64_t j = 0; j < window.wide; j += LANES) {
      const float *own = window.plane(0) + j, *there = J + v * stride + j + u;
      Vector above[K] = {};
      const auto row = [&](int chain) {
        Vector rows[K], pixels[M];
        for (int k = 0; k < K; ++k) rows[k] = load(own + k * window.count);
        for (int m = 0; m < M; ++m) pixels[m] = load(there + m);
        for (int m = 0; m < M; ++m) {
          for (int k = 0; k < K; ++k) sums[chain][k * R * M + m] = fused(rows[k], pixels[m], sums[chain][k * R * M + m]);
          if constexpr (R == 2) {
            for (int k = 0; k < K; ++k) sums[chain][(k * R + 1) * M + m] = fused(above[k], pixels[m], sums[chain][(k * R + 1) * M + m]);
          }
        }
        for (int k = 0; k < K; ++k) above[k] = rows[k];
        own += window.wide;
        there += stride;
      };
      int64_t i = 0;
      for (; i + CHAINS <= window.size; i += CHAINS) {
        for (int chain = 0; chain < CHAINS; ++chain) row(chain);
      }
      for (; i < window.size; ++i) row(0);
      if constexpr (R == 2) {
        for (int m = 0; m < M; ++m) {
          const Vector pixels = load(there + m);
          for (int k = 0; k < K; ++k) sums[0][(k * R + 1) * M + m] = fused(above[k], pixels, sums[0][(k * R + 1) * M + m]);
        }
      }
    }
    Vector all[(COUNT + 3) / 4 * 4] = {};
    float C[(COUNT + 3) / 4 * 4];
    for (int k = 0; k < COUNT; ++k) {
      all[k] = sums[0][k];
      for (int chain = 1; chain < CHAINS; ++chain) all[k] += sums[chain][k];
    }
    for (int k = 0; k < COUNT; k += 4) totals(all[k], all[k + 1], all[k + 2], all[k + 3], C + k);
    for (int r = 0; r < R; ++r) {
      for (int m = 0; m < M; ++m) {
        float node[K];
        for (int k = 0; k < K; ++k) node[k] = C[(k * R + r) * M + m];
        put((v + r) * MAX_NODES + u + m, node);
      }
    }
  }

  void put(int64_t node, const float* C) {
    const float a = C[0] - moments[0], b = C[1] - moments[1];
    field[0][node] = inverse[0] * a + inverse[1] * b;
    field[1][node] = inverse[1] * a + inverse[2] * b;
    if constexpr (K == 3) field[2][node] = moments[5] > 0.0f ? C[2] / moments[5] : 1.0f;
    known |= uint64_t{1} << node;
  }

  // Four nodes, the first at row v and column u: those that are unknown, one or two of a row or column, else all.
  void ensure_four(int64_t v, int64_t u) {
    const uint64_t at = known >> (v * MAX_NODES + u), below = at >> MAX_NODES;
    const uint64_t have = (at & 3) | (below & 3) << 2;
    if (have == 15) return;
    if (have == 3) return correlate<1, 2>(v + 1, u);
    if (have == 12) return correlate<1, 2>(v, u);
    if (have == 5) return correlate<2, 1>(v, u + 1);
    if (have == 10) return correlate<2, 1>(v, u);
    if (have == 14) return correlate<1, 1>(v, u);
    if (have == 13) return correlate<1, 1>(v, u + 1);
    if (have == 11) return correlate<1, 1>(v + 1, u);
    if (have == 7) return correlate<1, 1>(v + 1, u + 1);
    correlate<2, 2>(v, u);
  }

  // Bilinear interpolation of the field, which is zero beyond its border.
  void interpolate(const float* p, float* found) {
    const float u = std::floor(p[0]), v = std::floor(p[1]), last = static_cast<float>(n - 1);
    if (!(u == cell[0] && v == cell[1])) {  // most steps stay between the same nodes
      if (!(u >= 0.0f && v >= 0.0f && u < last && v < last)) return interpolate_border(p, u, v, found);
      const int64_t column = static_cast<int64_t>(u), row = static_cast<int64_t>(v), node = row * MAX_NODES + column;
      ensure_four(row, column);
      for (int k = 0; k < K; ++k) {
        around[0][k] = field[k][node];
        around[1][k] = field[k][node + 1];
        around[2][k] = field[k][node + MAX_NODES];
        around[3][k] = field[k][node + MAX_NODES + 1];
      }
      cell[0] = u;
      cell[1] = v;
    }
    const float right = p[0] - cell[0], down = p[1] - cell[1], left = 1.0f - right, up = 1.0f - down;
    for (int k = 0; k < K; ++k) {
      found[k] = (around[0][k] * left + around[1][k] * right) * up + (around[2][k] * left + around[3][k] * right) * down;
    }
  }

  void interpolate_border(const float* p, float u, float v, float* found) {
    std::fill_n(found, K, 0.0f);
    if (!(u >= -1.0f && v >= -1.0f && u < static_cast<float>(n) && v < static_cast<float>(n))) return;
    const int64_t column = static_cast<int64_t>(u), row = static_cast<int64_t>(v);
    const int64_t first[2] = {std::max<int64_t>(column, 0), std::max<int64_t>(row, 0)};
    const int64_t last[2] = {std::min(column + 1, n - 1), std::min(row + 1, n - 1)};
    for (int64_t i = first[1]; i <= last[1]; ++i) {
      for (int64_t j = first[0]; j <= last[0]; ++j) {
        const int64_t node = i * MAX_NODES + j;
        if (!(known >> node & 1)) correlate<1, 1>(i, j);
        const float weight = (1.0f - std::abs(p[0] - static_cast<float>(j))) * (1.0f - std::abs(p[1] - static_cast<float>(i)));
        for (int k = 0; k < K; ++k) found[k] += field[k][node] * weight;
      }
    }
  }
};

struct Options {
  int64_t iterations, steps_per_map;
  float epsilon;
  double min_eigenvalue;  // of A, summed over the window
  float min_gain, max_gain;
  bool extrapolate;  // on the finest level: Aitken's step, and its limits
  int64_t aitken_step;
  float min_ratio, max_ratio;
  float low[2], high[2];  // bounds of the points

  bool within(const float* x) const {
    return x[0] >= low[0] && x[0] <= high[0] && x[1] >= low[1] && x[1] <= high[1];
  }
};

// Inverse of A = ((a, b), (b, c)), zero where its smaller eigenvalue is not above the limit; returns whether it is.
bool invert(const float* A, double least, float* inverse) {
  const double a = A[0], b = A[1], c = A[2], half = (a - c) / 2, square = half * half + b * b;
  const bool textured = (a + c) / 2 - std::sqrt(square) > least;
  const double det = a * c - b * b;
  inverse[0] = textured ? static_cast<float>(c / det) : 0.0f;
  inverse[1] = textured ? static_cast<float>(-b / det) : 0.0f;
  inverse[2] = textured ? static_cast<float>(a / det) : 0.0f;
  return textured;
}

struct State {
  float d[2];
  bool live, held;
};

// Gauss-Newton steps of one point on a map.
template <int K>
void walk(Map<K>& map, const float* x, int64_t steps, const Options& o, State& s) {
  const float* corner = map.corner;
  const float start[2] = {x[0] + s.d[0] - corner[0], x[1] + s.d[1] - corner[1]};
  float p[2] = {start[0], start[1]}, step[2] = {0.0f, 0.0f}, square = 0.0f;
  for (int64_t k = 1; s.live && k <= steps; ++k) {
    const float last[2] = {step[0], step[1]};
    float found[K];
    map.interpolate(p, found);
    const float gain = K == 3 ? std::clamp(found[K - 1], o.min_gain, o.max_gain) : 1.0f;
    step[0] = found[0] / gain;
    step[1] = found[1] / gain;
    square = step[0] * step[0] + step[1] * step[1];
    if (k == o.aitken_step && k < steps && o.extrapolate && square > o.epsilon * o.epsilon) {
      const float before = std::max(last[0] * last[0] + last[1] * last[1], o.epsilon * o.epsilon);
      const float ratio = (step[0] * last[0] + step[1] * last[1]) / before;
      for (float& part : step) part /= 1.0f - std::clamp(ratio, o.min_ratio, o.max_ratio);
      square = step[0] * step[0] + step[1] * step[1];
    }
    p[0] -= step[0];
    p[1] -= step[1];
  }
  if (!std::isfinite(p[0]) || !std::isfinite(p[1])) std::copy_n(start, 2, p);
  const float side = static_cast<float>(map.n - 1);
  s.held = p[0] >= 0.0f && p[0] <= side && p[1] >= 0.0f && p[1] <= side;
  const float place[2] = {p[0] + corner[0], p[1] + corner[1]};
  s.live = s.live && (!s.held || square > o.epsilon * o.epsilon) && o.within(place);
  for (int axis = 0; axis < 2; ++axis) s.d[axis] = place[axis] - x[axis];
}

// Whether rows are finite, in whole vectors.
bool finite(const float* from, int64_t stride, int64_t rows, int64_t columns) {
  Vector nothing = {};
  for (int64_t i = 0; i < rows; ++i) {
    for (int64_t j = 0; j < columns; j += LANES) nothing += 0.0f * load(from + i * stride + j);
  }
  return total(nothing) == 0.0f;
}

// The other image: its level, and which of its pictures are known to be finite, so that no patch of them is tested.
struct Target {
  Level level;
  std::vector<float> patch;  // a patch without what is beside it
  std::vector<bool> clean;

  Target(const Level& level, int64_t batch, int64_t points, const Columns& window)
      : level(level), patch((window.size + MAX_NODES) * (window.wide + LANES)), clean(batch) {
    const int64_t pixels = level.rows * level.width;
    if (points * static_cast<int64_t>(patch.size()) < batch * pixels) return;  // few points: their patches are less to test
    for (int64_t b = 0; b < batch; ++b) {
      const float* first = level.pixels + b * level.planes * pixels;
      clean[b] = finite(first, 0, 1, pixels - LANES + 1) && finite(first + pixels - LANES, 0, 1, LANES);
    }
  }
};

// One map of radius (n - 2) / 2 around a point's position, and the steps on it.
template <int K>
void on_map(Map<K>& map, Target& target, int64_t batch, int64_t n, const float* x, int64_t steps, const Options& o, State& s) {
  const Level& level = target.level;
  const Window& window = map.window;
  const float radius = static_cast<float>((n - 2) / 2);
  const float corner[2] = {level.corner(x[0] + s.d[0], 0) - radius, level.corner(x[1] + s.d[1], 1) - radius};
  const int64_t side = window.size + n - 1, stride = window.wide + LANES;
  map.begin(corner, n);
  map.J = level.at(batch, 0, corner[0], corner[1], window.size / 2);
  map.stride = level.width;
  if (s.live && !target.clean[batch] && !finite(map.J, map.stride, side, stride)) {  // perhaps only beside the patch
    float* patch = target.patch.data();
    for (int64_t i = 0; i < side; ++i) {
      std::fill_n(std::copy_n(map.J + i * map.stride, side, patch + i * stride), stride - side, 0.0f);
    }
    map.J = patch;
    map.stride = stride;
    if (!finite(map.J, map.stride, side, stride)) {  // no step across NaN, as in torch
      for (auto& plane : map.field) std::fill(std::begin(plane), std::end(plane), NAN);
      map.known = ~uint64_t{0};
    }
  }
  walk<K>(map, x, steps, o, s);
}

template <int K>
void search_point(const Window& window, const float* inverse, Target& target, int64_t batch, const float* x,
                  const int64_t* radii, int64_t maps, const Options& o, State& s) {
  Map<K> map(window, inverse);
  for (int64_t k = 0; k < maps; ++k) {
    const int64_t steps = std::min(o.steps_per_map, o.iterations - k * o.steps_per_map);
    if (k && (steps <= 0 || !s.live)) return;
    on_map<K>(map, target, batch, 2 * radii[k] + 2, x, steps, o, s);
  }
}

// A point and its displacement, px of a level, its image, and what the search on a level says of it.
struct Point {
  float x[2], d[2];
  int64_t batch;
  bool known, held, textured;
  float A[3];
};

struct Search {
  std::vector<Level> source, target;
  int64_t window, images;
  bool remove_bias, estimate_gain;
  Options finest, coarse;
  std::vector<int64_t> top_radii, middle_radii, finest_radii;
  int64_t near_levels, cell_px, cell_level;  // cell_level: the finest one with cells
  float scale(int64_t level) const { return std::ldexp(1.0f, static_cast<int>(-level)); }
  int64_t top() const { return static_cast<int64_t>(std::min(source.size(), target.size())) - 1; }

  // Height (axis 1) or width of an image.
  int64_t size(const Level& level, int axis) const { return (axis ? level.rows : level.width) - 2 * level.pad; }

  // Search on one level, from and to displacements there.
  template <bool exactly>
  void on_level(int64_t level, std::vector<Point>& points, const std::vector<int64_t>& radii, Options o) const {
    for (int axis = 0; axis < 2; ++axis) {
      const float margin = level ? static_cast<float>(target[0].margin) : 0.0f;
      o.low[axis] = -0.5f * scale(level) - margin;
      o.high[axis] = (static_cast<float>(size(target[0], axis)) - 0.5f) * scale(level) + margin;
    }
    const int64_t maps = static_cast<int64_t>(radii.size());
    Window own(window);
    Target there(target[level], images, static_cast<int64_t>(points.size()), own);
    for (Point& point : points) {
      State s{{point.d[0], point.d[1]}, point.known, false};
      own.read<exactly>(source[level], point.x[0], point.x[1], point.batch);
      own.project(remove_bias, estimate_gain);
      float inverse[3];
      point.textured = invert(own.moments + 2, o.min_eigenvalue, inverse);
      const float begun[2] = {point.x[0] + s.d[0], point.x[1] + s.d[1]};
      s.live = s.live && point.textured && o.within(begun);
      if (estimate_gain) {
        search_point<3>(own, inverse, there, point.batch, point.x, radii.data(), maps, o, s);
      } else {
        search_point<2>(own, inverse, there, point.batch, point.x, radii.data(), maps, o, s);
      }
      std::copy_n(s.d, 2, point.d);
      std::copy_n(own.moments + 2, 3, point.A);
      point.held = s.held;
    }
    if (exactly) {
      for (Point& point : points) {
        const float end[2] = {point.x[0] + point.d[0], point.x[1] + point.d[1]};
        point.held = point.held && o.within(end);
      }
    }
  }

  // Displacements (px of the finest level) -> those on `level` that the coarser levels lead to. Points that have `begun`
  // skip the levels that are not near.
  void start(int64_t level, std::vector<Point>& points, const bool* begun, bool alike) const {
    if (level < top() && begun && level + 1 >= near_levels) {
      std::vector<Point> cold;
      for (size_t i = 0; i < points.size(); ++i) {
        if (!begun[i]) cold.push_back(points[i]);
      }
      start(level, cold, nullptr, alike);
      for (size_t i = 0, k = 0; i < points.size(); ++i) {
        for (int axis = 0; axis < 2; ++axis) points[i].d[axis] = begun[i] ? points[i].d[axis] * scale(level) : cold[k].d[axis];
        k += !begun[i];
      }
      return;
    }
    if (level == top()) {
      for (Point& point : points) {
        for (float& d : point.d) d *= scale(level);
      }
    } else if (alike && level + 1 >= cell_level) {
      by_cell(level + 1, points);
    } else {
      coarser(level + 1, points, begun, alike);
    }
  }

  // The displacement on `level`, twice as long.
  void coarser(int64_t level, std::vector<Point>& points, const bool* begun, bool alike) const {
    std::vector<Point> here = points;
    start(level, here, begun, alike);
    for (Point& point : here) {  // interpolated on the finest level only
      for (int axis = 0; axis < 2; ++axis) point.x[axis] = source[level].corner(point.x[axis] * scale(level) + 0.5f, axis);
      point.known = true;
    }
    on_level<false>(level, here, level == top() || level + 1 == near_levels ? top_radii : middle_radii, coarse);
    for (size_t i = 0; i < points.size(); ++i) {
      for (int axis = 0; axis < 2; ++axis) points[i].d[axis] = here[i].d[axis] * 2.0f;
    }
  }

  // The same at the centre of each point's cell; all points have the same displacement.
  void by_cell(int64_t level, std::vector<Point>& points) const {
    const int64_t side = cell_px << level, columns = (size(source[0], 0) + side - 1) / side, rows = (size(source[0], 1) + side - 1) / side;
    const float across = static_cast<float>(side);
    std::vector<int64_t> index(images * rows * columns, -1), of;
    std::vector<Point> cells;
    for (const Point& point : points) {
      int64_t cell[2];
      for (int axis = 0; axis < 2; ++axis) {
        cell[axis] = std::clamp<int64_t>(static_cast<int64_t>((point.x[axis] + 0.5f) / across), 0, (axis ? rows : columns) - 1);
      }
      int64_t& place = index[(point.batch * rows + cell[1]) * columns + cell[0]];
      if (place < 0) {
        place = static_cast<int64_t>(cells.size());
        Point centre = point;
        for (int axis = 0; axis < 2; ++axis) {
          centre.x[axis] = std::min((static_cast<float>(cell[axis]) + 0.5f) * across, static_cast<float>(size(source[0], axis)) - 1.0f);
        }
        cells.push_back(centre);
      }
      of.push_back(place);
    }
    coarser(level, cells, nullptr, true);
    for (size_t i = 0; i < points.size(); ++i) std::copy_n(cells[of[i]].d, 2, points[i].d);
  }
};

// source (B, 3, ., .) and target (B, 1 or 3, ., .): levels, finest first; x and d (2, M) px of the finest, float32; batch (M)
// int64; known and begun (M) bool: points to search for, and those that skip the levels from `near_levels` on. Radii of the
// maps, at most MAX_MAP_RADIUS_PX. Outputs: found (2, M) displacement and A (3, M) float32, valid (M) bool.
void lk_search(std::vector<Tensor> source, std::vector<Tensor> target, Tensor x, Tensor d, Tensor batch, Tensor known,
               Tensor begun, Tensor found, Tensor A, Tensor valid, std::vector<int64_t> top_radii,
               std::vector<int64_t> middle_radii, std::vector<int64_t> finest_radii, int64_t near_levels, bool alike,
               int64_t cell_px, int64_t cell_level, int64_t window, int64_t iterations, int64_t steps_per_map, int64_t pad,
               int64_t margin, bool remove_bias, bool estimate_gain, double epsilon, double coarse_epsilon,
               double min_eigenvalue, double min_gain, double max_gain, int64_t aitken_step, double min_ratio,
               double max_ratio) {
  const Options finest{iterations, steps_per_map, static_cast<float>(epsilon), min_eigenvalue * static_cast<double>(window * window),
                       static_cast<float>(min_gain), static_cast<float>(max_gain), true, aitken_step,
                       static_cast<float>(min_ratio), static_cast<float>(max_ratio), {}, {}};
  Options coarse = finest;
  coarse.epsilon = static_cast<float>(coarse_epsilon);
  coarse.extrapolate = false;
  Search search{{}, {}, window, source[0].size(0), remove_bias, estimate_gain, finest, coarse, top_radii, middle_radii,
                finest_radii, near_levels, cell_px, cell_level};
  for (const Tensor& level : source) search.source.emplace_back(level, pad, margin);
  for (const Tensor& level : target) search.target.emplace_back(level, pad, margin);
  const int64_t M = x.size(1);
  const float *places = data<float>(x), *starts = data<float>(d);
  const int64_t* pairs = data<int64_t>(batch);
  const bool* wanted = data<bool>(known);
  std::vector<Point> points(M);
  for (int64_t m = 0; m < M; ++m) {
    points[m] = {{places[m], places[M + m]}, {starts[m], starts[M + m]}, pairs[m], wanted[m], false, false, {}};
  }
  search.start(0, points, data<bool>(begun), alike);
  search.on_level<true>(0, points, search.top() ? finest_radii : top_radii, finest);
  float *to = data<float>(found), *normal = data<float>(A);
  bool* good = data<bool>(valid);
  for (int64_t m = 0; m < M; ++m) {
    for (int axis = 0; axis < 2; ++axis) to[axis * M + m] = points[m].d[axis];
    for (int k = 0; k < 3; ++k) normal[k * M + m] = points[m].A[k];
    good[m] = points[m].known && points[m].textured && points[m].held;
  }
}

// A window between pixels in rows of whole vectors, padded with zeros; returns its sum.
float read_plane(const Level& level, const Columns& columns, const float* x, int64_t batch, float* to) {
  const float u = level.corner(x[0], 0), v = level.corner(x[1], 1), down = x[1] - v;
  const Rows<true> rows{level.at(batch, 0, u, v, columns.size / 2), level.width, x[0] - u};
  Vector sum = {};
  for (int64_t j = 0; j < columns.wide; j += LANES) {
    Vector above = rows.at(0, j);
    for (int64_t i = 0; i < columns.size; ++i) {
      const Vector below = rows.at(i + 1, j), here = masked(between(above, below, down), columns.kept(j));
      store(here, to + i * columns.wide + j);
      sum += here;
      above = below;
    }
  }
  return total(sum);
}

// source and target (B, ., ., .), x and y (2, M) positions on them, float32; batch (M) int64. Output: sums (M) of squared
// differences of the windows at x and y, after the normalisation; window² where it is not finite.
void window_differences(Tensor source, Tensor target, Tensor x, Tensor y, Tensor batch, Tensor sums, int64_t window,
                        int64_t pad, int64_t margin, bool remove_bias, bool estimate_gain, double min_gain,
                        double max_gain) {
  const Level here(source, pad, margin), there(target, pad, margin);
  const Columns columns(window);
  const int64_t M = x.size(1), count = window * columns.wide;
  const float *places = data<float>(x), *others = data<float>(y), size = static_cast<float>(window * window);
  const int64_t* pairs = data<int64_t>(batch);
  float* to = data<float>(sums);
  std::vector<Lanes> planes(2 * count / LANES);
  float *T = planes.front().of, *J = T + count;
  for (int64_t m = 0; m < M; ++m) {
    const float from[2] = {places[m], places[M + m]}, at[2] = {others[m], others[M + m]};
    const float sum = read_plane(here, columns, from, pairs[m], T), other = read_plane(there, columns, at, pairs[m], J);
    const float mean = remove_bias ? sum / size : 0.0f, other_mean = remove_bias ? other / size : 0.0f;
    const auto each = [&](const auto& take) {  // T and J without their means
      for (int64_t i = 0; i < count; i += columns.wide) {
        for (int64_t j = 0; j < columns.wide; j += LANES) {
          const Bits inside = columns.kept(j);
          take(masked(load(T + i + j) - mean, inside), masked(load(J + i + j) - other_mean, inside));
        }
      }
    };
    Vector squares = {}, product = {}, energy = {};
    float by = 1.0f;
    if (estimate_gain) {
      each([&](Vector t, Vector j) {
        product = fused(t, j, product);
        energy = fused(t, t, energy);
      });
      const float all = total(energy), gain = all > 0.0f ? total(product) / all : 1.0f;
      by = 1.0f / std::clamp(gain, static_cast<float>(min_gain), static_cast<float>(max_gain));
    }
    each([&](Vector t, Vector j) {
      const Vector rest = fused(by, j, -t);
      squares = fused(rest, rest, squares);
    });
    const float all = total(squares);
    to[m] = std::isfinite(all) ? all : size;
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "lk_search(Tensor[] source, Tensor[] target, Tensor x, Tensor d, Tensor batch, Tensor known, Tensor begun, "
      "Tensor(a!) found, Tensor(b!) A, Tensor(c!) valid, int[] top_radii, int[] middle_radii, int[] finest_radii, "
      "int near_levels, bool alike, int cell_px, int cell_level, int window, int iterations, int steps_per_map, int pad, "
      "int margin, bool remove_bias, bool estimate_gain, float epsilon, float coarse_epsilon, float min_eigenvalue, "
      "float min_gain, float max_gain, int aitken_step, float min_ratio, float max_ratio) -> ()");
  m.def(
      "window_differences(Tensor source, Tensor target, Tensor x, Tensor y, Tensor batch, Tensor(a!) sums, int window, int pad, "
      "int margin, bool remove_bias, bool estimate_gain, float min_gain, float max_gain) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("lk_search", TORCH_BOX(&lk_search));
  m.impl("window_differences", TORCH_BOX(&window_differences));
}
