// Cost and normal equations of near and far tracks, their minimum, squared residuals, and noise. References:
// dhtorch/geometry/reprojection_problem.py and estimate_noise_variance of map_estimate.py; the same formulas and steps, 16 or 8 tracks per vector, and sums over tracks in another
// order. One thread, no gradient. The dispatch checks dtypes and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

inline Vector root(Vector x) {
  float part[LANES];
  store(x, part);
  for (int64_t i = 0; i < LANES; ++i) part[i] = std::sqrt(part[i]);
  return load(part);
}

// Limits of a track: the factor by which a far one may be nearer than the nearest return, the squared residual of a
// point behind the camera, and the least depth (m).
struct Limits {
  float nearest_divisor, behind, min_depth;

  Limits(double nearest_divisor, double behind, double min_depth)
      : nearest_divisor(static_cast<float>(nearest_divisor)), behind(static_cast<float>(behind)),
        min_depth(static_cast<float>(min_depth)) {}
};

// The tracks of one pair, N a multiple of LANES, and the unknowns.
struct Tracks {
  Limits limits;
  int64_t N;
  const float *ray, *seen, *height, *shape, *inverse, *variance, *a, *b, *d;
  const bool* near;
  float nearest, R[3][3], t[3], turn[3];
  bool turns;
};

// LANES tracks from index `n` on, linearised and whitened.
struct Whitened {
  Bits front;
  Vector height, square, r[2];  // residuals along the two axes
  Vector x, y, k, m0[2], m1[2];

  Whitened(const Tracks& of, int64_t n) {
    const int64_t N = of.N;
    const Vector none = Vector{}, one = none + 1.0f;
    const Vector X = load(of.ray + n), Y = load(of.ray + N + n), Z = load(of.ray + 2 * N + n);
    Vector p[3], u = load(of.seen + n), v = load(of.seen + N + n);
    for (int i = 0; i < 3; ++i) p[i] = of.R[i][0] * X + of.R[i][1] * Y + of.R[i][2] * Z;
    height = load(of.height + n);
    if (of.turns) {
      const float *by = of.turn;
      const Vector ahead = one - height * (by[0] * v - by[1] * u);
      const Vector z = (ahead < 0.1f) & (ahead > -0.1f) ? none + 0.1f : ahead;
      const Vector across = u - height * (by[1] - by[2] * v), along = v - height * (by[2] * u - by[0]);
      u = across / z;
      v = along / z;
    }
    Bits near;
    for (int64_t i = 0; i < LANES; ++i) near[i] = of.near[n + i] ? -1 : 0;
    const Vector xx = load(of.shape + n), xy = load(of.shape + N + n), yy = load(of.shape + 2 * N + n);
    // Maximum-likelihood inverse depth of a track without one.
    const float *t = of.t;
    const Vector l0 = t[1] * p[2] - t[2] * p[1], l1 = t[2] * p[0] - t[0] * p[2], l2 = t[0] * p[1] - t[1] * p[0];
    const Vector n0 = xx * l0 + xy * l1, n1 = xy * l0 + yy * l1, size = l0 * n0 + l1 * n1;
    const Vector lift = (l0 * u + l1 * v + l2) / (size < 1e-30f ? none + 1e-30f : size);
    const Vector u1 = u - lift * n0, v1 = v - lift * n1;
    const Vector d0 = t[0] - t[2] * u1, d1 = t[1] - t[2] * v1, long_ = d0 * d0 + d1 * d1;
    const Vector free = -((p[0] - p[2] * u1) * d0 + (p[1] - p[2] * v1) * d1) / (long_ < 1e-24f ? none + 1e-24f : long_);
    const Vector q = near ? load(of.inverse + n) : (free < 0.0f ? none : free);
    const Bits open = ~near & ~(free < 0.0f);  // q is unconstrained
    const Vector variance = near ? load(of.variance + n) : none;

    const Vector depth = p[2] + q * t[2];
    front = (depth > of.limits.min_depth) & (near | (q < of.limits.nearest_divisor * of.nearest));
    const Vector w = 1.0f / (front ? depth : one);
    x = (p[0] + q * t[0]) * w;
    y = (p[1] + q * t[1]) * w;
    k = q * w;
    const Vector s0 = (t[0] - x * t[2]) * w, s1 = (t[1] - y * t[2]) * w;
    const Vector a = load(of.a + n), b = load(of.b + n), d = load(of.d + n), bd = b * d;
    Vector e0 = a * s0, e1 = d * (s1 - b * s0);
    const Vector slope = e0 * e0 + e1 * e1;
    const Bits flat = slope < 1e-12f;
    const Vector unit = 1.0f / root(flat ? one : slope);
    e0 = flat ? one : e0 * unit;
    e1 = flat ? none : e1 * unit;
    const Vector left = open & ~flat ? none : 1.0f / root(1.0f + slope * variance);
    m0[0] = left * (e0 * a - e1 * bd);
    m0[1] = -e1 * a - e0 * bd;
    m1[0] = left * e1 * d;
    m1[1] = e0 * d;
    for (int i = 0; i < 2; ++i) r[i] = m0[i] * (x - u) + m1[i] * (y - v);
    square = front ? r[0] * r[0] + r[1] * r[1] : none + of.limits.behind;
  }
};

