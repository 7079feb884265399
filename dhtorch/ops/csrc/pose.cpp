// The search for a metric pose from near points, one pair after another. Reference: _robust_pose in
// dhtorch/stages/pose.py; the same triples, solutions, scores and steps. Sums over points are taken in another order, and
// the poses of a triple are computed in double precision throughout. One thread, no gradient. The dispatch checks dtypes
// and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <numeric>
#include <vector>

namespace {

// Options of the search: points, hypotheses, least depth (m), and which triples are degenerate.
struct Options {
  int64_t search_points, preview, shortlist, keep;
  float damping, min_depth;
  double min_height, max_cosine;
};

constexpr float INFINITE = std::numeric_limits<float>::infinity();

typedef double Matrix[3][3];
typedef double Three[3];

inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline void cross(const double* a, const double* b, double* c) {
  for (int i = 0; i < 3; ++i) c[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}

inline bool unit(double* a) {
  const double size = std::sqrt(dot(a, a));
  for (int i = 0; i < 3; ++i) a[i] /= size;
  return size > 0;
}

inline void cofactors(const Matrix A, Matrix found) {
  for (int i = 0; i < 3; ++i) cross(A[(i + 1) % 3], A[(i + 2) % 3], found[i]);
}

inline double product(const Matrix A, const Matrix B) { return dot(A[0], B[0]) + dot(A[1], B[1]) + dot(A[2], B[2]); }

struct Motion {
  float R[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, t[3] = {0, 0, 0};
};

// _outer_root of p3p.py.
double outer_root(const Matrix first, const Matrix second) {
  Matrix one, two;
  cofactors(first, one);
  cofactors(second, two);
  const double k[4] = {product(one, first), product(one, second), product(two, first), product(two, second)};
  double most = 0;
  for (double x : k) most = std::max(most, std::fabs(x));
  const double lead = k[0] + std::copysign(1e-12 * most + 1e-300, k[0]);
  const double third = k[1] / lead, c = k[2] / lead, last = k[3] / lead, square = third * third;
  const double p = c - square, q = 0.5 * last + third * (square - 1.5 * c);
  const double s = std::sqrt(std::fabs(p) + 1e-18 * square + 1e-80), h = std::fabs(q) / (s * s * s);
  double size;
  if (p <= 0 && h < 1) {
    size = 2 * std::cos(std::acos(h) / 3);
  } else {
    const double sign = p > 0 ? 1 : (p < 0 ? -1 : 0);
    const double w = std::exp(std::log(h + std::sqrt(std::max(h * h + sign, 0.0))) / 3);
    size = w - sign / w;
  }
  return -third - std::copysign(s * size, q);
}

// _ranges of p3p.py, the root last.
void ranges(const double* m, const double* a, double (*d)[4]) {
  Matrix first = {{a[1], -a[1] * m[0], 0}, {-a[1] * m[0], a[1] - a[0], a[0] * m[1]}, {0, a[0] * m[1], -a[0]}};
  Matrix second = {{a[1], 0, -a[1] * m[2]}, {0, -a[2], a[2] * m[1]}, {-a[1] * m[2], a[2] * m[1], a[1] - a[2]}};
  const double gamma = outer_root(first, second), scale = 1 / std::sqrt(gamma * gamma + 1);
  Matrix split, other, minors, both[2];
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      first[i][j] *= scale;
      second[i][j] *= scale;
      split[i][j] = gamma * first[i][j] + second[i][j];
      other[i][j] = first[i][j] - gamma * second[i][j];
    }
  }
  cofactors(split, minors);
  int row = 0;
  for (int i = 1; i < 3; ++i) row = minors[i][i] < minors[row][row] ? i : row;
  const double root = 1 / std::sqrt(std::max(-minors[row][row], 1e-300));
  const double p[3] = {minors[row][0] * root, minors[row][1] * root, minors[row][2] * root};
  const Matrix turn = {{0, -p[2], p[1]}, {p[2], 0, -p[0]}, {-p[1], p[0], 0}};
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) both[0][i][j] = both[1][j][i] = split[i][j] + turn[i][j];
  }
  Three Ap;
  for (int i = 0; i < 3; ++i) Ap[i] = dot(other[i], p);
  const double pp = dot(Ap, p);
  for (int k = 0; k < 2; ++k) {
    int longest = 0;
    for (int i = 1; i < 3; ++i) longest = dot(both[k][i], both[k][i]) > dot(both[k][longest], both[k][longest]) ? i : longest;
    Three v, Av;
    cross(both[k][longest], p, v);
    for (int i = 0; i < 3; ++i) Av[i] = dot(other[i], v);
    const double pv = dot(Ap, v), vv = dot(Av, v);
    const double s = pv + std::copysign(std::sqrt(std::max(pv * pv - pp * vv, 0.0)), pv);
    for (int i = 0; i < 3; ++i) {
      d[i][k] = vv * p[i] - s * v[i];
      d[i][k + 2] = pp * v[i] - s * p[i];
    }
  }
  const double sum = a[0] + a[1] + a[2];
  for (int k = 0; k < 4; ++k) {
    double size = 0, total = 0;
    for (int i = 0; i < 3; ++i) {
      size += d[i][k] * (d[i][k] - m[i] * d[(i + 1) % 3][k]);
      total += d[i][k];
    }
    const double by = std::copysign(std::sqrt(0.5 * sum / size), total);
    for (int i = 0; i < 3; ++i) d[i][k] *= by;
  }
}

