// What dhtorch/geometry/sweep.py's fit_windows does in torch as an operator on torch's stable ABI: the same products and
// sums in the same order, so that it answers alike bit for bit where torch reads pictures without fused products, and up
// to rounding elsewhere. One thread, no gradient. Callers check shapes, types and that everything is contiguous; see
// dhtorch/native.py.

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "native_vectors.h"

namespace {

// What sweep.py holds under the same names, and the window's radius.
constexpr int64_t RADIUS = 4;
constexpr float LEAST_GAIN = 0.5f, MOST_GAIN = 2.0f, FLAT = 1e-8f;

constexpr int64_t SIDE = 2 * RADIUS + 1, PRODUCTS = 9;

// Nine numbers, summed as sweep.window_sum does: one, and eight by halves.
inline Vector nine(const Vector* x) {
  return x[0] + (((x[1] + x[2]) + (x[3] + x[4])) + ((x[5] + x[6]) + (x[7] + x[8])));
}

// A row of the picture that is fitted: where the other view shows each pixel, and the products of what it shows.
struct Row {
  int64_t w, H, W;
  std::vector<int32_t> first, right, down;
  std::vector<float> weight;  // (4, w)
  std::vector<float> read;    // (3, w)

  Row(int64_t w, int64_t H, int64_t W) : w(w), H(H), W(W), first(w), right(w), down(w), weight(4 * w), read(3 * w) {}

  // As F.grid_sample in its border mode, of places that went through its normalised coordinates.
  void look(const float* picture, const float* u_of, const float* v_of) {
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
      u = u > 0.0f ? u : 0.0f;  // no number is 0
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
    for (int64_t k = 0; k < 3; ++k) {
      const float* plane = picture + k * H * W;
      float* __restrict to = read.data() + k * w;
#pragma GCC ivdep
      for (int64_t x = 0; x < w; ++x) {
        const float *here = plane + at[x], *under = here + below[x];
        const float upper = fused(here[aside[x]], ne[x], here[0] * nw[x]);
        to[x] = fused(under[aside[x]], se[x], fused(under[0], sw[x], upper));
      }
    }
  }
};

// A pixel's window, in the nine means of it, tells how the pixel must move.
struct Answers {
  float *step, *contrast, *noise, *correlation;

  void tell(const float* mean, int64_t wide, int64_t place, int64_t w) const {
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
      ii = ii < FLAT ? FLAT : ii;
      jj = jj < FLAT ? FLAT : jj;
      kk = kk < 1e-12f ? 1e-12f : kk;
      float gain = ij / jj;
      gain = gain < LEAST_GAIN ? LEAST_GAIN : gain;
      gain = gain > MOST_GAIN ? MOST_GAIN : gain;
      const float more = ii + gain * gain * jj - 2.0f * gain * ij;
      move[x] = ((r[x] - k * i) - gain * (s[x] - k * j)) / (gain * kk);
      clear[x] = kk * gain * gain;
      left[x] = more < 0.0f ? 0.0f : more;
      alike[x] = ij / std::sqrt(ii * jj);
    }
  }
};

// grey (B, 1, h, w), picture (B, 3, H, W), uv and further (B, 2, h * w) where view 1 shows each pixel at its depth and at
// one nearer by little (B) 1/m, float32; the fields of sweep.py's Fit: step, contrast, noise, correlation (B, h, w)
// float32, inside (B, h, w) bool, motion (B, 2, h * w) float32.
void fit_windows(Tensor grey, Tensor picture, Tensor uv, Tensor further, Tensor little, Tensor step, Tensor contrast,
                 Tensor noise, Tensor correlation, Tensor inside, Tensor motion) {
  const int64_t B = grey.size(0), h = grey.size(2), w = grey.size(3), H = picture.size(2), W = picture.size(3), N = h * w;
  const int64_t wide = (w + LANES - 1) / LANES * LANES, padded = wide + 2 * RADIUS + LANES;
  const float share = static_cast<float>(1.0 / (SIDE * SIDE)), right = static_cast<float>(W - 1), down = static_cast<float>(H - 1);
  std::vector<float> ring(SIDE * PRODUCTS * wide), column(padded), mean(PRODUCTS * wide);
  Row row(w, H, W);
  for (int64_t k = 0; k < B; ++k) {
    const float* image = data<float>(grey) + k * N;
    const float *here = data<float>(uv) + 2 * k * N, *there = data<float>(further) + 2 * k * N;
    const float by = data<float>(little)[k];
    const Answers answers{data<float>(step) + k * N, data<float>(contrast) + k * N, data<float>(noise) + k * N,
                          data<float>(correlation) + k * N};
    for (int64_t y = 0, next = 0; y < h; ++y) {
      for (; next <= std::min(y + RADIUS, h - 1); ++next) {
        const float *u = here + next * w, *v = u + N, *u_then = there + next * w, *v_then = u_then + N;
        const float* __restrict I = image + next * w;
        row.look(data<float>(picture) + 3 * k * H * W, u, v);
        float *__restrict right_by = data<float>(motion) + 2 * k * N + next * w, *__restrict down_by = right_by + N;
        bool* __restrict shown = data<bool>(inside) + k * N + next * w;
#pragma GCC ivdep
        for (int64_t x = 0; x < w; ++x) {
          right_by[x] = (u_then[x] - u[x]) / by;
          down_by[x] = (v_then[x] - v[x]) / by;
          shown[x] = (u[x] >= 0.0f) & (u[x] <= right) & (v[x] >= 0.0f) & (v[x] <= down);
        }
        const float *__restrict J = row.read.data(), *__restrict du = J + w, *__restrict dv = du + w;
        float* __restrict to = ring.data() + next % SIDE * PRODUCTS * wide;
#pragma GCC ivdep
        for (int64_t x = 0; x < w; ++x) {
          const float g = du[x] * right_by[x] + dv[x] * down_by[x];
          to[x] = I[x];
          to[x + wide] = J[x];
          to[x + 2 * wide] = g;
          to[x + 3 * wide] = I[x] * I[x];
          to[x + 4 * wide] = J[x] * J[x];
          to[x + 5 * wide] = I[x] * J[x];
          to[x + 6 * wide] = g * g;
          to[x + 7 * wide] = g * I[x];
          to[x + 8 * wide] = g * J[x];
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
          store(nine(part), middle + x);
        }
        std::fill_n(column.data(), RADIUS, middle[0]);
        std::fill_n(middle + w, RADIUS, middle[w - 1]);
        for (int64_t x = 0; x < wide; x += LANES) {
          Vector part[SIDE];
          for (int64_t i = 0; i < SIDE; ++i) part[i] = load(column.data() + x + i);
          store(share * nine(part), mean.data() + p * wide + x);
        }
      }
      answers.tell(mean.data(), wide, y * w, w);
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "fit_windows(Tensor grey, Tensor picture, Tensor uv, Tensor further, Tensor little, Tensor(a!) step, "
      "Tensor(b!) contrast, Tensor(c!) noise, Tensor(d!) correlation, Tensor(e!) inside, Tensor(f!) motion) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) { m.impl("fit_windows", TORCH_BOX(&fit_windows)); }
