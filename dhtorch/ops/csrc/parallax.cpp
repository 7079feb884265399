// Triangulation of tracks, and what their parallax says of depths. References: _triangulate in dhtorch/geometry/epipolar.py
// and _profile_cost in dhtorch/stages/misalignment.py; the same formulas in the same order, sums over tracks in another,
// angles by the C library. One thread, no gradient. The dispatch checks dtypes, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>

namespace {

constexpr int64_t SOME = 256;  // points that are processed together, in cache

inline float away_from_zero(float z) { return std::fabs(z) < 1e-9f ? 1e-9f : z; }

inline float length(float square) { return square > 0 ? std::sqrt(square) : square; }

// Pixels uv_0, uv_1 (B, N, 2), f_0, c_0, f_1, c_1 (B, 2) px, R (B, 3, 3), t (B, 3) float32. Outputs, fields of TwoView:
// depth, depth_1, parallax, residual (B, N), slope (B, N, 2), J_pose (B, N, 2, 6).
void triangulate(Tensor uv_0, Tensor uv_1, Tensor f_0, Tensor c_0, Tensor f_1, Tensor c_1, Tensor R, Tensor t, Tensor depth,
                 Tensor depth_1, Tensor parallax, Tensor residual, Tensor slope, Tensor J_pose) {
  const int64_t B = uv_0.size(0), N = uv_0.size(1);
  float cross[SOME], dot[SOME];
  for (int64_t k = 0; k < B; ++k) {
    const float *own_f = data<float>(f_0) + 2 * k, *own_c = data<float>(c_0) + 2 * k, *of_R = data<float>(R) + 9 * k;
    const float fx = data<float>(f_1)[2 * k], fy = data<float>(f_1)[2 * k + 1];
    const float cx = data<float>(c_1)[2 * k], cy = data<float>(c_1)[2 * k + 1];
    const float t0 = data<float>(t)[3 * k], t1 = data<float>(t)[3 * k + 1], t2 = data<float>(t)[3 * k + 2];
    float M[3][3];
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) M[i][j] = j < 2 ? of_R[3 * i + j] / own_f[j] : of_R[3 * i + j];
    }
    const float ratio = fy / fx, stretch = ratio * ratio;
    for (int64_t first = 0; first < N; first += SOME) {
      const int64_t some = std::min(SOME, N - first), at = N * k + first;
      const float *__restrict from = data<float>(uv_0) + 2 * at, *__restrict seen = data<float>(uv_1) + 2 * at;
      float *__restrict z_0 = data<float>(depth) + at, *__restrict z_1 = data<float>(depth_1) + at;
      float *__restrict off = data<float>(residual) + at, *__restrict by = data<float>(slope) + 2 * at;
      float* __restrict J = data<float>(J_pose) + 12 * at;
#pragma GCC ivdep
      for (int64_t n = 0; n < some; ++n) {
        const float x0 = from[2 * n] - own_c[0], x1 = from[2 * n + 1] - own_c[1], u = seen[2 * n], v = seen[2 * n + 1];
        const float a0 = x0 * M[0][0] + x1 * M[0][1] + M[0][2], a1 = x0 * M[1][0] + x1 * M[1][1] + M[1][2],
                    a2 = x0 * M[2][0] + x1 * M[2][1] + M[2][2];
        const float y0 = (u - cx) / fx, y1 = (v - cy) / fy;
        const float g0 = t2 * a0 - t0 * a2, g1 = (t2 * a1 - t1 * a2) * stretch;
        const float near = g0 * (t2 * y0 - t0) + g1 * (t2 * y1 - t1), far = g0 * (a0 - a2 * y0) + g1 * (a1 - a2 * y1);
        const float square = far * far, q = near * far / (square < 1e-20f ? 1e-20f : square);
        const float X = q * a0 + t0, Y = q * a1 + t1, Z = q * a2 + t2, safe = away_from_zero(Z);
        const float r0 = u - (X / safe * fx + cx), r1 = v - (Y / safe * fy + cy);
        const float inverse = 1 / safe, px = fx * inverse, py = fy * inverse;
        const float gx = -px * X * inverse, gy = -py * Y * inverse;
        z_0[n] = q;
        z_1[n] = Z;
        off[n] = length(r0 * r0 + r1 * r1);
        by[2 * n] = px * a0 + 0 * a1 + gx * a2;
        by[2 * n + 1] = 0 * a0 + py * a1 + gy * a2;
        float* row = J + 12 * n;
        row[0] = gx * Y;
        row[1] = px * Z - gx * X;
        row[2] = -px * Y;
        row[3] = px;
        row[4] = 0;
        row[5] = gx;
        row[6] = gy * Y - py * Z;
        row[7] = -gy * X;
        row[8] = py * X;
        row[9] = 0;
        row[10] = py;
        row[11] = gy;
        const float d0 = X - t0, d1 = Y - t1, d2 = Z - t2;
        const float k0 = Y * d2 - Z * d1, k1 = Z * d0 - X * d2, k2 = X * d1 - Y * d0;
        cross[n] = length(k0 * k0 + k1 * k1 + k2 * k2);
        dot[n] = X * d0 + Y * d1 + Z * d2;
      }
      for (int64_t n = 0; n < some; ++n) data<float>(parallax)[at + n] = std::atan2(cross[n], dot[n]);
    }
  }
}

