// Solutions of small positive definite systems, and the last step of a pose from near points. References: _solve in
// dhtorch/geometry/least_squares.py, _near_pose in dhtorch/stages/pose.py and is_collinear in dhtorch/geometry/ransac.py; the
// same formulas in double precision, sums in another order. One thread, no gradient. The dispatch checks dtypes and strides,
// Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

namespace {

// Lower Cholesky factor of A (n, n) in place, of whose upper half nothing is read; false where a pivot is at most `least`.
bool factor(double* A, int64_t n, double least) {
  for (int64_t j = 0; j < n; ++j) {
    double* row = A + j * n;
    double square = row[j];
    for (int64_t k = 0; k < j; ++k) square -= row[k] * row[k];
    const double pivot = std::sqrt(square);
    if (!(pivot > least)) return false;  // NaN, too
    row[j] = pivot;
    for (int64_t i = j + 1; i < n; ++i) {
      double x = A[i * n + j];
      for (int64_t k = 0; k < j; ++k) x -= A[i * n + k] * row[k];
      A[i * n + j] = x / pivot;
    }
  }
  return true;
}

// Solution of L L' x = b in place, b (n).
void substitute(const double* L, int64_t n, double* b) {
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t k = 0; k < i; ++k) b[i] -= L[i * n + k] * b[k];
    b[i] /= L[i * n + i];
  }
  for (int64_t i = n - 1; i >= 0; --i) {
    for (int64_t k = i + 1; k < n; ++k) b[i] -= L[k * n + i] * b[k];
    b[i] /= L[i * n + i];
  }
}

// Solution x (n, columns) of H x = b, H symmetric, scaled to a unit diagonal and refined once by its residual; x is zero
// and the answer false where a pivot of the scaled H is at most `least` or b is not finite.
bool solve(const double* H, const double* b, int64_t n, int64_t columns, double least, double* x) {
  std::vector<double> A(n * n), L(n * n), scale(n), right(n), first(n), rest(n);
  for (int64_t i = 0; i < n; ++i) scale[i] = H[i * n + i] > 0 ? 1 / std::sqrt(H[i * n + i]) : 1;
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t j = 0; j < n; ++j) A[i * n + j] = H[i * n + j] * (scale[i] * scale[j]);
  }
  L = A;
  bool sound = factor(L.data(), n, least);
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t c = 0; c < columns; ++c) sound = sound && std::isfinite(b[i * columns + c] * scale[i]);
  }
  std::fill_n(x, n * columns, 0.0);
  if (!sound) return false;
  for (int64_t c = 0; c < columns; ++c) {
    for (int64_t i = 0; i < n; ++i) first[i] = right[i] = b[i * columns + c] * scale[i];
    substitute(L.data(), n, first.data());
    for (int64_t i = 0; i < n; ++i) {
      double found = 0;
      for (int64_t j = 0; j < n; ++j) found += A[i * n + j] * first[j];
      rest[i] = right[i] - found;
    }
    substitute(L.data(), n, rest.data());
    for (int64_t i = 0; i < n; ++i) x[i * columns + c] = (first[i] + rest[i]) * scale[i];
  }
  return true;
}

// H (B, n, n) symmetric, b (B, n, k) float64. Outputs: x (B, n, k) and ok (B) bool, of solve().
void solve_spd(Tensor H, Tensor b, Tensor x, Tensor ok, double least) {
  const int64_t B = H.size(0), n = H.size(1), columns = b.size(2);
  for (int64_t k = 0; k < B; ++k) {
    const double *from = data<double>(H) + n * n * k, *given = data<double>(b) + n * columns * k;
    data<bool>(ok)[k] = solve(from, given, n, columns, least, data<double>(x) + n * columns * k);
  }
}