// The robust cost, and with `columns` the upper half of J'WJ and J'Wr row by row; n = 6, or 9 with a shutter's turn.
template <int n, bool columns>
float sums(const Tracks& of, const float* share, float bend, float* found) {
  constexpr int COUNT = n * (n + 3) / 2;
  Vector all = Vector{}, part[COUNT] = {};
  const Vector none = Vector{};
  for (int64_t m = 0; m < of.N; m += LANES) {
    const Whitened at(of, m);
    const Vector weight = load(share + m), bent = 1.0f + at.square / (bend * bend);
    all += weight * (at.square / bent);
    if (!columns) continue;
    const Vector W = at.front ? weight / (bent * bent) : none;
    const Vector x = at.x, y = at.y, k = at.k;
    const Vector u[6] = {-x * y, 1.0f + x * x, -y, k, none, -x * k}, v[6] = {-1.0f - y * y, x * y, x, none, k, -y * k};
    Vector J[2][n];
    for (int i = 0; i < 2; ++i) {
      for (int j = 0; j < 6; ++j) J[i][j] = at.m0[i] * u[j] + at.m1[i] * v[j];
      for (int j = 6; j < n; ++j) J[i][j] = J[i][j - 6] * at.height;
    }
    Vector* to = part;
    for (int i = 0; i < n; ++i) {
      const Vector first = W * J[0][i], second = W * J[1][i];
      for (int j = i; j < n; ++j) *to++ += first * J[0][j] + second * J[1][j];
      *to++ += first * at.r[0] + second * at.r[1];
    }
  }
  if (columns) {
    for (int i = 0; i < COUNT; ++i) found[i] = total(part[i]);
  }
  return total(all);
}

template <int n>
float equations(const Tracks& of, const float* share, float bend, float* H, float* g) {
  if (!H) return sums<n, false>(of, share, bend, nullptr);
  float found[n * (n + 3) / 2], *from = found;
  const float cost = sums<n, true>(of, share, bend, found);
  for (int i = 0; i < n; ++i) {
    for (int j = i; j < n; ++j) H[i * n + j] = H[j * n + i] = *from++;
    g[i] = *from++;
  }
  return cost;
}

Tracks pair(int64_t k, const Limits& limits, const Tensor& ray, const Tensor& inverse, const Tensor& near, const Tensor& seen,
            const Tensor& shape, const Tensor& height, const Tensor& nearest, const Tensor& variance, const Tensor& a,
            const Tensor& b, const Tensor& d, const Tensor& R, const Tensor& t, const Tensor& turn) {
  const int64_t N = ray.size(2);
  Tracks of = {limits};
  of.N = N;
  of.ray = data<float>(ray) + 3 * N * k;
  of.seen = data<float>(seen) + 2 * N * k;
  of.height = data<float>(height) + N * k;
  of.shape = data<float>(shape) + 3 * N * k;
  of.inverse = data<float>(inverse) + N * k;
  of.variance = data<float>(variance) + N * k;
  of.near = data<bool>(near) + N * k;
  of.nearest = data<float>(nearest)[k];
  of.a = data<float>(a) + N * k;
  of.b = data<float>(b) + N * k;
  of.d = data<float>(d) + N * k;
  of.turns = turn.size(0) > 0;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) of.R[i][j] = data<float>(R)[9 * k + 3 * i + j];
    of.t[i] = data<float>(t)[3 * k + i];
    of.turn[i] = of.turns ? data<float>(turn)[3 * k + i] : 0.0f;
  }
  return of;
}