// Near returns of one pair, with the options of _profile_cost.
struct Returns {
  const float *q, *a, *variance_rel;
  float noise, bend;
  int64_t N, steps;
};

// Sum of the robust costs of inverse depths p under a scale; with `fitted` the sums of its next estimate.
template <bool fitted>
float add_costs(const Returns& of, const float* __restrict p, const bool* __restrict used, float scale, float* sums) {
  const float *__restrict q = of.q, *__restrict a = of.a, *__restrict rel = of.variance_rel;
  const float own = of.noise * of.noise, limit = of.bend * of.bend;
  float cost[LANES] = {}, along[LANES] = {}, all[LANES] = {};
  for (int64_t n = 0; n < of.N; n += LANES) {
    const int64_t some = std::min(LANES, of.N - n);
#pragma GCC ivdep
    for (int64_t i = 0; i < some; ++i) {
      const float by = scale * p[n + i], moved = by * a[n + i], left = (q[n + i] - by) * a[n + i];
      const float variance = own + rel[n + i] * (moved * moved), square = left * left / variance;
      const float bent = limit / (limit + square);
      cost[i] += used[n + i] ? square / (limit + square) : 0.0f;
      if (!fitted) continue;
      const float weight = used[n + i] ? a[n + i] * a[n + i] / variance * (bent * bent) * p[n + i] : 0.0f;
      along[i] += weight * q[n + i];
      all[i] += weight * p[n + i];
    }
  }
  if (fitted) {
    sums[0] = total(load(along));
    sums[1] = total(load(all));
  }
  return total(load(cost));
}

// q, a, variance_rel (B, N), noise (B): fields of _Parallax; p (B, K, N) 1/m, used (B, K, N) bool; start (B, K): first
// estimate of the scale, or (0, K): it is 1. Output: cost (B, K), mean over the used returns.
void profile_cost(Tensor q, Tensor a, Tensor variance_rel, Tensor noise, Tensor p, Tensor used, Tensor start, Tensor cost,
                  double bend, int64_t steps) {
  const int64_t B = p.size(0), K = p.size(1), N = p.size(2);
  const bool has_scale = start.size(0) == B;
  for (int64_t b = 0; b < B; ++b) {
    const Returns of = {data<float>(q) + N * b, data<float>(a) + N * b, data<float>(variance_rel) + N * b,
                        data<float>(noise)[b], static_cast<float>(bend), N, steps};
    for (int64_t k = b * K; k < (b + 1) * K; ++k) {
      const float* depths = data<float>(p) + N * k;
      const bool* counted = data<bool>(used) + N * k;
      float scale = has_scale ? data<float>(start)[k] : 1.0f;
      for (int64_t step = 0; has_scale && step < of.steps; ++step) {
        float sums[2];
        add_costs<true>(of, depths, counted, scale, sums);
        const float fitted = sums[0] / (sums[1] > 0 ? sums[1] : 1.0f);
        scale = fitted > 0 ? fitted : scale;
      }
      const float found = add_costs<false>(of, depths, counted, scale, nullptr);
      data<float>(cost)[k] = found / static_cast<float>(std::max<int64_t>(std::count(counted, counted + N, true), 1));
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "triangulate(Tensor uv_0, Tensor uv_1, Tensor f_0, Tensor c_0, Tensor f_1, Tensor c_1, Tensor R, Tensor t, "
      "Tensor(a!) depth, Tensor(b!) depth_1, Tensor(c!) parallax, Tensor(d!) residual, Tensor(e!) slope, "
      "Tensor(f!) J_pose) -> ()");
  m.def(
      "profile_cost(Tensor q, Tensor a, Tensor variance_rel, Tensor noise, Tensor p, Tensor used, Tensor start, "
      "Tensor(a!) cost, float bend, int steps) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("triangulate", TORCH_BOX(&triangulate));
  m.impl("profile_cost", TORCH_BOX(&profile_cost));
}