// _polish of p3p.py for one root; returns the longest step.
double polish(double* d, const double* m, const double* a) {
  Three x, y, r, step;
  for (int k = 0; k < 3; ++k) {
    const double next = d[(k + 1) % 3];
    x[k] = d[k] - next * m[k];
    y[k] = next - d[k] * m[k];
    r[k] = d[k] * x[k] + next * y[k] - a[k];
  }
  const double det = 2 * (x[0] * x[1] * x[2] + y[0] * y[1] * y[2]), by = det / (det * det + 1e-20);
  double most = 0;
  for (int k = 0; k < 3; ++k) {
    const int n = (k + 1) % 3, l = (k + 2) % 3;
    step[k] = by * (x[l] * (r[k] * x[n] - r[n] * y[k]) + r[l] * (y[k] * y[n]));
    most = !(std::fabs(step[k]) <= most) ? std::fabs(step[k]) : most;  // NaN stays NaN
  }
  for (int k = 0; k < 3; ++k) d[k] -= step[k];
  return most;
}

// Orthonormal axes of a triangle: its first side, its normal and their product.
inline void axes(const Matrix P, Matrix found) {
  Three first, second;
  for (int i = 0; i < 3; ++i) {
    first[i] = P[1][i] - P[0][i];
    second[i] = P[2][i] - P[0][i];
  }
  unit(first);
  Three normal, third;
  cross(first, second, normal);
  unit(normal);
  cross(normal, first, third);
  for (int i = 0; i < 3; ++i) {
    found[0][i] = first[i];
    found[1][i] = normal[i];
    found[2][i] = third[i];
  }
}

// p3p of p3p.py for one triple: poses, and which are valid.
void p3p(Matrix j, const Matrix X, Motion* poses, bool* valid, const Options& o) {
  Three m, a;
  for (int k = 0; k < 3; ++k) unit(j[k]);
  for (int k = 0; k < 3; ++k) {
    const double *here = X[k], *next = X[(k + 1) % 3];
    m[k] = dot(j[k], j[(k + 1) % 3]);
    const double side[3] = {next[0] - here[0], next[1] - here[1], next[2] - here[2]};
    a[k] = dot(side, side);
  }
  const double longest = std::max({a[0], a[1], a[2]}), scale = std::sqrt(longest);
  for (int k = 0; k < 3; ++k) a[k] /= longest;
  const double total = a[0] + a[1] + a[2], flat = total * total - 2 * dot(a, a);
  const bool sound = flat > 4 * o.min_height * o.min_height && std::max({m[0], m[1], m[2]}) < o.max_cosine &&
                     longest < std::numeric_limits<double>::infinity();
  std::fill(valid, valid + 4, false);
  if (!sound) return;
  double roots[3][4];
  ranges(m, a, roots);
  Matrix world;
  axes(X, world);
  for (int k = 0; k < 4; ++k) {
    double d[3] = {roots[0][k], roots[1][k], roots[2][k]};
    const double step = polish(d, m, a);
    valid[k] = step < 1e-3 && d[0] > 1e-9 && d[1] > 1e-9 && d[2] > 1e-9;
    if (!valid[k]) continue;
    Matrix Y, seen;
    for (int i = 0; i < 3; ++i) {
      for (int c = 0; c < 3; ++c) Y[i][c] = d[i] * scale * j[i][c];
    }
    axes(Y, seen);
    for (int r = 0; r < 3; ++r) {
      double t = Y[0][r];
      for (int c = 0; c < 3; ++c) {
        const double R = seen[0][r] * world[0][c] + seen[1][r] * world[1][c] + seen[2][r] * world[2][c];
        t -= R * X[0][c];
        poses[k].R[r][c] = static_cast<float>(R);
      }
      poses[k].t[r] = static_cast<float>(t);
    }
  }
}

