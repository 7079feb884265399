// Pixels of a distorted image -> ideal pixels, the Jacobian of this map, and tracks in ideal pixels. References: _undistort
// and _undistort_jacobian in dhtorch/geometry/camera.py, _undistort_tracks in dhtorch/pipeline/pair.py; the same Newton steps
// in the same order of operations. One thread, no gradient. The dispatch checks dtypes, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>

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

// Coordinates of LANES pixels, or fewer at the end, from pairs of numbers.
inline void split(const float* uv, int64_t count, Vector& u, Vector& v) {
  float across[LANES] = {}, along[LANES] = {};
  for (int64_t i = 0; i < count; ++i) {
    across[i] = uv[2 * i];
    along[i] = uv[2 * i + 1];
  }
  u = load(across);
  v = load(along);
}

inline void join(Vector u, Vector v, int64_t count, float* uv) {
  for (int64_t i = 0; i < count; ++i) {
    uv[2 * i] = u[i];
    uv[2 * i + 1] = v[i];
  }
}

// Limits of the Newton steps: their number, the square of a step after which a point stops, and the distance (px) at which
// it has converged.
struct Limits {
  int64_t iterations;
  float stop, tolerance;
};

// One camera: focal lengths and principal point (px), and its lens unless `straight`.
struct Camera {
  const float *f, *c;
  bool straight;
  Lens lens;

  Camera(const Tensor& focal, const Tensor& centre, const Tensor& distortion, int64_t k, double least)
      : f(data<float>(focal) + 2 * k), c(data<float>(centre) + 2 * k), straight(distortion.size(0) == 0),
        lens(straight ? nullptr : data<float>(distortion) + distortion.size(1) * k, straight ? 0 : distortion.size(1),
             static_cast<float>(least)) {}

  // Ideal pixels of u, v; NaN where the steps do not return to the pixel.
  void undistort(Vector u, Vector v, const Limits& by, Vector& ideal_u, Vector& ideal_v) const {
    if (straight) {
      ideal_u = u;
      ideal_v = v;
      return;
    }
    const Vector none = Vector{}, nan = none + __builtin_nanf(""), to_u = (u - c[0]) / f[0], to_v = (v - c[1]) / f[1];
    const float longest = std::max(f[0], f[1]);
    Vector x = to_u, y = to_v, dx, dy, a, b, d;
    Bits moving = none == 0.0f;
    for (int64_t step = 0; step < by.iterations && any(moving); ++step) {
      lens.newton(x, y, to_u, to_v, dx, dy);
      x = moving ? x + dx : x;
      y = moving ? y + dy : y;
      moving = moving & (dx * dx + dy * dy > by.stop);
    }
    lens.distort(x, y, u, v, a, b, d);
    const Bits converged =
        (magnitude(u - to_u) * longest < by.tolerance) & (magnitude(v - to_v) * longest < by.tolerance);
    x = converged ? x : none;
    y = converged ? y : none;
    lens.newton(x, y, converged ? to_u : none, converged ? to_v : none, dx, dy);
    ideal_u = converged ? (x + dx) * f[0] + c[0] : nan;
    ideal_v = converged ? (y + dy) * f[1] + c[1] : nan;
  }

  // Entries of d(ideal) / d(distorted) at ideal pixels u, v.
  void jacobian(Vector u, Vector v, Vector (&J)[2][2]) const {
    J[0][0] = J[1][1] = Vector{} + 1.0f;
    J[0][1] = J[1][0] = Vector{};
    if (straight) return;
    Vector away_u, away_v, a, b, d;
    lens.distort((u - c[0]) / f[0], (v - c[1]) / f[1], away_u, away_v, a, b, d);
    lens.invert(a, b, d);
    J[0][0] = f[0] * a / f[0];
    J[0][1] = f[0] * b / f[1];
    J[1][0] = f[1] * b / f[0];
    J[1][1] = f[1] * d / f[1];
  }
};

