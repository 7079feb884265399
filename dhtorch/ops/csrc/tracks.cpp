// Cost and normal equations of near and far tracks, their minimum, squared residuals, and noise. References:
// dhtorch/geometry/reprojection_problem.py, and estimate_noise_variance and pose_covariance of map_estimate.py; the same
// formulas and steps, a vector of tracks at a time, and sums over tracks in another order. Cost, normal equations and
// covariance in single or double precision (T). One thread, no gradient. The dispatch checks dtypes and strides, Python
// the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <type_traits>
#include <vector>

namespace {

// As many numbers T as LANES floats take.
template <typename T>
struct Wide {
  static constexpr int64_t COUNT = LANES * sizeof(float) / sizeof(T);
  typedef T Numbers __attribute__((vector_size(LANES * sizeof(float))));
  using Mask = decltype(Numbers{} < Numbers{});

  static Numbers load(const T* from) {
    Numbers read;
    std::memcpy(&read, from, sizeof(read));
    return read;
  }

  static Numbers root(Numbers x) {
    T part[COUNT];
    std::memcpy(part, &x, sizeof(x));
    for (int64_t i = 0; i < COUNT; ++i) part[i] = std::sqrt(part[i]);
    return load(part);
  }

  // Sum of the numbers, by halves.
  static T sum(Numbers x) {
    if constexpr (std::is_same_v<T, float>) return total(x);
    T part[COUNT];
    std::memcpy(part, &x, sizeof(x));
    for (int64_t half = COUNT / 2; half; half /= 2) {
      for (int64_t i = 0; i < half; ++i) part[i] += part[i + half];
    }
    return part[0];
  }
};

// Limits of a track: the factor by which a far one may be nearer than the nearest return, the squared residual of a
// point behind the camera, and the least depth (m).
template <typename T>
struct Limits {
  T nearest_divisor, behind, min_depth;

  Limits(double nearest_divisor, double behind, double min_depth)
      : nearest_divisor(static_cast<T>(nearest_divisor)), behind(static_cast<T>(behind)),
        min_depth(static_cast<T>(min_depth)) {}
};

// The tracks of one pair, N a multiple of LANES, and the unknowns.
template <typename T>
struct Tracks {
  Limits<T> limits;
  int64_t N;
  const T *ray, *seen, *height, *shape, *inverse, *variance, *a, *b, *d;
  const bool* near;
  T nearest, R[3][3], t[3], turn[3];
  bool turns;
};

// Tracks from index `n` on, as many as a vector holds, linearised and whitened.
template <typename T>
struct Whitened {
  using Vector = typename Wide<T>::Numbers;
  using Bits = typename Wide<T>::Mask;

  Bits front;
  Vector height, square, r[2];  // residuals along the two axes
  Vector x, y, k, m0[2], m1[2];

