// Fitting a swept surface to another view. References: dhtorch/geometry/plane_sweep.py and dhtorch/pipeline/surface.py;
// products and sums in the same order, with FMA where torch uses it, so that results agree up to rounding, and all but the
// correlation usually bit for bit. One thread, no gradient. The dispatch checks dtypes and strides, Python the shapes.

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "vectors.h"

namespace {

constexpr int64_t RADIUS = FIT_RADIUS_PX, SIDE = 2 * RADIUS + 1, PRODUCTS = 9;
static_assert(SIDE == 9);      // of sum_nine
constexpr int64_t SOME = 512;  // pixels that are processed together, in cache

// Sum of nine numbers in the order of window_sum in windows.py: one, and eight by halves.
inline Vector sum_nine(const Vector* x) {
  return x[0] + (((x[1] + x[2]) + (x[3] + x[4])) + ((x[5] + x[6]) + (x[7] + x[8])));
}

// Channels of an interleaved pixel, loaded together: gathering single values takes several times as long.
constexpr int64_t CHANNELS = 4;

// Bilinear reading of images (channels, H, W) at up to w positions at once.
struct Reader {
  int64_t channels, H, W;
  std::vector<int32_t> first, right, down;
  std::vector<float> weight;  // (4, w)

  Reader(const Tensor& picture, int64_t w)
      : channels(picture.size(1)), H(picture.size(2)), W(picture.size(3)), first(w), right(w), down(w), weight(4 * w) {}

  // Pixels and weights of F.grid_sample in border mode, after its normalised coordinates.
  void place(const float* u_of, const float* v_of, int64_t w) {
    const float across = static_cast<float>(W), along = static_cast<float>(H);
    const int32_t wide = static_cast<int32_t>(W), last_u = wide - 1, last_v = static_cast<int32_t>(H) - 1;
    int32_t *__restrict at = first.data(), *__restrict aside = right.data(), *__restrict below = down.data();
    float *__restrict nw = weight.data(), *__restrict ne = nw + w, *__restrict sw = ne + w, *__restrict se = sw + w;
#pragma GCC ivdep
    for (int64_t x = 0; x < w; ++x) {
      float u = (2.0f * u_of[x] + 1.0f) / across - 1.0f, v = (2.0f * v_of[x] + 1.0f) / along - 1.0f;
      u = std::min(std::max(u, -2.0f), 2.0f);
      v = std::min(std::max(v, -2.0f), 2.0f);
      u = fused(u + 1.0f, across / 2.0f, -0.5f);
      v = fused(v + 1.0f, along / 2.0f, -0.5f);
      u = u > 0.0f ? u : 0.0f;  // NaN becomes 0
      v = v > 0.0f ? v : 0.0f;
      u = u < across - 1.0f ? u : across - 1.0f;
      v = v < along - 1.0f ? v : along - 1.0f;
      const int32_t column = static_cast<int32_t>(u), row = static_cast<int32_t>(v);
      const float w_ = u - static_cast<float>(column), n_ = v - static_cast<float>(row);
      const float e_ = 1.0f - w_, s_ = 1.0f - n_;
      at[x] = row * wide + column;
      aside[x] = column < last_u ? 1 : 0;
      below[x] = row < last_v ? wide : 0;
      nw[x] = e_ * s_;
      ne[x] = w_ * s_;
      sw[x] = e_ * n_;
      se[x] = w_ * n_;
    }
  }

  // The three channels of an image, interleaved.
  std::unique_ptr<float[]> interleave(const float* picture) const {
    const int64_t all = H * W;
    std::unique_ptr<float[]> pixels(new float[CHANNELS * all]);
    const float *__restrict a = picture, *__restrict b = a + all, *__restrict c = b + all;
    float* __restrict to = pixels.get();
    for (int64_t i = 0; i < all; ++i) {
      to[CHANNELS * i] = a[i];
      to[CHANNELS * i + 1] = b[i];
      to[CHANNELS * i + 2] = c[i];
      to[CHANNELS * i + 3] = 0.0f;
    }
    return pixels;
  }