// Call `each` with a camera, LANES of its pixels uv (B, N, 2), the number of the first, and how many they are.
template <typename Each>
void over_pixels(const Tensor& uv, const Tensor& f, const Tensor& c, const Tensor& distortion, double least, Each each) {
  const int64_t B = uv.size(0), N = uv.size(1);
  for (int64_t k = 0; k < B; ++k) {
    const Camera camera(f, c, distortion, k, least);
    for (int64_t n = 0; n < N; n += LANES) {
      const int64_t some = std::min(LANES, N - n), at = N * k + n;
      Vector u, v;
      split(data<float>(uv) + 2 * at, some, u, v);
      each(camera, u, v, at, some);
    }
  }
}

// uv (B, N, 2) px, f and c (B, 2) px, distortion (B, k) float32 -> ideal (B, N, 2) px, NaN where the steps, at most
// `iterations`, do not return to the pixel within `tolerance_px`. A point stops after a step whose square is at most eps.
void undistort(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor ideal, int64_t iterations, double eps,
               double tolerance_px, double least) {
  const Limits limits = {iterations, static_cast<float>(eps), static_cast<float>(tolerance_px)};
  over_pixels(uv, f, c, distortion, least, [&](const Camera& camera, Vector u, Vector v, int64_t at, int64_t some) {
    camera.undistort(u, v, limits, u, v);
    join(u, v, some, data<float>(ideal) + 2 * at);
  });
}

// The same pixels, distortion (B, k) or (0, 0) -> rays (B, N, 3), z = 1.
void rays(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor ray, int64_t iterations, double eps, double tolerance_px,
          double least) {
  const Limits limits = {iterations, static_cast<float>(eps), static_cast<float>(tolerance_px)};
  over_pixels(uv, f, c, distortion, least, [&](const Camera& camera, Vector u, Vector v, int64_t at, int64_t some) {
    camera.undistort(u, v, limits, u, v);
    u = (u - camera.c[0]) / camera.f[0];
    v = (v - camera.c[1]) / camera.f[1];
    float* to = data<float>(ray) + 3 * at;
    for (int64_t i = 0; i < some; ++i) {
      to[3 * i] = u[i];
      to[3 * i + 1] = v[i];
      to[3 * i + 2] = 1.0f;
    }
  });
}

// Ideal pixels uv (B, N, 2), f and c (B, 2) px, distortion (B, k) float32 -> d(ideal) / d(distorted), J (B, N, 2, 2).
void undistort_jacobian(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor J, double least) {
  over_pixels(uv, f, c, distortion, least, [&](const Camera& camera, Vector u, Vector v, int64_t at, int64_t some) {
    Vector entries[2][2];
    camera.jacobian(u, v, entries);
    float* to = data<float>(J) + 4 * at;
    for (int64_t i = 0; i < some; ++i) {
      for (int64_t e = 0; e < 4; ++e) to[4 * i + e] = entries[e / 2][e % 2][i];
    }
  });
}

// Covariance cov (2, 2) carried by J, of undistort_tracks in pair.py: entries that are not finite stay as they are.
void carry(const float J[2][2], const float* cov, float* to) {
  float C[4], JC[2][2];
  for (int e = 0; e < 4; ++e) C[e] = std::isfinite(cov[e]) ? cov[e] : 0.0f;
  for (int i = 0; i < 2; ++i) {
    for (int j = 0; j < 2; ++j) JC[i][j] = J[i][0] * C[j] + J[i][1] * C[2 + j];
  }
  for (int e = 0; e < 4; ++e) {
    const float moved = JC[e / 2][0] * J[e % 2][0] + JC[e / 2][1] * J[e % 2][1];
    to[e] = std::isfinite(cov[e]) ? moved : cov[e];
  }
}