// Whether the used points (3, N) lie on one line, of is_collinear in ransac.py.
bool is_collinear(const double* xyz, const bool* used, int64_t N, double max_ratio, double min_spread) {
  std::vector<double> reach(N), of_used;
  for (int64_t n = 0; n < N; ++n) {
    reach[n] = std::max({std::fabs(xyz[n]), std::fabs(xyz[N + n]), std::fabs(xyz[2 * N + n])});
    if (used[n]) of_used.push_back(reach[n]);
  }
  const double median = lower_median(of_used, 1.0);
  double sum[3] = {}, scatter[3][3] = {}, count = 0;
  const auto counts = [&](int64_t n) { return used[n] && reach[n] <= max_ratio * median; };
  for (int64_t n = 0; n < N; ++n) {
    if (!counts(n)) continue;
    for (int i = 0; i < 3; ++i) sum[i] += xyz[i * N + n];
    count += 1;
  }
  for (double& x : sum) x /= std::max(count, 1.0);
  for (int64_t n = 0; n < N; ++n) {
    if (!counts(n)) continue;
    const double x[3] = {xyz[n] - sum[0], xyz[N + n] - sum[1], xyz[2 * N + n] - sum[2]};
    for (int i = 0; i < 3; ++i) {
      for (int j = 0; j < 3; ++j) scatter[i][j] += x[i] * x[j];
    }
  }
  double trace = 0, squares = 0;
  for (int i = 0; i < 3; ++i) {
    trace += scatter[i][i];
    for (int j = 0; j < 3; ++j) squares += scatter[i][j] * scatter[i][j];
  }
  const double limit = min_spread * trace;
  return 0.5 * (trace * trace - squares) <= limit * limit;
}

// Near points of one pair, in double precision, and the limits of _near_pose in pose.py.
struct NearPoints {
  int64_t N;
  std::vector<double> values;  // x, y, z, u, v (5, N)
  double f[2], c[2], square_limit, min_depth;

  NearPoints(const float* points, int64_t N, const float* lens, const float* middle, double threshold, double min_depth)
      : N(N), values(points, points + 5 * N), f{lens[0], lens[1]}, c{middle[0], middle[1]},
        square_limit(threshold * threshold), min_depth(min_depth) {}

  // Inliers of a pose; adds their J'J and J'r to H (6, 6) and g (6) and returns the sum of their squared residuals.
  double add_up(const double* R, const double* t, const bool* usable, bool* inlier, double* H, double* g) const {
    const double *x = values.data(), *y = x + N, *z = y + N, *u = z + N, *v = u + N;
    double total = 0;
    for (int64_t n = 0; n < N; ++n) {
      double Y[3];
      for (int i = 0; i < 3; ++i) Y[i] = t[i] + R[3 * i] * x[n] + R[3 * i + 1] * y[n] + R[3 * i + 2] * z[n];
      const double w = 1 / std::max(Y[2], min_depth), a = Y[0] * w, b = Y[1] * w;
      const double r[2] = {(a - (u[n] - c[0]) / f[0]) * f[0], (b - (v[n] - c[1]) / f[1]) * f[1]};
      const double square = r[0] * r[0] + r[1] * r[1];
      inlier[n] = usable[n] && Y[2] > min_depth && square < square_limit;
      if (!inlier[n]) continue;
      total += square;
      const double J[2][6] = {{-a * b * f[0], (1 + a * a) * f[0], -b * f[0], w * f[0], 0, -a * w * f[0]},
                              {(-1 - b * b) * f[1], a * b * f[1], a * f[1], 0, w * f[1], -b * w * f[1]}};
      for (int i = 0; i < 6; ++i) {
        for (int j = i; j < 6; ++j) H[6 * i + j] += J[0][i] * J[0][j] + J[1][i] * J[1][j];
        g[i] += J[0][i] * r[0] + J[1][i] * r[1];
      }
    }
    for (int i = 0; i < 6; ++i) {
      for (int j = 0; j < i; ++j) H[6 * i + j] = H[6 * j + i];
    }
    return total;
  }
};

// Length of t in standard deviations of unit noise under the information H (6, 6), the rotation eliminated.
double whitened_length(const double* H, const double* t) {
  double L[36], total = 0;
  std::copy_n(H, 36, L);
  if (!factor(L, 6, 0)) return 0;
  for (int j = 3; j < 6; ++j) {
    double x = 0;
    for (int i = j; i < 6; ++i) x += L[6 * i + j] * t[i - 3];
    total += x * x;
  }
  return std::sqrt(total);
}