inline Vector least(Vector x, Vector y) { return x < y ? x : y; }

// Points of one pair and their pixels in view 1, in rows padded to whole vectors with points of no cost.
struct Points {
  int64_t count = 0, wide = 0;
  float min_depth;
  std::vector<float> rows;  // x, y, z (m); u, v at z = 1; largest squared error (px²)
  float fx, fy;

  Points(const float* f, float min_depth) : min_depth(min_depth), fx(f[0]), fy(f[1]) {}

  // Take the points of `from` (5, N) with the indices `of`.
  void take(const float* from, int64_t N, const std::vector<int64_t>& of, const float* c, float limit) {
    count = static_cast<int64_t>(of.size());
    wide = std::max<int64_t>((count + LANES - 1) / LANES * LANES, LANES);
    rows.assign(6 * wide, 0.0f);
    for (int64_t k = 0; k < count; ++k) {
      for (int64_t i = 0; i < 3; ++i) rows[i * wide + k] = from[i * N + of[k]];
      rows[3 * wide + k] = (from[3 * N + of[k]] - c[0]) / fx;
      rows[4 * wide + k] = (from[4 * N + of[k]] - c[1]) / fy;
      rows[5 * wide + k] = limit;
    }
  }

  // Truncated cost of a pose; with `sums` also the upper half of H and g, 27 numbers.
  float cost(const Motion& T, double* sums = nullptr) const {
    const float *x = rows.data(), *y = x + wide, *z = y + wide, *u = z + wide, *v = u + wide, *most = v + wide;
    const Vector none = Vector{}, wu = none + fx * fx, wv = none + fy * fy;
    Vector all = none, part[27] = {};
    for (int64_t k = 0; k < wide; k += LANES) {
      const Vector px = load(x + k), py = load(y + k), pz = load(z + k), limit = load(most + k);
      const Vector X = T.R[0][0] * px + T.R[0][1] * py + T.R[0][2] * pz + T.t[0];
      const Vector Y = T.R[1][0] * px + T.R[1][1] * py + T.R[1][2] * pz + T.t[1];
      const Vector Z = T.R[2][0] * px + T.R[2][1] * py + T.R[2][2] * pz + T.t[2];
      const Vector w = 1.0f / (Z > min_depth ? Z : none + min_depth), a = X * w, b = Y * w;
      const Vector ra = a - load(u + k), rb = b - load(v + k), square = wu * ra * ra + wv * rb * rb;
      const auto inside = (Z > min_depth) & (square < limit);
      all += inside ? square : limit;
      if (!sums) continue;
      const Vector su = inside ? wu : none, sv = inside ? wv : none;
      const Vector ju[6] = {-a * b, 1.0f + a * a, -b, w, none, -a * w}, jv[6] = {-1.0f - b * b, a * b, a, none, w, -b * w};
      Vector* to = part;
      for (int i = 0; i < 6; ++i) {
        const Vector iu = su * ju[i], iv = sv * jv[i];
        for (int j = i; j < 6; ++j) *to++ += iu * ju[j] + iv * jv[j];
        *to++ += iu * ra + iv * rb;
      }
    }
    if (sums) {
      for (int i = 0; i < 27; ++i) sums[i] = total(part[i]);
    }
    return total(all);
  }
};

