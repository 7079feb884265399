// Triangulation of tracks with its variance, and the parallax of near returns. References: _triangulate and _depth_variance in
// dhtorch/geometry/epipolar.py, _parallax and _profile_cost in dhtorch/stages/misalignment.py; the same formulas in the same order, sums over tracks in another,
// angles by the C library. One thread, no gradient. The dispatch checks dtypes, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace {

constexpr int64_t SOME = 256;  // points that are processed together, in cache

inline float away_from_zero(float z) { return std::fabs(z) < 1e-9f ? 1e-9f : z; }

inline float length(float square) { return square > 0 ? std::sqrt(square) : square; }

// Cameras and pose of one pair, and its triangulation of _triangulate in epipolar.py.
struct TwoViews {
  float f0[2], c0[2], f[2], c[2], M[3][3], t[3], stretch;

  TwoViews(const float* f_0, const float* c_0, const float* f_1, const float* c_1, const float* R, const float* shift)
      : f0{f_0[0], f_0[1]}, c0{c_0[0], c_0[1]}, f{f_1[0], f_1[1]}, c{c_1[0], c_1[1]}, t{shift[0], shift[1], shift[2]} {
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) M[i][j] = j < 2 ? R[3 * i + j] / f0[j] : R[3 * i + j];
    }
    const float ratio = f[1] / f[0];
    stretch = ratio * ratio;
  }
};

// The point that pixels u0, v0 and u, v see: its ray in camera 1 (a) and depth along it, the point there (X, Y, Z), the
// residual and the derivatives of its pixel by x, y, z.
struct Point {
  float a0, a1, a2, depth, X, Y, Z, residual, px, py, gx, gy;

  Point(const TwoViews& of, float u0, float v0, float u, float v) {
    const float x0 = u0 - of.c0[0], x1 = v0 - of.c0[1], t0 = of.t[0], t1 = of.t[1], t2 = of.t[2];
    a0 = x0 * of.M[0][0] + x1 * of.M[0][1] + of.M[0][2];
    a1 = x0 * of.M[1][0] + x1 * of.M[1][1] + of.M[1][2];
    a2 = x0 * of.M[2][0] + x1 * of.M[2][1] + of.M[2][2];
    const float y0 = (u - of.c[0]) / of.f[0], y1 = (v - of.c[1]) / of.f[1];
    const float g0 = t2 * a0 - t0 * a2, g1 = (t2 * a1 - t1 * a2) * of.stretch;
    const float near = g0 * (t2 * y0 - t0) + g1 * (t2 * y1 - t1), far = g0 * (a0 - a2 * y0) + g1 * (a1 - a2 * y1);
    const float square = far * far;
    depth = near * far / (square < 1e-20f ? 1e-20f : square);
    X = depth * a0 + t0;
    Y = depth * a1 + t1;
    Z = depth * a2 + t2;
    const float safe = away_from_zero(Z), inverse = 1 / safe;
    const float r0 = u - (X / safe * of.f[0] + of.c[0]), r1 = v - (Y / safe * of.f[1] + of.c[1]);
    residual = length(r0 * r0 + r1 * r1);
    px = of.f[0] * inverse;
    py = of.f[1] * inverse;
    gx = -px * X * inverse;
    gy = -py * Y * inverse;
  }

  float slope_u() const { return px * a0 + 0 * a1 + gx * a2; }
  float slope_v() const { return 0 * a0 + py * a1 + gy * a2; }
};