  Whitened(const Tracks<T>& of, int64_t n) {
    const auto load = Wide<T>::load;
    const auto root = Wide<T>::root;
    const int64_t N = of.N;
    const Vector none = Vector{}, one = none + T(1);
    const Vector X = load(of.ray + n), Y = load(of.ray + N + n), Z = load(of.ray + 2 * N + n);
    Vector p[3], u = load(of.seen + n), v = load(of.seen + N + n);
    for (int i = 0; i < 3; ++i) p[i] = of.R[i][0] * X + of.R[i][1] * Y + of.R[i][2] * Z;
    height = load(of.height + n);
    if (of.turns) {
      const T* by = of.turn;
      const Vector ahead = one - height * (by[0] * v - by[1] * u);
      const Vector z = (ahead < T(0.1)) & (ahead > T(-0.1)) ? none + T(0.1) : ahead;
      const Vector across = u - height * (by[1] - by[2] * v), along = v - height * (by[2] * u - by[0]);
      u = across / z;
      v = along / z;
    }
    Bits near;
    for (int64_t i = 0; i < Wide<T>::COUNT; ++i) near[i] = of.near[n + i] ? -1 : 0;
    const Vector xx = load(of.shape + n), xy = load(of.shape + N + n), yy = load(of.shape + 2 * N + n);
    // Maximum-likelihood inverse depth of a track without one.
    const T* t = of.t;
    const Vector l0 = t[1] * p[2] - t[2] * p[1], l1 = t[2] * p[0] - t[0] * p[2], l2 = t[0] * p[1] - t[1] * p[0];
    const Vector n0 = xx * l0 + xy * l1, n1 = xy * l0 + yy * l1, size = l0 * n0 + l1 * n1;
    const Vector lift = (l0 * u + l1 * v + l2) / (size < T(1e-30) ? none + T(1e-30) : size);
    const Vector u1 = u - lift * n0, v1 = v - lift * n1;
    const Vector d0 = t[0] - t[2] * u1, d1 = t[1] - t[2] * v1, long_ = d0 * d0 + d1 * d1;
    const Vector free = -((p[0] - p[2] * u1) * d0 + (p[1] - p[2] * v1) * d1) / (long_ < T(1e-24) ? none + T(1e-24) : long_);
    const Vector q = near ? load(of.inverse + n) : (free < T(0) ? none : free);
    const Bits open = ~near & ~(free < T(0));  // q is unconstrained
    const Vector variance = near ? load(of.variance + n) : none;

    const Vector depth = p[2] + q * t[2];
    front = (depth > of.limits.min_depth) & (near | (q < of.limits.nearest_divisor * of.nearest));
    const Vector w = T(1) / (front ? depth : one);
    x = (p[0] + q * t[0]) * w;
    y = (p[1] + q * t[1]) * w;
    k = q * w;
    const Vector s0 = (t[0] - x * t[2]) * w, s1 = (t[1] - y * t[2]) * w;
    const Vector a = load(of.a + n), b = load(of.b + n), d = load(of.d + n), bd = b * d;
    Vector e0 = a * s0, e1 = d * (s1 - b * s0);
    const Vector slope = e0 * e0 + e1 * e1;
    const Bits flat = slope < T(1e-12);
    const Vector unit = T(1) / root(flat ? one : slope);
    e0 = flat ? one : e0 * unit;
    e1 = flat ? none : e1 * unit;
    const Vector left = open & ~flat ? none : T(1) / root(T(1) + slope * variance);
    m0[0] = left * (e0 * a - e1 * bd);
    m0[1] = -e1 * a - e0 * bd;
    m1[0] = left * e1 * d;
    m1[1] = e0 * d;
    for (int i = 0; i < 2; ++i) r[i] = m0[i] * (x - u) + m1[i] * (y - v);
    square = front ? r[0] * r[0] + r[1] * r[1] : none + of.limits.behind;
  }
};

// The Jacobian of whitened residuals, n = 6 columns of the pose, or 9 with a shutter's turn.
template <typename T, int n>
struct Jacobian {
  using Vector = typename Wide<T>::Numbers;

  Vector J[2][n];

  explicit Jacobian(const Whitened<T>& at) {
    const Vector none = Vector{}, x = at.x, y = at.y, k = at.k;
    const Vector u[6] = {-x * y, T(1) + x * x, -y, k, none, -x * k}, v[6] = {T(-1) - y * y, x * y, x, none, k, -y * k};
    for (int i = 0; i < 2; ++i) {
      for (int j = 0; j < 6; ++j) J[i][j] = at.m0[i] * u[j] + at.m1[i] * v[j];
      for (int j = 6; j < n; ++j) J[i][j] = J[i][j - 6] * at.height;
    }
  }
};

// The robust cost, and with `columns` the upper half of J'WJ and J'Wr row by row; n = 6, or 9 with a shutter's turn.
template <typename T, int n, bool columns>
T sums(const Tracks<T>& of, const T* share, T bend, T* found) {
  using Vector = typename Wide<T>::Numbers;
  constexpr int COUNT = n * (n + 3) / 2;
  Vector all = Vector{}, part[COUNT] = {};
  const Vector none = Vector{};
  for (int64_t m = 0; m < of.N; m += Wide<T>::COUNT) {
    const Whitened<T> at(of, m);
    const Vector weight = Wide<T>::load(share + m), bent = T(1) + at.square / (bend * bend);
    all += weight * (at.square / bent);
    if (!columns) continue;
    const Vector W = at.front ? weight / (bent * bent) : none;
    const Jacobian<T, n> of_track(at);
    Vector* to = part;
    for (int i = 0; i < n; ++i) {
      const Vector first = W * of_track.J[0][i], second = W * of_track.J[1][i];
      for (int j = i; j < n; ++j) *to++ += first * of_track.J[0][j] + second * of_track.J[1][j];
      *to++ += first * at.r[0] + second * at.r[1];
    }
  }
  if (columns) {
    for (int i = 0; i < COUNT; ++i) found[i] = Wide<T>::sum(part[i]);
  }
  return Wide<T>::sum(all);
}

template <typename T, int n>
T equations(const Tracks<T>& of, const T* share, T bend, T* H, T* g) {
  if (!H) return sums<T, n, false>(of, share, bend, nullptr);
  T found[n * (n + 3) / 2], *from = found;
  const T cost = sums<T, n, true>(of, share, bend, found);
  for (int i = 0; i < n; ++i) {
    for (int j = i; j < n; ++j) H[i * n + j] = H[j * n + i] = *from++;
    g[i] = *from++;
  }
  return cost;
}

// Tensors of _track_tensors in reprojection_problem.py: ray (B, 3, N), inverse, near (B, N), seen (B, 2, N), shape
// (B, 3, N), height (B, N), nearest (B, 1), variance, a, b, d (B, N), R (B, 3, 3), t (B, 3), turn (B, 3), or (0, 3) without
// one. near is bool, all others float32 or all float64.
struct TrackTensors {
  const Tensor &ray, &inverse, &near, &seen, &shape, &height, &nearest, &variance, &a, &b, &d, &R, &t, &turn;