// Tensors of _track_tensors in reprojection_problem.py: ray (B, 3, N), inverse, near (B, N), seen (B, 2, N), shape
// (B, 3, N), height (B, N), nearest (B, 1), variance, a, b, d (B, N), R (B, 3, 3), t (B, 3), turn (B, 3), or (0, 3) without
// one; share (B, N): weight of a track in the cost. near is bool, all others float32. Outputs: cost (B), H (B, n, n) and
// g (B, n), which are not computed where their leading dimension is 0.
void pose_normal_equations(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest,
                           Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor share,
                           Tensor cost, Tensor H, Tensor g, double bend, double nearest_divisor, double behind,
                           double min_depth) {
  const int64_t B = ray.size(0), N = ray.size(2), n = turn.size(0) > 0 ? 9 : 6;
  const Limits limits(nearest_divisor, behind, min_depth);
  for (int64_t k = 0; k < B; ++k) {
    const Tracks of = pair(k, limits, ray, inverse, near, seen, shape, height, nearest, variance, a, b, d, R, t, turn);
    float *to = H.size(0) ? data<float>(H) + n * n * k : nullptr, *right = to ? data<float>(g) + n * k : nullptr;
    const float *weight = data<float>(share) + N * k, by = static_cast<float>(bend);
    data<float>(cost)[k] = of.turns ? equations<9>(of, weight, by, to, right) : equations<6>(of, weight, by, to, right);
  }
}

// The same tensors. Outputs: squared whitened residuals (B, N), and which tracks are in front (B, N) bool.
void squared_residuals(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest,
                       Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor square,
                       Tensor front, double nearest_divisor, double behind, double min_depth) {
  const int64_t B = ray.size(0), N = ray.size(2);
  const Limits limits(nearest_divisor, behind, min_depth);
  for (int64_t k = 0; k < B; ++k) {
    const Tracks of = pair(k, limits, ray, inverse, near, seen, shape, height, nearest, variance, a, b, d, R, t, turn);
    for (int64_t m = 0; m < N; m += LANES) {
      const Whitened at(of, m);
      store(at.square, data<float>(square) + N * k + m);
      for (int64_t i = 0; i < LANES; ++i) data<bool>(front)[N * k + m + i] = at.front[i] != 0;
    }
  }
}

// Solution of H x = -g, n equations, by elimination with row pivoting; false where a pivot is zero.
template <int n>
bool eliminate(const float* H, const float* g, double* x) {
  double A[n][n + 1];
  for (int i = 0; i < n; ++i) {
    std::copy_n(H + i * n, n, A[i]);
    A[i][n] = -static_cast<double>(g[i]);
  }
  for (int k = 0; k < n; ++k) {
    int row = k;
    for (int i = k + 1; i < n; ++i) row = std::fabs(A[i][k]) > std::fabs(A[row][k]) ? i : row;
    if (A[row][k] == 0) return false;
    if (row != k) std::swap_ranges(A[k], A[k] + n + 1, A[row]);
    for (int i = k + 1; i < n; ++i) {
      const double share = A[i][k] / A[k][k];
      for (int j = k + 1; j <= n; ++j) A[i][j] -= share * A[k][j];
    }
  }
  for (int i = n - 1; i >= 0; --i) {
    x[i] = A[i][n];
    for (int j = i + 1; j < n; ++j) x[i] -= A[i][j] * x[j];
    x[i] /= A[i][i];
  }
  return true;
}