// Pixels uv_0, uv_1 (B, N, 2), f_0, c_0, f_1, c_1 (B, 2) px, R (B, 3, 3), t (B, 3) float32. Outputs, fields of TwoView:
// depth, depth_1, parallax, residual (B, N), slope (B, N, 2), J_pose (B, N, 2, 6).
void triangulate(Tensor uv_0, Tensor uv_1, Tensor f_0, Tensor c_0, Tensor f_1, Tensor c_1, Tensor R, Tensor t, Tensor depth,
                 Tensor depth_1, Tensor parallax, Tensor residual, Tensor slope, Tensor J_pose) {
  const int64_t B = uv_0.size(0), N = uv_0.size(1);
  float cross[SOME], dot[SOME];
  for (int64_t k = 0; k < B; ++k) {
    const TwoViews views(data<float>(f_0) + 2 * k, data<float>(c_0) + 2 * k, data<float>(f_1) + 2 * k,
                         data<float>(c_1) + 2 * k, data<float>(R) + 9 * k, data<float>(t) + 3 * k);
    for (int64_t first = 0; first < N; first += SOME) {
      const int64_t some = std::min(SOME, N - first), at = N * k + first;
      const float *__restrict from = data<float>(uv_0) + 2 * at, *__restrict seen = data<float>(uv_1) + 2 * at;
      float *__restrict z_0 = data<float>(depth) + at, *__restrict z_1 = data<float>(depth_1) + at;
      float *__restrict off = data<float>(residual) + at, *__restrict by = data<float>(slope) + 2 * at;
      float* __restrict J = data<float>(J_pose) + 12 * at;
#pragma GCC ivdep
      for (int64_t n = 0; n < some; ++n) {
        const Point p(views, from[2 * n], from[2 * n + 1], seen[2 * n], seen[2 * n + 1]);
        z_0[n] = p.depth;
        z_1[n] = p.Z;
        off[n] = p.residual;
        by[2 * n] = p.slope_u();
        by[2 * n + 1] = p.slope_v();
        float* row = J + 12 * n;
        row[0] = p.gx * p.Y;
        row[1] = p.px * p.Z - p.gx * p.X;
        row[2] = -p.px * p.Y;
        row[3] = p.px;
        row[4] = 0;
        row[5] = p.gx;
        row[6] = p.gy * p.Y - p.py * p.Z;
        row[7] = -p.gy * p.X;
        row[8] = p.py * p.X;
        row[9] = 0;
        row[10] = p.py;
        row[11] = p.gy;
        const float d0 = p.X - views.t[0], d1 = p.Y - views.t[1], d2 = p.Z - views.t[2];
        const float k0 = p.Y * d2 - p.Z * d1, k1 = p.Z * d0 - p.X * d2, k2 = p.X * d1 - p.Y * d0;
        cross[n] = length(k0 * k0 + k1 * k1 + k2 * k2);
        dot[n] = p.X * d0 + p.Y * d1 + p.Z * d2;
      }
      for (int64_t n = 0; n < some; ++n) data<float>(parallax)[at + n] = std::atan2(cross[n], dot[n]);
    }
  }
}

// slope (B, N, 2), J (B, N, 2, K), cov (B, N, 2, 2) px^2, cov_pose (B, K, K), float32. Outputs: own and shared variance of
// depth (B, N) m^2, infinite where the squared slope is at most `least`.
void depth_variance(Tensor slope, Tensor J, Tensor cov, Tensor cov_pose, Tensor own, Tensor shared, double least) {
  const int64_t B = slope.size(0), N = slope.size(1), K = cov_pose.size(1);
  const float limit = static_cast<float>(least), infinite = std::numeric_limits<float>::infinity();
  std::vector<float> row(K);
  for (int64_t k = 0; k < B; ++k) {
    const float* pose = data<float>(cov_pose) + K * K * k;
    for (int64_t n = N * k; n < N * (k + 1); ++n) {
      const float *s = data<float>(slope) + 2 * n, *C = data<float>(cov) + 4 * n, *by = data<float>(J) + 2 * K * n;
      const float square = s[0] * s[0] + s[1] * s[1], g0 = s[0] / square, g1 = s[1] / square;
      if (!(square > limit)) {
        data<float>(own)[n] = data<float>(shared)[n] = infinite;
        continue;
      }
      data<float>(own)[n] = g0 * g0 * C[0] + 2 * g0 * g1 * C[1] + g1 * g1 * C[3];
      for (int64_t i = 0; i < K; ++i) row[i] = g0 * by[i] + g1 * by[K + i];
      float total = 0;
      for (int64_t j = 0; j < K; ++j) {
        float carried = 0;
        for (int64_t i = 0; i < K; ++i) carried += row[i] * pose[K * i + j];
        total += carried * row[j];
      }
      data<float>(shared)[n] = total < 0 ? 0 : total;
    }
  }
}