  int64_t pairs() const { return ray.size(0); }
  int64_t tracks() const { return ray.size(2); }
  bool is_double() const { return ray.element_size() == sizeof(double); }
  bool turns() const { return turn.size(0) > 0; }
};

template <typename T>
Tracks<T> pair(int64_t k, const Limits<T>& limits, const TrackTensors& x) {
  const int64_t N = x.tracks();
  Tracks<T> of = {limits};
  of.N = N;
  of.ray = data<T>(x.ray) + 3 * N * k;
  of.seen = data<T>(x.seen) + 2 * N * k;
  of.height = data<T>(x.height) + N * k;
  of.shape = data<T>(x.shape) + 3 * N * k;
  of.inverse = data<T>(x.inverse) + N * k;
  of.variance = data<T>(x.variance) + N * k;
  of.near = data<bool>(x.near) + N * k;
  of.nearest = data<T>(x.nearest)[k];
  of.a = data<T>(x.a) + N * k;
  of.b = data<T>(x.b) + N * k;
  of.d = data<T>(x.d) + N * k;
  of.turns = x.turns();
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) of.R[i][j] = data<T>(x.R)[9 * k + 3 * i + j];
    of.t[i] = data<T>(x.t)[3 * k + i];
    of.turn[i] = of.turns ? data<T>(x.turn)[3 * k + i] : T(0);
  }
  return of;
}

template <typename T>
void add_up(const TrackTensors& x, const Tensor& share, const Tensor& cost, const Tensor& H, const Tensor& g, double bend,
            const Limits<T>& limits) {
  const int64_t N = x.tracks(), n = x.turns() ? 9 : 6;
  for (int64_t k = 0; k < x.pairs(); ++k) {
    const Tracks<T> of = pair<T>(k, limits, x);
    T *to = H.size(0) ? data<T>(H) + n * n * k : nullptr, *right = to ? data<T>(g) + n * k : nullptr;
    const T *weight = data<T>(share) + N * k, by = static_cast<T>(bend);
    data<T>(cost)[k] = of.turns ? equations<T, 9>(of, weight, by, to, right) : equations<T, 6>(of, weight, by, to, right);
  }
}

// share (B, N): weight of a track in the cost. Outputs: cost (B), H (B, n, n) and g (B, n), which are not computed where
// their leading dimension is 0.
void pose_normal_equations(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest,
                           Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor share,
                           Tensor cost, Tensor H, Tensor g, double bend, double nearest_divisor, double behind,
                           double min_depth) {
  const TrackTensors x = {ray, inverse, near, seen, shape, height, nearest, variance, a, b, d, R, t, turn};
  if (x.is_double()) {
    add_up<double>(x, share, cost, H, g, bend, {nearest_divisor, behind, min_depth});
  } else {
    add_up<float>(x, share, cost, H, g, bend, {nearest_divisor, behind, min_depth});
  }
}