// The step of damped normal equations by Cholesky factorisation; false where they are singular.
bool solve(const double* sums, double factor, double* step) {
  double L[6][6], rhs[6];
  const double* from = sums;
  for (int i = 0; i < 6; ++i) {
    for (int j = i; j < 6; ++j) L[j][i] = *from++ * (i == j ? 1 + factor : 1);
    rhs[i] = -*from++;
  }
  for (int i = 0; i < 6; ++i) {
    for (int j = 0; j <= i; ++j) {
      double x = L[i][j];
      for (int k = 0; k < j; ++k) x -= L[i][k] * L[j][k];
      if (i == j && !(x > 0)) return false;
      L[i][j] = i == j ? std::sqrt(x) : x / L[j][j];
    }
  }
  for (int i = 0; i < 6; ++i) {
    for (int k = 0; k < i; ++k) rhs[i] -= L[i][k] * rhs[k];
    rhs[i] /= L[i][i];
  }
  for (int i = 5; i >= 0; --i) {
    for (int k = i + 1; k < 6; ++k) rhs[i] -= L[k][i] * rhs[k];
    rhs[i] /= L[i][i];
    step[i] = rhs[i];
  }
  return true;
}

// The pose displaced by xi, in double precision.
Motion moved(const Motion& T, const double* xi) {
  double R[9], t[3];
  std::copy(&T.R[0][0], &T.R[0][0] + 9, R);
  std::copy(T.t, T.t + 3, t);
  move_pose(R, t, xi);
  Motion found;
  for (int i = 0; i < 9; ++i) found.R[i / 3][i % 3] = static_cast<float>(R[i]);
  for (int i = 0; i < 3; ++i) found.t[i] = static_cast<float>(t[i]);
  return found;
}

// minimise of least_squares.py: replaces T by the best pose; returns its cost.
float minimise(const Points& points, Motion& T, int64_t steps, float damping) {
  double sums[27], there[27], xi[6], factor = damping;
  float best = points.cost(T, sums);
  for (int64_t k = 0; k < steps; ++k) {
    const bool last = k == steps - 1, solved = solve(sums, factor, xi);
    const Motion proposal = solved ? moved(T, xi) : T;
    const float cost = solved ? points.cost(proposal, last ? nullptr : there) : INFINITE;
    if (cost < best) {
      T = proposal;
      best = cost;
      std::copy(there, there + 27, sums);
      factor *= 0.1;
    } else {
      factor *= 10;
    }
  }
  return best;
}

// evenly_spaced_slots of ransac.py.
std::vector<int64_t> evenly_spaced_slots(int64_t count, int64_t size) {
  std::vector<int64_t> found(std::min(count, size));
  for (size_t k = 0; k < found.size(); ++k) found[k] = static_cast<int64_t>(k) * std::max(count, size) / size;
  return found;
}

// One of the distinct_triples of ransac.py.
void triple(const float* draws, int64_t count, int64_t* found) {
  for (int64_t k = 0; k < 3; ++k) {
    const int64_t left = std::max<int64_t>(count - k, 1);
    found[k] = std::min(static_cast<int64_t>(draws[k] * static_cast<float>(left)), left - 1);
  }
  if (found[1] >= found[0]) ++found[1];
  const int64_t low = std::min(found[0], found[1]), high = std::max(found[0], found[1]);
  if (found[2] >= low) ++found[2];
  if (found[2] >= high) ++found[2];
  for (int64_t k = 0; k < 3; ++k) found[k] = std::min(found[k], std::max<int64_t>(count - 1, 0));
}

// Indices of the lowest costs, in order.
std::vector<int64_t> least_of(const std::vector<float>& cost, int64_t most) {
  std::vector<int64_t> found(cost.size());
  std::iota(found.begin(), found.end(), 0);
  const auto end = found.begin() + std::min<int64_t>(most, static_cast<int64_t>(found.size()));
  std::partial_sort(found.begin(), end, found.end(), [&](int64_t i, int64_t j) {
    return cost[i] < cost[j] || (cost[i] == cost[j] && i < j);
  });
  found.erase(end, found.end());
  return found;
}