// Tracks uv_0, uv_1 (B, N, 2) ideal px, valid (B, N) bool; returns xyz (B, N, 3), sigma (B, N) m; posed (B) bool, R
// (B, 3, 3), t (B, 3), rate (B, 3), or (0, 3) without a rolling shutter; f_0, c_0, f_1, c_1 (B, 2) px, float32. Outputs,
// fields of _Parallax: uv (B, N, 2), p, q, a, variance_rel (B, N), noise (B, 1), used (B, N) bool.
void near_parallax(Tensor uv_0, Tensor uv_1, Tensor valid, Tensor xyz, Tensor sigma, Tensor posed, Tensor R, Tensor t,
                   Tensor rate, Tensor f_0, Tensor c_0, Tensor f_1, Tensor c_1, Tensor uv, Tensor p, Tensor q, Tensor a,
                   Tensor variance_rel, Tensor noise, Tensor used, double tolerance_rel, double median_noise,
                   double min_noise) {
  const int64_t B = uv_0.size(0), N = uv_0.size(1);
  const float shared = static_cast<float>(tolerance_rel * tolerance_rel), unit = static_cast<float>(median_noise);
  const float no_pose[12] = {1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 0, 0}, global[3] = {};
  std::vector<float> of_near, of_far;
  for (int64_t k = 0; k < B; ++k) {
    const bool has_pose = data<bool>(posed)[k];
    const TwoViews views(data<float>(f_0) + 2 * k, data<float>(c_0) + 2 * k, data<float>(f_1) + 2 * k,
                         data<float>(c_1) + 2 * k, has_pose ? data<float>(R) + 9 * k : no_pose,
                         has_pose ? data<float>(t) + 3 * k : no_pose + 9);
    const bool rolling = rate.size(0) > 0;
    const float* turn = rolling && has_pose ? data<float>(rate) + 3 * k : global;
    of_near.clear();
    of_far.clear();
    for (int64_t n = N * k; n < N * (k + 1); ++n) {
      const float *here = data<float>(uv_0) + 2 * n, *there = data<float>(uv_1) + 2 * n, *X = data<float>(xyz) + 3 * n;
      const bool tracked = has_pose && data<bool>(valid)[n] && std::isfinite(here[0]) && std::isfinite(here[1]) &&
                           std::isfinite(there[0]) && std::isfinite(there[1]);
      const float u0 = tracked ? here[0] : 0, v0 = tracked ? here[1] : 0;
      float u = tracked ? there[0] : 0, v = tracked ? there[1] : 0;
      if (rolling) {
        const float y = (v0 - views.c0[1]) / views.f0[1];
        const float across = (u - views.c[0]) / views.f[0], along = (v - views.c[1]) / views.f[1];
        const float ahead = 1 - y * (turn[0] * along - turn[1] * across), z = std::fabs(ahead) < 0.1f ? 0.1f : ahead;
        u = (across - y * (turn[1] - turn[2] * along)) / z * views.f[0] + views.c[0];
        v = (along - y * (turn[2] * across - turn[0])) / z * views.f[1] + views.c[1];
      }
      const Point point(views, u0, v0, u, v);
      const float s0 = point.slope_u(), s1 = point.slope_v(), depth = point.depth;
      const float lever = std::sqrt(s0 * s0 + s1 * s1) * depth * depth;
      const bool returned = std::isfinite(X[0]) && std::isfinite(X[1]) && std::isfinite(X[2]);
      const float own = data<float>(sigma)[n];
      const bool use = tracked && returned && X[2] > 0 && std::isfinite(own) && lever > 0 && std::isfinite(lever);
      data<float>(uv)[2 * n] = u0;
      data<float>(uv)[2 * n + 1] = v0;
      const float inverse = use ? 1 / X[2] : 1.0f, off = use ? own * inverse : 0.0f;
      data<float>(p)[n] = inverse;
      data<float>(q)[n] = use ? 1 / (std::fabs(depth) > 1e-6f ? depth : 1e-6f) : 0;
      data<float>(a)[n] = use ? lever : 0;
      data<float>(variance_rel)[n] = off * off + shared;
      data<bool>(used)[n] = use;
      if (use) of_near.push_back(point.residual);
      if (tracked && !returned) of_far.push_back(point.residual);
    }
    data<float>(noise)[k] = std::max(std::max(lower_median(of_near, 0.0f), lower_median(of_far, 0.0f)) / unit, static_cast<float>(min_noise));
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
      "depth_variance(Tensor slope, Tensor J, Tensor cov, Tensor cov_pose, Tensor(a!) own, Tensor(b!) shared, float least) "
      "-> ()");
  m.def(
      "near_parallax(Tensor uv_0, Tensor uv_1, Tensor valid, Tensor xyz, Tensor sigma, Tensor posed, Tensor R, Tensor t, "
      "Tensor rate, Tensor f_0, Tensor c_0, Tensor f_1, Tensor c_1, Tensor(a!) uv, Tensor(b!) p, Tensor(c!) q, "
      "Tensor(d!) a, Tensor(e!) variance_rel, Tensor(f!) noise, Tensor(g!) used, float tolerance_rel, "
      "float median_noise, float min_noise) -> ()");
  m.def(
      "profile_cost(Tensor q, Tensor a, Tensor variance_rel, Tensor noise, Tensor p, Tensor used, Tensor start, "
      "Tensor(a!) cost, float bend, int steps) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("triangulate", TORCH_BOX(&triangulate));
  m.impl("depth_variance", TORCH_BOX(&depth_variance));
  m.impl("near_parallax", TORCH_BOX(&near_parallax));
  m.impl("profile_cost", TORCH_BOX(&profile_cost));
}