// The same tensors. Outputs: squared whitened residuals (B, N), and which tracks are in front (B, N) bool.
void squared_residuals(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest,
                       Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor square,
                       Tensor front, double nearest_divisor, double behind, double min_depth) {
  const TrackTensors x = {ray, inverse, near, seen, shape, height, nearest, variance, a, b, d, R, t, turn};
  const int64_t N = x.tracks();
  const Limits<float> limits(nearest_divisor, behind, min_depth);
  for (int64_t k = 0; k < x.pairs(); ++k) {
    const Tracks<float> of = pair(k, limits, x);
    for (int64_t m = 0; m < N; m += LANES) {
      const Whitened<float> at(of, m);
      store(at.square, data<float>(square) + N * k + m);
      for (int64_t i = 0; i < LANES; ++i) data<bool>(front)[N * k + m + i] = at.front[i] != 0;
    }
  }
}

// How the sandwich of pose_covariance weighs tracks: the bend of the robust kernel, the least ratio of mean psi' to mean w,
// the degrees of freedom that the pose takes, and the least mean weight.
struct SandwichRules {
  double bend, min_slope, spent, least;
};

// Means over tracks of one kind, of _rise_and_scatter in map_estimate.py.
struct Spread {
  double count = 0, steeper = 0, squares = 0, weight = 0, scatter = 0, weights = 0;

  void add(double square, int size, double k2) {
    const double bent = 1 + square / k2, w = 1 / (bent * bent), steep = -2 / k2 * w / bent * square * (2.0 / size) + w;
    count += 1;
    steeper += steep;
    squares += steep * steep;
    weight += w;
    scatter += w * w * square;
    weights += w * w;
  }

  // Factors on w in the bread and on w squared in the meat, for residuals of `size` coordinates.
  void factors(int size, const SandwichRules& by, double omega, double& bread, double& meat) const {
    const double n = std::max(count, 1.0), mean = steeper / n, free = size * n;
    const double uneven = (squares / n - mean * mean) / std::max(mean * mean, by.min_slope * by.min_slope);
    const double few = 1 + by.spent / free * uneven, lost = free / std::max(free - by.spent, 1.0);
    const double rise = mean / std::max(weight / n, by.least), spread = scatter / size / std::max(weights, by.least);
    bread = omega * (std::max(rise, by.min_slope) / few);
    meat = omega * omega * (spread * lost * lost);
  }
};