// The best poses of the triples drawn among near points, padded with the identity; returns the lowest cost.
float search(const Points& near, const Points& few, const float* draws, int64_t H, std::vector<Motion>& best, const Options& o) {
  std::vector<Motion> poses(4 * H);
  std::vector<float> cost(4 * H, INFINITE);
  const float* of = near.rows.data();
  for (int64_t h = 0; h < H; ++h) {
    int64_t slot[3];
    bool valid[4];
    Matrix rays, places;
    triple(draws + 3 * h, near.count, slot);
    for (int k = 0; k < 3; ++k) {
      for (int i = 0; i < 3; ++i) places[k][i] = of[i * near.wide + slot[k]];
      rays[k][0] = of[3 * near.wide + slot[k]];
      rays[k][1] = of[4 * near.wide + slot[k]];
      rays[k][2] = 1;
    }
    p3p(rays, places, poses.data() + 4 * h, valid, o);
    for (int k = 0; k < 4; ++k) {
      if (valid[k]) cost[4 * h + k] = few.cost(poses[4 * h + k]);
    }
  }
  const std::vector<int64_t> some = least_of(cost, std::max(o.shortlist, o.keep));
  std::vector<float> whole;
  for (const int64_t k : some) whole.push_back(std::max(cost[k], cost[k] < INFINITE ? near.cost(poses[k]) : INFINITE));
  const std::vector<int64_t> order = least_of(whole, o.keep);
  for (size_t k = 0; k < order.size(); ++k) best[k] = poses[some[order[k]]];
  return whole[order[0]];
}

// points (B, 5, N): x, y, z (m), u, v (px); usable (B, N) bool; f and c (B, 2) px; draws (B, H, 3), float32. Outputs: R
// (B, 3, 3), orthonormal, and t (B, 3) float64; found (B) bool.
void robust_pose(Tensor points, Tensor usable, Tensor f, Tensor c, Tensor draws, Tensor R, Tensor t, Tensor found,
                 double threshold_px, int64_t local_optimisation, int64_t polish_steps, int64_t search_points,
                 int64_t preview_points, int64_t shortlist, int64_t keep, double damping, double min_depth,
                 double min_height, double max_cosine) {
  const Options o{search_points, preview_points, shortlist, keep, static_cast<float>(damping), static_cast<float>(min_depth),
                  min_height, max_cosine};
  const int64_t B = points.size(0), N = points.size(2), H = draws.size(1);
  const float limit = static_cast<float>(threshold_px * threshold_px);
  for (int64_t b = 0; b < B; ++b) {
    const float *from = data<float>(points) + 5 * N * b, *lens = data<float>(f) + 2 * b, *middle = data<float>(c) + 2 * b;
    std::vector<int64_t> used, of, preview;
    for (int64_t n = 0; n < N; ++n) {
      if (data<bool>(usable)[N * b + n]) used.push_back(n);
    }
    for (const int64_t k : evenly_spaced_slots(used.size(), std::min(o.search_points, N))) of.push_back(used[k]);
    for (const int64_t k : evenly_spaced_slots(of.size(), std::min(o.preview, N))) preview.push_back(of[k]);
    Points near(lens, o.min_depth), few(lens, o.min_depth), all(lens, o.min_depth);
    near.take(from, N, of, middle, limit);
    few.take(from, N, preview, middle, limit);
    all.take(from, N, used, middle, limit);
    std::vector<Motion> best(o.keep);
    data<bool>(found)[b] = search(near, few, data<float>(draws) + 3 * H * b, H, best, o) < INFINITE;
    size_t first = 0;
    float least = INFINITE;
    for (size_t k = 0; k < best.size(); ++k) {
      const float cost = minimise(near, best[k], local_optimisation, o.damping);
      if (k == 0 || cost < least) {
        first = k;
        least = cost;
      }
    }
    Motion& T = best[first];
    minimise(all, T, polish_steps, o.damping);
    double rows[3][3];
    for (int i = 0; i < 3; ++i) {
      for (int k = 0; k < 2; ++k) rows[k][i] = T.R[k][i];
      data<double>(t)[3 * b + i] = T.t[i];
    }
    unit(rows[0]);
    cross(rows[0], rows[1], rows[2]);
    unit(rows[2]);
    cross(rows[2], rows[0], rows[1]);
    std::copy(&rows[0][0], &rows[0][0] + 9, data<double>(R) + 9 * b);
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "robust_pose(Tensor points, Tensor usable, Tensor f, Tensor c, Tensor draws, Tensor(a!) R, Tensor(b!) t, "
      "Tensor(c!) found, float threshold_px, int local_optimisation, int polish_steps, int search_points, "
      "int preview_points, int shortlist, int keep, float damping, float min_depth, float min_height, float max_cosine) "
      "-> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) { m.impl("robust_pose", TORCH_BOX(&robust_pose)); }