// The unknowns displaced, by retract_unknowns of reprojection_problem.py.
template <int n>
void displace(Tracks& of, const double* step) {
  float xi[n];
  for (int i = 0; i < n; ++i) xi[i] = static_cast<float>(step[i]);
  const float half[3] = {0.5f * xi[0], 0.5f * xi[1], 0.5f * xi[2]};
  const float by = 2.0f / (1.0f + (half[0] * half[0] + half[1] * half[1] + half[2] * half[2]));
  const auto cross = [&](const float* b, float* c) {
    for (int i = 0; i < 3; ++i) c[i] = half[(i + 1) % 3] * b[(i + 2) % 3] - half[(i + 2) % 3] * b[(i + 1) % 3];
  };
  for (int c = 0; c < 4; ++c) {
    float column[3], once[3], twice[3];
    for (int i = 0; i < 3; ++i) column[i] = c < 3 ? of.R[i][c] : of.t[i];
    cross(column, once);
    cross(once, twice);
    for (int i = 0; i < 3; ++i) {
      const float x = column[i] + (once[i] + twice[i]) * by;
      (c < 3 ? of.R[i][c] : of.t[i]) = c < 3 ? x : x + xi[3 + i];
    }
  }
  for (int i = 6; i < n; ++i) of.turn[i - 6] += xi[i];
}

// How a cost is minimised: the weight of each track and its robust kernel's bend, the precision of the shutter rate's
// prior, proposals, initial damping, and whether the translation stays.
struct Search {
  const float* share;
  float bend, precision;
  int64_t steps;
  float damping;
  bool rotation_only;
};

// Cost with the prior, and with H its normal equations.
template <int n>
float evaluate(const Tracks& of, const Search& by, float* H, float* g) {
  float cost = equations<n>(of, by.share, by.bend, H, g), square = 0.0f;
  for (int i = 6; i < n; ++i) {
    const float rate = of.turn[i - 6];
    square += rate * rate;
    if (H) {
      H[i * n + i] += by.precision;
      g[i] += by.precision * rate;
    }
  }
  for (int i = 3; H && by.rotation_only && i < 6; ++i) {
    for (int j = 0; j < n; ++j) H[i * n + j] = H[j * n + i] = 0.0f;
    H[i * n + i] = 1.0f;
    g[i] = 0.0f;
  }
  return n > 6 ? cost + by.precision * square : cost;
}

// minimise of least_squares.py; leaves the best unknowns and returns their cost.
template <int n>
float minimise(Tracks& of, const Search& by) {
  float H[n * n], g[n], next_H[n * n], next_g[n], damped[n * n], factor = by.damping;
  if (!by.steps) return evaluate<n>(of, by, nullptr, nullptr);
  float best = evaluate<n>(of, by, H, g);
  for (int64_t k = 0; k < by.steps; ++k) {
    const bool last = k == by.steps - 1;
    double step[n];
    std::copy_n(H, n * n, damped);
    for (int i = 0; i < n; ++i) damped[i * n + i] *= 1.0f + factor;
    Tracks proposal = of;
    bool accepted = eliminate<n>(damped, g, step);
    if (accepted) {
      displace<n>(proposal, step);
      const float cost = evaluate<n>(proposal, by, last ? nullptr : next_H, next_g);
      accepted = cost < best;
      best = accepted ? cost : best;
    }
    factor *= accepted ? 0.1f : 10.0f;
    if (!accepted) continue;
    of = proposal;
    std::copy_n(next_H, n * n, H);
    std::copy_n(next_g, n, g);
  }
  return best;
}

// The same tensors, precision (B): of the shutter rate's prior. Outputs: the best unknowns R (B, 3, 3), t (B, 3) and turn
// (B, 3), or (0, 3), and their cost (B).
void minimise_tracks(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest,
                     Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor share,
                     Tensor precision, Tensor best_R, Tensor best_t, Tensor best_turn, Tensor cost, int64_t steps,
                     double damping, bool rotation_only, double bend, double nearest_divisor, double behind,
                     double min_depth) {
  const int64_t B = ray.size(0), N = ray.size(2);
  const Limits limits(nearest_divisor, behind, min_depth);
  for (int64_t k = 0; k < B; ++k) {
    Tracks of = pair(k, limits, ray, inverse, near, seen, shape, height, nearest, variance, a, b, d, R, t, turn);
    const Search by{data<float>(share) + N * k, static_cast<float>(bend), data<float>(precision)[k], steps,
                    static_cast<float>(damping), rotation_only};
    data<float>(cost)[k] = of.turns ? minimise<9>(of, by) : minimise<6>(of, by);
    for (int i = 0; i < 3; ++i) {
      std::copy_n(of.R[i], 3, data<float>(best_R) + 9 * k + 3 * i);
      data<float>(best_t)[3 * k + i] = of.t[i];
      if (of.turns) data<float>(best_turn)[3 * k + i] = of.turn[i];
    }
  }
}