// The same tensors in double precision; far (B, N) bool, far_weight (B). Outputs: bread and meat (B, 9, 9), the sums of
// pose_covariance in map_estimate.py before the shutter's prior.
void pose_sandwich(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest,
                   Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor far,
                   Tensor far_weight, Tensor bread, Tensor meat, double bend, double min_slope, double spent, double least,
                   double nearest_divisor, double behind, double min_depth) {
  constexpr int n = 9, COUNT = n * (n + 1) / 2;
  using Vector = Wide<double>::Numbers;
  constexpr int64_t SOME = Wide<double>::COUNT;
  const TrackTensors x = {ray, inverse, near, seen, shape, height, nearest, variance, a, b, d, R, t, turn};
  const SandwichRules rules = {bend, min_slope, spent, least};
  const int64_t N = x.tracks();
  const Limits<double> limits(nearest_divisor, behind, min_depth);
  for (int64_t k = 0; k < x.pairs(); ++k) {
    const Tracks<double> of = pair(k, limits, x);
    const bool* distant = data<bool>(far) + N * k;
    Spread spread[2];
    for (int64_t m = 0; m < N; m += SOME) {
      const Whitened<double> at(of, m);
      for (int64_t i = 0; i < SOME; ++i) {
        if (!at.front[i]) continue;
        if (of.near[m + i]) spread[0].add(at.square[i], 2, bend * bend);
        if (distant[m + i]) spread[1].add(at.square[i], 1, bend * bend);
      }
    }
    double rise[2], scatter[2];
    spread[0].factors(2, rules, 1.0, rise[0], scatter[0]);
    spread[1].factors(1, rules, data<double>(far_weight)[k], rise[1], scatter[1]);
    Vector sums[2][COUNT] = {};
    for (int64_t m = 0; m < N; m += SOME) {
      const Whitened<double> at(of, m);
      const Jacobian<double, n> columns(at);
      const Vector bent = 1.0 + at.square / (bend * bend), w = 1.0 / (bent * bent);
      Vector weight[2] = {};
      for (int64_t i = 0; i < SOME; ++i) {
        const bool used = at.front[i] && (of.near[m + i] || distant[m + i]);
        weight[0][i] = used ? w[i] * rise[distant[m + i]] : 0.0;
        weight[1][i] = used ? w[i] * w[i] * scatter[distant[m + i]] : 0.0;
      }
      int e = 0;
      for (int i = 0; i < n; ++i) {
        for (int j = i; j < n; ++j, ++e) {
          const Vector product = columns.J[0][i] * columns.J[0][j] + columns.J[1][i] * columns.J[1][j];
          sums[0][e] += weight[0] * product;
          sums[1][e] += weight[1] * product;
        }
      }
    }
    const Tensor* to[2] = {&bread, &meat};
    for (int half = 0; half < 2; ++half) {
      double* whole = data<double>(*to[half]) + n * n * k;
      int e = 0;
      for (int i = 0; i < n; ++i) {
        for (int j = i; j < n; ++j, ++e) whole[i * n + j] = whole[j * n + i] = Wide<double>::sum(sums[half][e]);
      }
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
void displace(Tracks<float>& of, const double* step) {
  float xi[n];
  for (int i = 0; i < n; ++i) xi[i] = static_cast<float>(step[i]);
  move_pose(&of.R[0][0], of.t, xi);
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
float evaluate(const Tracks<float>& of, const Search& by, float* H, float* g) {
  float cost = equations<float, n>(of, by.share, by.bend, H, g), square = 0.0f;
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
float minimise(Tracks<float>& of, const Search& by) {
  float H[n * n], g[n], next_H[n * n], next_g[n], damped[n * n], factor = by.damping;
  if (!by.steps) return evaluate<n>(of, by, nullptr, nullptr);
  float best = evaluate<n>(of, by, H, g);
  for (int64_t k = 0; k < by.steps; ++k) {
    const bool last = k == by.steps - 1;
    double step[n];
    std::copy_n(H, n * n, damped);
    for (int i = 0; i < n; ++i) damped[i * n + i] *= 1.0f + factor;
    Tracks<float> proposal = of;
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
  const TrackTensors x = {ray, inverse, near, seen, shape, height, nearest, variance, a, b, d, R, t, turn};
  const int64_t B = x.pairs(), N = x.tracks();
  const Limits<float> limits(nearest_divisor, behind, min_depth);
  for (int64_t k = 0; k < B; ++k) {
    Tracks<float> of = pair(k, limits, x);
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

// The same tensors without the noise's factors; far (B, N) bool. Output: noise (B, N), after `rounds` estimates from the
// medians of near and far residuals, each divided by that of unit noise, within [low, high].
void track_noise(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest,
                 Tensor variance, Tensor far, Tensor R, Tensor t, Tensor turn, Tensor noise, int64_t rounds,
                 double near_median, double far_median, double low, double high, double nearest_divisor, double behind,
                 double min_depth) {
  const TrackTensors x = {ray, inverse, near, seen, shape, height, nearest, variance, variance, variance, variance, R, t, turn};
  const int64_t B = x.pairs(), N = x.tracks();
  const Limits<float> limits(nearest_divisor, behind, min_depth);
  std::vector<float> a(N), b(N), d(N), of_near, of_far;
  for (int64_t k = 0; k < B; ++k) {
    Tracks<float> of = pair(k, limits, x);
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
        const Whitened<float> at(of, n);
        for (int64_t i = 0; i < LANES; ++i) {
          any_far = any_far || distant[n + i];
          if (!at.front[i] || std::isnan(at.square[i])) continue;
          if (of.near[n + i]) of_near.push_back(at.square[i]);
          if (distant[n + i]) of_far.push_back(at.square[i]);
        }
      }
      const float close = std::sqrt(lower_median(of_near, 1.0f)) / static_cast<float>(near_median);
      const float factor[2] = {close, any_far ? std::sqrt(lower_median(of_far, 1.0f)) / static_cast<float>(far_median) : close};
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
      "pose_sandwich(Tensor ray, Tensor inverse, Tensor near, Tensor seen, Tensor shape, Tensor height, Tensor nearest, "
      "Tensor variance, Tensor a, Tensor b, Tensor d, Tensor R, Tensor t, Tensor turn, Tensor far, Tensor far_weight, "
      "Tensor(a!) bread, Tensor(b!) meat, float bend, float min_slope, float spent, float least, float nearest_divisor, "
      "float behind, float min_depth) -> ()");
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
  m.impl("pose_sandwich", TORCH_BOX(&pose_sandwich));
  m.impl("squared_residuals", TORCH_BOX(&squared_residuals));
  m.impl("minimise_tracks", TORCH_BOX(&minimise_tracks));
  m.impl("track_noise", TORCH_BOX(&track_noise));
}