  // Values of interleaved pixels at positions.
  void read_interleaved(const float* pixels, const float* u_of, const float* v_of, int64_t w, float* __restrict found) {
    place(u_of, v_of, w);
    const float *nw = weight.data(), *ne = nw + w, *sw = ne + w, *se = sw + w;
    for (int64_t x = 0; x < w; ++x) {
      const float *here = pixels + CHANNELS * first[x], *under = here + CHANNELS * down[x];
      const int64_t aside = CHANNELS * right[x];
      for (int64_t k = 0; k < CHANNELS; ++k) {
        const float upper = fused(here[aside + k], ne[x], here[k] * nw[x]);
        found[CHANNELS * x + k] = fused(under[aside + k], se[x], fused(under[k], sw[x], upper));
      }
    }
  }

  // Values of planar channels; channel k is written at found + k * apart.
  void read(const float* picture, const float* u_of, const float* v_of, int64_t w, float* found, int64_t apart) {
    place(u_of, v_of, w);
    const int32_t *__restrict at = first.data(), *__restrict aside = right.data(), *__restrict below = down.data();
    const float *__restrict nw = weight.data(), *__restrict ne = nw + w, *__restrict sw = ne + w, *__restrict se = sw + w;
    for (int64_t k = 0; k < channels; ++k) {
      const float* plane = picture + k * H * W;
      float* to = found + k * apart;  // not __restrict: the compiler would then gather
      for (int64_t x = 0; x < w; ++x) {
        const float *here = plane + at[x], *under = here + below[x];
        const float upper = fused(here[aside[x]], ne[x], here[0] * nw[x]);
        to[x] = fused(under[aside[x]], se[x], fused(under[0], sw[x], upper));
      }
    }
  }

  // Whether positions lie in the image.
  void within(const float* __restrict u, const float* __restrict v, int64_t w, bool* __restrict inside) const {
    const float right = static_cast<float>(W - 1), down = static_cast<float>(H - 1);
#pragma GCC ivdep
    for (int64_t x = 0; x < w; ++x) inside[x] = (u[x] >= 0.0f) & (u[x] <= right) & (v[x] >= 0.0f) & (v[x] <= down);
  }
};

// Values (B, C, N) of picture (B, C, H, W) at uv (B, 2, N), float32, and which lie inside (B, N) bool.
void sample_bilinear(Tensor picture, Tensor uv, Tensor values, Tensor inside) {
  const int64_t B = uv.size(0), N = uv.size(2), C = picture.size(1);
  Reader reader(picture, SOME);
  for (int64_t k = 0; k < B; ++k) {
    const float *image = data<float>(picture) + k * C * reader.H * reader.W, *u = data<float>(uv) + 2 * k * N;
    for (int64_t n = 0; n < N; n += SOME) {
      const int64_t w = std::min(SOME, N - n);
      reader.read(image, u + n, u + N + n, w, data<float>(values) + k * C * N + n, N);
      reader.within(u + n, u + N + n, w, data<bool>(inside) + k * N + n);
    }
  }
}

// The fit of every pixel from the nine means over its window.
struct WindowFit {
  float *step, *contrast, *noise, *correlation;
  float min_gain, max_gain, flat, flat_gradient;