// Lower median of values, which are reordered; 1 without one.
float median(std::vector<float>& values) {
  if (values.empty()) return 1.0f;
  const auto middle = values.begin() + (values.size() - 1) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// The same tensors without the noise's factors; far (B, N) bool. Output: noise (B, N), after `rounds` estimates from the
// medians of near and far residuals, each divided by that of unit noise, within [low, high].
void track_noise(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest,
                 Tensor variance, Tensor far, Tensor R, Tensor t, Tensor turn, Tensor noise, int64_t rounds,
                 double near_median, double far_median, double low, double high, double nearest_divisor, double behind,
                 double min_depth) {
  const int64_t B = ray.size(0), N = ray.size(2);
  const Limits limits(nearest_divisor, behind, min_depth);
  std::vector<float> a(N), b(N), d(N), of_near, of_far;
  for (int64_t k = 0; k < B; ++k) {
    Tracks of = pair(k, limits, ray, inverse, near, seen, shape, height, nearest, variance, variance, variance, variance, R, t, turn);
    of.a = a.data();
    of.b = b.data();
    of.d = d.data();
    const bool* distant = data<bool>(far) + N * k;
    float found[2] = {1.0f, 1.0f};  // variances of near and far tracks
    for (int64_t round = 0; round < rounds; ++round) {
      for (int64_t n = 0; n < N; ++n) {
        const float by = found[distant[n]], xx = of.shape[n] * by, xy = of.shape[N + n] * by, yy = of.shape[2 * N + n] * by;
        b[n] = xy / xx;
        a[n] = 1.0f / std::sqrt(xx);
        d[n] = 1.0f / std::sqrt(yy - b[n] * xy);
      }
      of_near.clear();
      of_far.clear();
      bool any_far = false;
      for (int64_t n = 0; n < N; n += LANES) {
        const Whitened at(of, n);
        for (int64_t i = 0; i < LANES; ++i) {
          any_far = any_far || distant[n + i];
          if (!at.front[i] || std::isnan(at.square[i])) continue;
          if (of.near[n + i]) of_near.push_back(at.square[i]);
          if (distant[n + i]) of_far.push_back(at.square[i]);
        }
      }
      const float close = std::sqrt(median(of_near)) / static_cast<float>(near_median);
      const float factor[2] = {close, any_far ? std::sqrt(median(of_far)) / static_cast<float>(far_median) : close};
      for (int i = 0; i < 2; ++i) {
        found[i] = std::clamp(found[i] * factor[i] * factor[i], static_cast<float>(low), static_cast<float>(high));
      }
    }
    for (int64_t n = 0; n < N; ++n) data<float>(noise)[N * k + n] = found[distant[n]];
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "pose_normal_equations(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, "
      "Tensor nearest, Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor share, "
      "Tensor(a!) cost, Tensor(b!) H, Tensor(c!) g, float bend, float nearest_divisor, float behind, float min_depth) "
      "-> ()");
  m.def(
      "squared_residuals(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, "
      "Tensor nearest, Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, "
      "Tensor(a!) square, Tensor(b!) front, float nearest_divisor, float behind, float min_depth) -> ()");
  m.def(
      "minimise_tracks(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest, "
      "Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor share, Tensor precision, "
      "Tensor(a!) best_R, Tensor(b!) best_t, Tensor(c!) best_turn, Tensor(d!) cost, int steps, float damping, "
      "bool rotation_only, float bend, float nearest_divisor, float behind, float min_depth) -> ()");
  m.def(
      "track_noise(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest, "
      "Tensor variance, Tensor far, Tensor R, Tensor t, Tensor turn, Tensor(a!) noise, int rounds, float near_median, "
      "float far_median, float low, float high, float nearest_divisor, float behind, float min_depth) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("pose_normal_equations", TORCH_BOX(&pose_normal_equations));
  m.impl("squared_residuals", TORCH_BOX(&squared_residuals));
  m.impl("minimise_tracks", TORCH_BOX(&minimise_tracks));
  m.impl("track_noise", TORCH_BOX(&track_noise));
}
