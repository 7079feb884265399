// Pixels of a distorted image -> ideal pixels, and the Jacobian of this map. References: _undistort and _undistort_jacobian
// in dhtorch/geometry/camera.py; the same Newton steps in the same order of operations. One thread, no gradient. The
// dispatch checks dtypes, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>

namespace {

inline Vector magnitude(Vector x) { return x < 0.0f ? -x : x; }

inline bool any(Bits mask) {
  int32_t found = 0;
  for (int64_t i = 0; i < LANES; ++i) found |= mask[i];
  return found != 0;
}

// Brown's rational model k1 k2 p1 p2 [k3 [k4 k5 k6]] of one camera, of _distort in camera.py.
struct Lens {
  float k[8] = {};
  bool rational;
  float least;  // determinant of the Jacobian that counts as zero

  Lens(const float* coefficients, int64_t count, float least) : rational(count > 5), least(least) {
    std::copy_n(coefficients, count, k);
  }

  // Distorted coordinates u, v of ideal x, y, and the entries a, b, c of the Jacobian.
  void distort(Vector x, Vector y, Vector& u, Vector& v, Vector& a, Vector& b, Vector& c) const {
    const float k1 = k[0], k2 = k[1], p1 = k[2], p2 = k[3], k3 = k[4], k4 = k[5], k5 = k[6], k6 = k[7];
    const Vector r2 = x * x + y * y;
    Vector radial = 1.0f + r2 * (k1 + r2 * (k2 + r2 * k3));
    Vector slope = k1 + r2 * (2.0f * k2 + r2 * (3.0f * k3));
    if (rational) {
      const Vector denominator = 1.0f + r2 * (k4 + r2 * (k5 + r2 * k6));
      radial = radial / denominator;
      slope = (slope - radial * (k4 + r2 * (2.0f * k5 + r2 * (3.0f * k6)))) / denominator;
    }
    const Vector s = radial + 2.0f * (p1 * y + p2 * x), along = slope * x;
    u = x * s + p2 * r2;
    v = y * s + p1 * r2;
    a = s + 2.0f * x * (along + 2.0f * p2);
    b = 2.0f * (y * (along + p2) + x * p1);
    c = s + 2.0f * y * (slope * y + 2.0f * p1);
  }

  // Entries of the inverse of ((a, b), (b, c)).
  void invert(Vector& a, Vector& b, Vector& c) const {
    const Vector det = a * c - b * b, by = magnitude(det) > least ? det : Vector{} + least, old = a;
    a = c / by;
    b = -b / by;
    c = old / by;
  }

  // Newton step from x, y towards the point whose distortion is to_u, to_v.
  void newton(Vector x, Vector y, Vector to_u, Vector to_v, Vector& dx, Vector& dy) const {
    Vector u, v, a, b, c;
    distort(x, y, u, v, a, b, c);
    invert(a, b, c);
    const Vector left_u = to_u - u, left_v = to_v - v;
    dx = a * left_u + b * left_v;
    dy = b * left_u + c * left_v;
  }
};

// LANES pixels, or fewer at the end, as coordinates at z = 1.
inline void normalise(const float* uv, int64_t count, const float* f, const float* c, Vector& x, Vector& y) {
  float across[LANES] = {}, along[LANES] = {};
  for (int64_t i = 0; i < count; ++i) {
    across[i] = uv[2 * i];
    along[i] = uv[2 * i + 1];
  }
  x = (load(across) - c[0]) / f[0];
  y = (load(along) - c[1]) / f[1];
}

// uv (B, N, 2) px, f and c (B, 2) px, distortion (B, k) float32 -> ideal (B, N, 2) px, NaN where the steps, at most
// `iterations`, do not return to the pixel within `tolerance_px`. A point stops after a step whose square is at most eps.
void undistort(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor ideal, int64_t iterations, double eps,
               double tolerance_px, double least) {
  const int64_t B = uv.size(0), N = uv.size(1), count = distortion.size(1);
  const Vector none = Vector{}, nan = none + __builtin_nanf("");
  const float stop = static_cast<float>(eps), tolerance = static_cast<float>(tolerance_px);
  for (int64_t k = 0; k < B; ++k) {
    const Lens lens(data<float>(distortion) + count * k, count, static_cast<float>(least));
    const float *focal = data<float>(f) + 2 * k, *centre = data<float>(c) + 2 * k, longest = std::max(focal[0], focal[1]);
    for (int64_t n = 0; n < N; n += LANES) {
      const int64_t some = std::min(LANES, N - n);
      Vector to_u, to_v, dx, dy, u, v, a, b, d;
      normalise(data<float>(uv) + 2 * (N * k + n), some, focal, centre, to_u, to_v);
      Vector x = to_u, y = to_v;
      Bits moving = none == 0.0f;
      for (int64_t step = 0; step < iterations && any(moving); ++step) {
        lens.newton(x, y, to_u, to_v, dx, dy);
        x = moving ? x + dx : x;
        y = moving ? y + dy : y;
        moving = moving & (dx * dx + dy * dy > stop);
      }
      lens.distort(x, y, u, v, a, b, d);
      const Bits converged = (magnitude(u - to_u) * longest < tolerance) & (magnitude(v - to_v) * longest < tolerance);
      x = converged ? x : none;
      y = converged ? y : none;
      lens.newton(x, y, converged ? to_u : none, converged ? to_v : none, dx, dy);
      const Vector found_u = converged ? (x + dx) * focal[0] + centre[0] : nan;
      const Vector found_v = converged ? (y + dy) * focal[1] + centre[1] : nan;
      float* to = data<float>(ideal) + 2 * (N * k + n);
      for (int64_t i = 0; i < some; ++i) {
        to[2 * i] = found_u[i];
        to[2 * i + 1] = found_v[i];
      }
    }
  }
}

// Ideal pixels uv (B, N, 2), f and c (B, 2) px, distortion (B, k) float32 -> d(ideal) / d(distorted), J (B, N, 2, 2).
void undistort_jacobian(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor J, double least) {
  const int64_t B = uv.size(0), N = uv.size(1), count = distortion.size(1);
  for (int64_t k = 0; k < B; ++k) {
    const Lens lens(data<float>(distortion) + count * k, count, static_cast<float>(least));
    const float *focal = data<float>(f) + 2 * k, *centre = data<float>(c) + 2 * k;
    for (int64_t n = 0; n < N; n += LANES) {
      const int64_t some = std::min(LANES, N - n);
      Vector x, y, u, v, a, b, d;
      normalise(data<float>(uv) + 2 * (N * k + n), some, focal, centre, x, y);
      lens.distort(x, y, u, v, a, b, d);
      lens.invert(a, b, d);
      const Vector entries[4] = {focal[0] * a / focal[0], focal[0] * b / focal[1], focal[1] * b / focal[0],
                                 focal[1] * d / focal[1]};
      float* to = data<float>(J) + 4 * (N * k + n);
      for (int64_t i = 0; i < some; ++i) {
        for (int64_t e = 0; e < 4; ++e) to[4 * i + e] = entries[e][i];
      }
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "undistort(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor(a!) ideal, int iterations, float eps, "
      "float tolerance_px, float least) -> ()");
  m.def("undistort_jacobian(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor(a!) J, float least) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("undistort", TORCH_BOX(&undistort));
  m.impl("undistort_jacobian", TORCH_BOX(&undistort_jacobian));
}