// Tracks uv_0, uv_1 (B, N, 2) px, cov (B, N, 2, 2) px^2, valid (B, N) bool, and the intrinsics of both cameras, distortion
// (B, k) or (0, 0), float32. Outputs: the same in ideal pixels; outside of a lens's model unchanged and not valid.
void undistort_tracks(Tensor uv_0, Tensor uv_1, Tensor cov, Tensor valid, Tensor f_0, Tensor c_0, Tensor distortion_0,
                      Tensor f_1, Tensor c_1, Tensor distortion_1, Tensor ideal_0, Tensor ideal_1, Tensor ideal_cov,
                      Tensor in_model, int64_t iterations, double eps, double tolerance_px, double least) {
  const int64_t B = uv_0.size(0), N = uv_0.size(1);
  const Limits limits = {iterations, static_cast<float>(eps), static_cast<float>(tolerance_px)};
  const Vector none = Vector{};
  for (int64_t k = 0; k < B; ++k) {
    const Camera cameras[2] = {{f_0, c_0, distortion_0, k, least}, {f_1, c_1, distortion_1, k, least}};
    for (int64_t n = 0; n < N; n += LANES) {
      const int64_t some = std::min(LANES, N - n), at = N * k + n;
      const Tensor *from[2] = {&uv_0, &uv_1}, *to[2] = {&ideal_0, &ideal_1};
      Vector seen[2][2], ideal[2][2], J[2][2];
      Bits sound = none == 0.0f;
      for (int view = 0; view < 2; ++view) {
        split(data<float>(*from[view]) + 2 * at, some, seen[view][0], seen[view][1]);
        for (const Vector& x : seen[view]) sound = sound & (x - x == 0.0f);
      }
      for (int view = 0; view < 2; ++view) {
        const Camera& camera = cameras[view];
        Vector start[2];
        for (int i = 0; i < 2; ++i) start[i] = sound ? seen[view][i] : none + camera.c[i];
        camera.undistort(start[0], start[1], limits, ideal[view][0], ideal[view][1]);
      }
      for (const auto& view : ideal) {
        for (const Vector& x : view) sound = sound & (x - x == 0.0f);
      }
      for (int view = 0; view < 2; ++view) {
        for (int i = 0; i < 2; ++i) ideal[view][i] = sound ? ideal[view][i] : seen[view][i];
        join(ideal[view][0], ideal[view][1], some, data<float>(*to[view]) + 2 * at);
      }
      cameras[1].jacobian(sound ? ideal[1][0] : none + cameras[1].c[0], sound ? ideal[1][1] : none + cameras[1].c[1], J);
      for (int64_t i = 0; i < some; ++i) {
        const float entries[2][2] = {{J[0][0][i], J[0][1][i]}, {J[1][0][i], J[1][1][i]}};
        carry(entries, data<float>(cov) + 4 * (at + i), data<float>(ideal_cov) + 4 * (at + i));
        data<bool>(in_model)[at + i] = data<bool>(valid)[at + i] && sound[i] != 0;
      }
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "undistort(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor(a!) ideal, int iterations, float eps, "
      "float tolerance_px, float least) -> ()");
  m.def(
      "rays(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor(a!) ray, int iterations, float eps, "
      "float tolerance_px, float least) -> ()");
  m.def(
      "undistort_tracks(Tensor uv_0, Tensor uv_1, Tensor cov, Tensor valid, Tensor f_0, Tensor c_0, Tensor distortion_0, "
      "Tensor f_1, Tensor c_1, Tensor distortion_1, Tensor(a!) ideal_0, Tensor(b!) ideal_1, Tensor(c!) ideal_cov, "
      "Tensor(d!) in_model, int iterations, float eps, float tolerance_px, float least) -> ()");
  m.def("undistort_jacobian(Tensor uv, Tensor f, Tensor c, Tensor distortion, Tensor(a!) J, float least) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("undistort", TORCH_BOX(&undistort));
  m.impl("rays", TORCH_BOX(&rays));
  m.impl("undistort_tracks", TORCH_BOX(&undistort_tracks));
  m.impl("undistort_jacobian", TORCH_BOX(&undistort_jacobian));
}