  void write(const float* mean, int64_t wide, int64_t place, int64_t w) const {
    const float *__restrict a = mean, *__restrict b = a + wide, *__restrict c = b + wide, *__restrict d = c + wide;
    const float *__restrict e = d + wide, *__restrict f = e + wide, *__restrict p = f + wide, *__restrict r = p + wide;
    const float* __restrict s = r + wide;
    float *__restrict move = step + place, *__restrict clear = contrast + place, *__restrict left = noise + place;
    float* __restrict alike = correlation + place;
#pragma GCC ivdep
    for (int64_t x = 0; x < w; ++x) {
      const float i = a[x], j = b[x], k = c[x];
      float ii = d[x] - i * i, jj = e[x] - j * j, kk = p[x] - k * k;
      const float ij = f[x] - i * j;
      ii = ii < flat ? flat : ii;
      jj = jj < flat ? flat : jj;
      kk = kk < flat_gradient ? flat_gradient : kk;
      float gain = ij / jj;
      gain = gain < min_gain ? min_gain : gain;
      gain = gain > max_gain ? max_gain : gain;
      const float more = ii + gain * gain * jj - 2.0f * gain * ij;
      move[x] = ((r[x] - k * i) - gain * (s[x] - k * j)) / (gain * kk);
      clear[x] = kk * gain * gain;
      left[x] = more < 0.0f ? 0.0f : more;
      alike[x] = ij / std::sqrt(ii * jj);
    }
  }
};

// grey (B, 1, h, w), picture (B, 3, H, W): grey and gradients; uv and further (B, 2, h * w): pixels of view 1 at each
// pixel's inverse depth and at one larger by little (B) 1/m, float32. Outputs, fields of WindowFit in plane_sweep.py: step,
// contrast, noise, correlation (B, h, w) float32, inside (B, h, w) bool, motion (B, 2, h * w) float32.
void fit_windows(Tensor grey, Tensor picture, Tensor uv, Tensor further, Tensor little, Tensor step, Tensor contrast,
                 Tensor noise, Tensor correlation, Tensor inside, Tensor motion, double min_gain, double max_gain,
                 double flat, double flat_gradient) {
  const int64_t B = grey.size(0), h = grey.size(2), w = grey.size(3), H = picture.size(2), W = picture.size(3), N = h * w;
  const int64_t wide = (w + LANES - 1) / LANES * LANES, padded = wide + 2 * RADIUS + LANES;
  const float share = static_cast<float>(1.0 / (SIDE * SIDE));
  std::vector<float> ring(SIDE * PRODUCTS * wide), column(padded), mean(PRODUCTS * wide), seen(CHANNELS * w);
  Reader reader(picture, w);
  for (int64_t k = 0; k < B; ++k) {
    const float* image = data<float>(grey) + k * N;
    const std::unique_ptr<float[]> pixels = reader.interleave(data<float>(picture) + 3 * k * H * W);
    const float *here = data<float>(uv) + 2 * k * N, *there = data<float>(further) + 2 * k * N;
    const float by = data<float>(little)[k];
    const WindowFit fit{data<float>(step) + k * N, data<float>(contrast) + k * N, data<float>(noise) + k * N,
                        data<float>(correlation) + k * N, static_cast<float>(min_gain), static_cast<float>(max_gain),
                        static_cast<float>(flat), static_cast<float>(flat_gradient)};
    for (int64_t y = 0, next = 0; y < h; ++y) {
      for (; next <= std::min(y + RADIUS, h - 1); ++next) {
        const float *u = here + next * w, *v = u + N, *u_then = there + next * w, *v_then = u_then + N;
        const float* __restrict I = image + next * w;
        reader.read_interleaved(pixels.get(), u, v, w, seen.data());
        reader.within(u, v, w, data<bool>(inside) + k * N + next * w);
        float *__restrict right_by = data<float>(motion) + 2 * k * N + next * w, *__restrict down_by = right_by + N;
#pragma GCC ivdep
        for (int64_t x = 0; x < w; ++x) {
          right_by[x] = (u_then[x] - u[x]) / by;
          down_by[x] = (v_then[x] - v[x]) / by;
        }
        const float* __restrict read = seen.data();
        float* __restrict to = ring.data() + next % SIDE * PRODUCTS * wide;
#pragma GCC ivdep
        for (int64_t x = 0; x < w; ++x) {
          const float J = read[CHANNELS * x];
          const float g = read[CHANNELS * x + 1] * right_by[x] + read[CHANNELS * x + 2] * down_by[x];
          to[x] = I[x];
          to[x + wide] = J;
          to[x + 2 * wide] = g;
          to[x + 3 * wide] = I[x] * I[x];
          to[x + 4 * wide] = J * J;
          to[x + 5 * wide] = I[x] * J;
          to[x + 6 * wide] = g * g;
          to[x + 7 * wide] = g * I[x];
          to[x + 8 * wide] = g * J;
        }
      }
      for (int64_t p = 0; p < PRODUCTS; ++p) {
        const float* rows[SIDE];
        for (int64_t i = 0; i < SIDE; ++i) {
          const int64_t from = std::clamp<int64_t>(y + i - RADIUS, 0, h - 1);
          rows[i] = ring.data() + (from % SIDE * PRODUCTS + p) * wide;
        }
        float* middle = column.data() + RADIUS;
        for (int64_t x = 0; x < wide; x += LANES) {
          Vector part[SIDE];
          for (int64_t i = 0; i < SIDE; ++i) part[i] = load(rows[i] + x);
          store(sum_nine(part), middle + x);
        }
        std::fill_n(column.data(), RADIUS, middle[0]);
        std::fill_n(middle + w, RADIUS, middle[w - 1]);
        for (int64_t x = 0; x < wide; x += LANES) {
          Vector part[SIDE];
          for (int64_t i = 0; i < SIDE; ++i) part[i] = load(column.data() + x + i);
          store(share * sum_nine(part), mean.data() + p * wide + x);
        }
      }
      fit.write(mean.data(), wide, y * w, w);
    }
  }
}

// covered (B, N) bool: whether another pixel, nearer by more than `tolerance` (B), covers each of the inverse depths q
// (B, N) in a view of rows * columns pixels that sees them at (a + q b) / (1 + q c) + margin; a (B, 2, N), b (B, 2), c (B)
// float32.
void occlusion_mask(Tensor a, Tensor b, Tensor c, Tensor q, Tensor tolerance, Tensor covered, int64_t rows, int64_t columns,
                    int64_t margin, double min_depth_ratio, double behind_scale) {
  const int64_t B = q.size(0), N = q.size(1);
  const float inside = static_cast<float>(margin + 0.5), right = static_cast<float>(columns - 1),
              down = static_cast<float>(rows - 1);
  const float min_ratio = static_cast<float>(min_depth_ratio), behind = static_cast<float>(behind_scale);
  const int32_t width = static_cast<int32_t>(columns);
  std::vector<float> nearest(rows * columns);
  std::vector<int32_t> cell(N);
  for (int64_t k = 0; k < B; ++k) {
    const float *__restrict u_0 = data<float>(a) + 2 * k * N, *__restrict v_0 = u_0 + N, *__restrict own = data<float>(q) + k * N;
    const float u_by = data<float>(b)[2 * k], v_by = data<float>(b)[2 * k + 1], z_by = data<float>(c)[k];
    int32_t* __restrict at = cell.data();
#pragma GCC ivdep
    for (int64_t n = 0; n < N; ++n) {
      const float z = 1.0f + own[n] * z_by, scale = z > min_ratio ? 1.0f / z : behind;
      float u = (u_0[n] + own[n] * u_by) * scale + inside, v = (v_0[n] + own[n] * v_by) * scale + inside;
      u = u > 0.0f ? u : 0.0f;
      v = v > 0.0f ? v : 0.0f;
      u = u < right ? u : right;
      v = v < down ? v : down;
      at[n] = static_cast<int32_t>(v) * width + static_cast<int32_t>(u);
    }
    std::fill(nearest.begin(), nearest.end(), -1.0f);
    for (int64_t n = 0; n < N; ++n) nearest[at[n]] = std::max(nearest[at[n]], own[n]);
    const float more = data<float>(tolerance)[k], *front = nearest.data();
    bool* __restrict to = data<bool>(covered) + k * N;
#pragma GCC ivdep
    for (int64_t n = 0; n < N; ++n) to[n] = front[at[n]] > own[n] + more;
  }
}

// Variance (B, N) of q (B, N) on rays (B, 3, N) by the covariance (B, K, K) of a motion R (B, 9), t (B, 3); K is 6, or 9
// with a shutter's turn; moved (B, 2, N): d pixel / d q, px·m; f (B, 2) px.
void pose_variance(Tensor ray, Tensor q, Tensor R, Tensor t, Tensor f, Tensor cov, Tensor moved, Tensor variance,
                   double min_inverse_depth, double min_squared_motion, double min_abs_depth) {
  const int64_t B = q.size(0), N = q.size(1), K = cov.size(1);
  const float min_q = static_cast<float>(min_inverse_depth), min_square = static_cast<float>(min_squared_motion),
              min_z = static_cast<float>(min_abs_depth);
  float row[9][SOME], carried[SOME];
  for (int64_t k = 0; k < B; ++k) {
    const float *m = data<float>(R) + 9 * k, *tk = data<float>(t) + 3 * k, *C = data<float>(cov) + K * K * k;
    const float f_u = data<float>(f)[2 * k], f_v = data<float>(f)[2 * k + 1];
    const float *__restrict ax = data<float>(ray) + 3 * N * k, *__restrict ay = ax + N, *__restrict az = ay + N;
    const float *__restrict own = data<float>(q) + N * k, *__restrict u_by = data<float>(moved) + 2 * N * k;
    const float* __restrict v_by = u_by + N;
    for (int64_t first = 0; first < N; first += SOME) {
      const int64_t some = std::min(SOME, N - first);
#pragma GCC ivdep
      for (int64_t i = 0; i < some; ++i) {
        const int64_t n = first + i;
        const float a = ax[n], b = ay[n], d = az[n], flat = own[n] < min_q ? min_q : own[n];
        const float x = (a * m[0] + b * m[1] + d * m[2]) / flat + tk[0];
        const float y = (a * m[3] + b * m[4] + d * m[5]) / flat + tk[1];
        const float z = (a * m[6] + b * m[7] + d * m[8]) / flat + tk[2];
        const float length = u_by[n] * u_by[n] + v_by[n] * v_by[n], share = 1.0f / (length < min_square ? min_square : length);
        const float inv_z = 1.0f / (std::abs(z) < min_z ? min_z : z);
        const float gx = f_u * inv_z * u_by[n] * share, gy = f_v * inv_z * v_by[n] * share;
        const float gz = -(gx * x + gy * y) * inv_z;
        row[0][i] = y * gz - z * gy;
        row[1][i] = z * gx - x * gz;
        row[2][i] = x * gy - y * gx;
        row[3][i] = gx;
        row[4][i] = gy;
        row[5][i] = gz;
        for (int64_t p = 0; p < 3; ++p) row[6 + p][i] = row[p][i] * b;
      }
      float* __restrict to = data<float>(variance) + N * k + first;
      std::fill_n(to, some, 0.0f);
      for (int64_t p = 0; p < K; ++p) {
        for (int64_t i = 0; i < some; ++i) carried[i] = row[0][i] * C[p];
        for (int64_t r = 1; r < K; ++r) {
          for (int64_t i = 0; i < some; ++i) carried[i] = fused(row[r][i], C[r * K + p], carried[i]);
        }
        for (int64_t i = 0; i < some; ++i) to[i] = fused(carried[i], row[p][i], to[i]);
      }
      for (int64_t i = 0; i < some; ++i) to[i] = to[i] < 0.0f ? 0.0f : to[i];
    }
  }
}

// Add a view's fit to the sums total, weight and, if there is a variance, shared, and update best and seen, all (B, h, w).
// step, contrast, noise, correlation: fields of WindowFit; here: whether the view sees the pixel; most (B): largest step.
// grey_variance: of a pixel; independent: independent pixels in a window; min_correlation: below it the weight is 0;
// first: the sums are overwritten.
void add_view(Tensor step, Tensor contrast, Tensor noise, Tensor correlation, Tensor here, Tensor most, Tensor variance,
              Tensor shared, Tensor total, Tensor weight, Tensor best, Tensor seen, double grey_variance, double independent,
              double min_correlation, bool first) {
  const int64_t B = step.size(0), N = step.size(1) * step.size(2);
  const bool motion = variance.size(0) == B;
  const float least = static_cast<float>(grey_variance), count = static_cast<float>(independent),
              from = static_cast<float>(min_correlation);
  for (int64_t k = 0; k < B; ++k) {
    const int64_t at = k * N;
    const float *__restrict move = data<float>(step) + at, *__restrict clear = data<float>(contrast) + at;
    const float *__restrict left = data<float>(noise) + at, *__restrict alike = data<float>(correlation) + at;
    const bool* __restrict shown = data<bool>(here) + at;
    const float limit = data<float>(most)[k];
    float *__restrict sum = data<float>(total) + at, *__restrict all = data<float>(weight) + at;
    float* __restrict top = data<float>(best) + at;
    bool* __restrict any = data<bool>(seen) + at;
    const float* __restrict wide = data<float>(variance) + (motion ? at : 0);
    float* __restrict common = data<float>(shared) + (motion ? at : 0);
    for (int64_t n = 0; n < N; ++n) {
      const float own = (left[n] + least) / (count * clear[n]);
      const float now = (shown[n] & (alike[n] > from)) ? 1.0f / own : 0.0f;
      float by = move[n] < -limit ? -limit : move[n];
      by = by > limit ? limit : by;
      const float before = first ? -1.0f : top[n];
      sum[n] = (first ? 0.0f : sum[n]) + now * by;
      all[n] = (first ? 0.0f : all[n]) + now;
      top[n] = (shown[n] & (alike[n] > before)) ? alike[n] : before;
      any[n] = first ? shown[n] : any[n] | shown[n];
      if (motion) common[n] = (first ? 0.0f : common[n]) + now * wide[n];
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def("sample_bilinear(Tensor picture, Tensor uv, Tensor(a!) values, Tensor(b!) inside) -> ()");
  m.def(
      "occlusion_mask(Tensor a, Tensor b, Tensor c, Tensor q, Tensor tolerance, Tensor(a!) covered, int rows, "
      "int columns, int margin, float min_depth_ratio, float behind_scale) -> ()");
  m.def(
      "pose_variance(Tensor ray, Tensor q, Tensor R, Tensor t, Tensor f, Tensor cov, Tensor moved, Tensor(a!) variance, "
      "float min_inverse_depth, float min_squared_motion, float min_abs_depth) -> ()");
  m.def(
      "add_view(Tensor step, Tensor contrast, Tensor noise, Tensor correlation, Tensor here, Tensor most, Tensor variance, "
      "Tensor(a!) shared, Tensor(b!) total, Tensor(c!) weight, Tensor(d!) best, Tensor(e!) seen, "
      "float grey_variance, float independent, float min_correlation, bool first) -> ()");
  m.def(
      "fit_windows(Tensor grey, Tensor picture, Tensor uv, Tensor further, Tensor little, Tensor(a!) step, "
      "Tensor(b!) contrast, Tensor(c!) noise, Tensor(d!) correlation, Tensor(e!) inside, Tensor(f!) motion, "
      "float min_gain, float max_gain, float flat, float flat_gradient) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("sample_bilinear", TORCH_BOX(&sample_bilinear));
  m.impl("fit_windows", TORCH_BOX(&fit_windows));
  m.impl("occlusion_mask", TORCH_BOX(&occlusion_mask));
  m.impl("pose_variance", TORCH_BOX(&pose_variance));
  m.impl("add_view", TORCH_BOX(&add_view));
}