// points (B, 5, N), usable (B, N) bool, f and c (B, 2) px float32; start_R (B, 3, 3), start_t (B, 3) float64, valid (B) bool:
// of robust_pose. Outputs, fields of PoseFit: R, t, cov (B, 6, 6), rms, sigma, t_snr float32, inlier bool, n_inlier int64,
// code int32.
void pose_last_step(Tensor points, Tensor usable, Tensor f, Tensor c, Tensor start_R, Tensor start_t, Tensor valid, Tensor R,
                    Tensor t, Tensor cov, Tensor inlier, Tensor n_inlier, Tensor rms, Tensor sigma, Tensor t_snr, Tensor code,
                    double threshold_px, int64_t min_inlier, double min_sigma, double min_depth, double min_pivot,
                    double max_ratio, double min_spread) {
  const int64_t B = points.size(0), N = points.size(2);
  const float nan = std::numeric_limits<float>::quiet_NaN();
  for (int64_t k = 0; k < B; ++k) {
    const NearPoints near(data<float>(points) + 5 * N * k, N, data<float>(f) + 2 * k, data<float>(c) + 2 * k, threshold_px,
                          min_depth);
    const bool* use = data<bool>(usable) + N * k;
    bool* in = data<bool>(inlier) + N * k;
    double turn[9], shift[3], H[36] = {}, g[6] = {}, right[42] = {}, x[42];
    std::copy_n(data<double>(start_R) + 9 * k, 9, turn);
    std::copy_n(data<double>(start_t) + 3 * k, 3, shift);
    const double total = near.add_up(turn, shift, use, in, H, g);
    if (!data<bool>(valid)[k]) std::fill_n(in, N, false);
    for (int i = 0; i < 6; ++i) {
      right[7 * i] = -g[i];
      right[7 * i + 1 + i] = 1;
    }
    const bool solved = solve(H, right, 6, 7, min_pivot, x);
    double xi[6];
    for (int i = 0; i < 6; ++i) xi[i] = x[7 * i];
    move_pose(turn, shift, xi);
    bool finite = true;
    for (double value : turn) finite = finite && std::isfinite(value);
    for (double value : shift) finite = finite && std::isfinite(value);
    const int64_t n = std::count(in, in + N, true), n_usable = std::count(use, use + N, true);
    const bool enough = n >= min_inlier, line = is_collinear(near.values.data(), enough ? in : use, N, max_ratio, min_spread);
    const bool sound = solved && finite;
    const int32_t why = n_usable < min_inlier ? POSECODE_TOO_FEW
                        : line                ? POSECODE_DEGENERATE
                        : !enough             ? POSECODE_TOO_FEW
                        : !sound              ? POSECODE_DEGENERATE
                                              : POSECODE_OK;
    const bool ok = why == POSECODE_OK;
    const double noise = std::max(std::sqrt(total / static_cast<double>(std::max<int64_t>(2 * n - 6, 1))), min_sigma);
    const auto answer = [&](double value) { return ok ? static_cast<float>(value) : nan; };
    for (int i = 0; i < 9; ++i) data<float>(R)[9 * k + i] = answer(turn[i]);
    for (int i = 0; i < 3; ++i) data<float>(t)[3 * k + i] = answer(shift[i]);
    for (int i = 0; i < 6; ++i) {
      for (int j = 0; j < 6; ++j) {
        data<float>(cov)[36 * k + 6 * i + j] = answer((x[7 * i + 1 + j] + x[7 * j + 1 + i]) * (0.5 * noise * noise));
      }
    }
    data<int64_t>(n_inlier)[k] = n;
    data<float>(rms)[k] = answer(std::sqrt(total / static_cast<double>(std::max<int64_t>(n, 1))));
    data<float>(sigma)[k] = answer(noise);
    data<float>(t_snr)[k] = answer(whitened_length(H, shift) / noise);
    data<int32_t>(code)[k] = why;
    if (!ok) std::fill_n(in, N, false);
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def("solve_spd(Tensor H, Tensor b, Tensor(a!) x, Tensor(b!) ok, float least) -> ()");
  m.def(
      "pose_last_step(Tensor points, Tensor usable, Tensor f, Tensor c, Tensor start_R, Tensor start_t, Tensor valid, "
      "Tensor(a!) R, Tensor(b!) t, Tensor(c!) cov, Tensor(d!) inlier, Tensor(e!) n_inlier, Tensor(f!) rms, "
      "Tensor(g!) sigma, Tensor(h!) t_snr, Tensor(i!) code, float threshold_px, int min_inlier, float min_sigma, "
      "float min_depth, float min_pivot, float max_ratio, float min_spread) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("solve_spd", TORCH_BOX(&solve_spd));
  m.impl("pose_last_step", TORCH_BOX(&pose_last_step));
}
