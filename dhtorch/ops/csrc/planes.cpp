// Depth of surfaces without texture. Reference: fill_planes of dhtorch/pipeline/planes.py, whose definitions and alphabet these
// are; sums in another order, so that planes agree up to rounding. Of the cells only those are fitted on which an answer
// depends. One thread, no gradient. The dispatch checks dtypes and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <type_traits>
#include <vector>

namespace {

// Hypotheses that are scored together, so that support is loaded once for all of them: as registers allow.
constexpr int64_t TOGETHER = LANES == 16 ? 4 : 2;

// Sums over the pixels of a cell: of the known ones their number, rows, inverse depths and relative variances, of all their
// grey values and the number of the unanswered.
constexpr int64_t SUMS = 6;

typedef uint8_t Bytes __attribute__((vector_size(LANES)));

// The first n values as lanes of a vector, 0 in the others.
template <typename V, typename T, typename Count>
inline V first(const T* from, Count n) {
  V lanes = {};
  std::memcpy(&lanes, from, n * sizeof(T));
  return lanes;
}

// Of the DenseOptions of those names, and MIN_PLANE_INVERSE_DEPTH.
struct Options {
  int64_t side, min_pixels, ray_support, min_support, neighbours;
  float grey_difference, inlier_ratio, least_area, min_share, max_sigma, max_disagreement, max_difference, max_refuted, spread,
      independent, common, max_relative, min_q;
};

// One view of (h, w) pixels; the last five are answered in place.
struct Maps {
  int64_t h, w;
  const float *swept, *swept_sigma;  // before the filters
  const int32_t* swept_gate;
  const float *returned, *returned_sigma;
  const bool* usable;
  const float* grey;
  float *depth, *sigma, *score;
  int32_t *source, *gate;

  bool is_unanswered(int64_t pixel) const { return gate[pixel] != GATE_ANSWER && !usable[pixel]; }
};

// Means over the known pixels of every cell, of _cells in planes.py, and whether a pixel of it is unanswered.
struct Cells {
  int64_t side, rows, columns, wide;
  std::vector<float> u, v, q, variance, grey;
  std::vector<char> answered, to_fill;
  std::vector<float> sums;  // (SUMS, wide) over the rows of a cell

  Cells(int64_t h, int64_t w, int64_t side)
      : side(side), rows((h + side - 1) / side), columns((w + side - 1) / side), wide(w + LANES), sums(SUMS * wide) {
    for (std::vector<float>* each : {&u, &v, &q, &variance, &grey}) each->resize(rows * columns);
    answered.resize(rows * columns);
    to_fill.resize(rows * columns);
  }

  // Add `n` pixels of a row, at most LANES, to the sums.
  template <typename Count>
  void add(const Maps& of, int64_t y, int64_t x, Count n) {
    const int64_t at = y * of.w + x;
    const Vector zero = {}, one = zero + 1.0f;
    const Bits silent = first<Bits>(of.gate + at, n) != GATE_ANSWER, keep = first<Bits>(of.swept_gate + at, n) == GATE_ANSWER,
               has = __builtin_convertvector(first<Bytes>(of.usable + at, n), Bits) != 0;
    const Vector swept = first<Vector>(of.swept + at, n), returned = first<Vector>(of.returned + at, n);
    const Vector depth = has ? returned : keep ? swept : zero;
    const Vector deviation = has ? first<Vector>(of.returned_sigma + at, n) : first<Vector>(of.swept_sigma + at, n);
    const Bits known = (depth > 0.0f) & (depth <= std::numeric_limits<float>::max());
    const Vector q = one / (known ? depth : one), ratio = deviation / (known ? depth : one);
    const Vector terms[] = {known ? one : zero, known ? zero + static_cast<float>(y) : zero,
                            known ? q : zero,   known ? ratio * ratio : zero,
                            first<Vector>(of.grey + at, n), silent & ~has ? one : zero};
    for (int64_t i = 0; i < SUMS; ++i) store(load(&sums[i * wide + x]) + terms[i], &sums[i * wide + x]);
  }

  void read(const Maps& of, int64_t min_pixels) {
    for (int64_t row = 0; row < rows; ++row) {
      std::fill(sums.begin(), sums.end(), 0.0f);
      const int64_t last = std::min((row + 1) * side, of.h);
      for (int64_t y = row * side; y < last; ++y) {
        int64_t x = 0;
        for (; x + LANES <= of.w; x += LANES) add(of, y, x, std::integral_constant<int64_t, LANES>());
        if (x < of.w) add(of, y, x, of.w - x);
      }
      for (int64_t column = 0; column < columns; ++column) {
        const int64_t n = row * columns + column, right = std::min((column + 1) * side, of.w);
        float across = 0, sum[SUMS] = {};
        for (int64_t x = column * side; x < right; ++x) {
          across += static_cast<float>(x) * sums[x];
          for (int64_t i = 0; i < SUMS; ++i) sum[i] += sums[i * wide + x];
        }
        const float safe = std::max(sum[0], 1.0f);
        u[n] = across / safe;
        v[n] = sum[1] / safe;
        q[n] = sum[2] / safe;
        variance[n] = sum[3] / safe;
        grey[n] = sum[4] / static_cast<float>((last - row * side) * (right - column * side));
        answered[n] = sum[0] >= static_cast<float>(min_pixels);
        to_fill[n] = sum[5] > 0.0f;
      }
    }
  }

  // Pixel in the middle of a cell, of its row or column.
  float middle(int64_t at) const { return static_cast<float>(at * side) + 0.5f * static_cast<float>(side - 1); }
};

// Steps (row, column) from a cell along its rays, (directions, reach, 2).
struct Rays {
  const int32_t* steps;
  int64_t directions, reach;

  // Flat indices (S) of the support of cell n, ray by ray from the nearest, -1 where there is none -> their number.
  int64_t trace(const Cells& cells, int64_t n, const Options& options, int32_t* slots) const {
    const int64_t row = n / cells.columns, column = n % cells.columns;
    int64_t total = 0;
    std::fill_n(slots, directions * options.ray_support, -1);
    for (int64_t k = 0; k < directions; ++k) {
      int64_t count = 0;
      for (int64_t r = k * reach; r < (k + 1) * reach && count < options.ray_support; ++r) {
        const int64_t y = row + steps[2 * r], x = column + steps[2 * r + 1], m = y * cells.columns + x;
        if (y < 0 || y >= cells.rows || x < 0 || x >= cells.columns) break;
        if (!(std::fabs(cells.grey[m] - cells.grey[n]) <= options.grey_difference)) break;
        if (cells.answered[m]) slots[k * options.ray_support + count++] = static_cast<int32_t>(m);
      }
      total += count;
    }
    return total;
  }
};

inline Vector smaller(Vector a, Vector b) { return a < b ? a : b; }
inline Vector larger(Vector a, Vector b) { return a > b ? a : b; }
inline Vector magnitude(Vector x) { return larger(x, -x); }

// The planes of cells side by side, of _Planes in planes.py.
struct Planes {
  Vector q_0, x_0, y_0, a, b, n, xx, xy, yy, residual, common;

  Vector at(Vector x, Vector y) const { return q_0 + a * (x - x_0) + b * (y - y_0); }
};

// The plane of one cell, with its tests.
struct Plane {
  float q_0, x_0, y_0, a, b, n, xx, xy, yy, residual, common;
  float q = 0;          // in the middle of the cell
  bool enough = false;  // support
  bool holds = false;   // but for its disagreement with the planes around
  bool fitted = false;

  float at(float x, float y) const { return q_0 + a * (x - x_0) + b * (y - y_0); }
  float leverage(float x, float y) const {
    const float dx = x - x_0, dy = y - y_0;
    return 1.0f / std::max(n, 1.0f) + (dx * dx * xx + 2.0f * dx * dy * xy + dy * dy * yy);
  }
};

// The support of LANES cells side by side, (S) each.
struct Support {
  int64_t S;
  std::vector<Lanes> x, y, q, variance, exists, x_weighted, y_weighted, weight, q_weighted, inlier;
  const int32_t* triples;  // (H, 3)
  int64_t H;

  Support(int64_t S, const int32_t* triples, int64_t H) : S(S), triples(triples), H(H) {
    for (std::vector<Lanes>* each : {&x, &y, &q, &variance, &exists, &x_weighted, &y_weighted, &weight, &q_weighted, &inlier}) {
      each->resize(S);
    }
  }

  // The support `slots` (S) of cell n as that of lane i; none without slots.
  void take(const Cells& cells, int64_t n, const int32_t* slots, int64_t i) {
    const float right = cells.middle(n % cells.columns), down = cells.middle(n / cells.columns);
    for (int64_t s = 0; s < S; ++s) {
      const bool has = slots && slots[s] >= 0;
      const int64_t m = has ? slots[s] : 0;
      x[s].of[i] = has ? cells.u[m] - right : 0.0f;
      y[s].of[i] = has ? cells.v[m] - down : 0.0f;
      q[s].of[i] = has ? cells.q[m] : 0.0f;
      variance[s].of[i] = has ? cells.variance[m] : 0.0f;
      exists[s].of[i] = has ? 1.0f : 0.0f;
    }
  }

  // The plane through three support cells, and whether it counts.
  Bits hypothesis(const int32_t* triple, float least_area, Vector* abc) const {
    Vector X[3], Y[3], Q[3], there = Vector{} + 1.0f;
    for (int64_t k = 0; k < 3; ++k) {
      X[k] = load(x[triple[k]].of);
      Y[k] = load(y[triple[k]].of);
      Q[k] = load(q[triple[k]].of);
      there = smaller(there, load(exists[triple[k]].of));
    }
    const Vector dx = X[1] - X[0], dy = Y[1] - Y[0], dq = Q[1] - Q[0], ex = X[2] - X[0], ey = Y[2] - Y[0], eq = Q[2] - Q[0];
    Vector area = dx * ey - dy * ex;
    const Bits valid = (there > 0.0f) & (magnitude(area) > least_area);
    area = valid ? area : Vector{} + 1.0f;
    abc[0] = (dq * ey - dy * eq) / area;
    abc[1] = (dx * eq - dq * ex) / area;
    abc[2] = Q[0] - abc[0] * X[0] - abc[1] * Y[0];
    return valid & (abc[2] > 0.0f);
  }

  Vector residual(const Vector* abc, int64_t s) const {
    const Vector along = fused(abc[1], load(y_weighted[s].of), abc[0] * load(x_weighted[s].of));
    return fused(abc[2], load(weight[s].of), along) - load(q_weighted[s].of);
  }

  // Inliers of the plane through three of the support that costs least, of _cheapest_plane in planes.py.
  void choose(const Options& options) {
    const Vector one = Vector{} + 1.0f;
    for (int64_t s = 0; s < S; ++s) {
      const Vector limit = larger(options.inlier_ratio * load(q[s].of), Vector{} + options.min_q);
      const Vector by = load(exists[s].of) > 0.0f ? one / limit : Vector{};
      store(load(x[s].of) * by, x_weighted[s].of);
      store(load(y[s].of) * by, y_weighted[s].of);
      store(by, weight[s].of);
      store(load(q[s].of) * by, q_weighted[s].of);
    }
    Vector least = Vector{} + std::numeric_limits<float>::infinity(), best[3] = {};
    for (int64_t h = 0; h < H; h += TOGETHER) {
      Vector abc[TOGETHER][3], cost[TOGETHER] = {};
      Bits valid[TOGETHER];
      for (int64_t i = 0; i < TOGETHER; ++i) {
        valid[i] = hypothesis(triples + 3 * std::min(h + i, H - 1), options.least_area, abc[i]);
      }
      for (int64_t s = 0; s < S; ++s) {
        for (int64_t i = 0; i < TOGETHER; ++i) {
          const Vector off = residual(abc[i], s);
          cost[i] += smaller(off * off, one);
        }
      }
      for (int64_t i = 0; i < TOGETHER; ++i) {
        const Bits better = valid[i] & (cost[i] < least);
        least = better ? cost[i] : least;
        for (int64_t k = 0; k < 3; ++k) best[k] = better ? abc[i][k] : best[k];
      }
    }
    const Vector exist = least < std::numeric_limits<float>::max() ? one : Vector{};
    for (int64_t s = 0; s < S; ++s) {
      store(magnitude(residual(best, s)) < 1.0f ? smaller(exist, load(exists[s].of)) : Vector{}, inlier[s].of);
    }
  }

  // Least squares over the inliers, of _least_squares in planes.py.
  Planes fit(const Options& options) const {
    const Vector zero = {}, one = zero + 1.0f;
    Planes to = {};
    for (int64_t s = 0; s < S; ++s) {
      const Vector in = load(inlier[s].of);
      to.n += in;
      to.x_0 += in * load(x[s].of);
      to.y_0 += in * load(y[s].of);
      to.q_0 += in * load(q[s].of);
      to.common += in > 0.0f ? load(variance[s].of) : zero;
    }
    const Vector n = larger(to.n, one);
    to.x_0 /= n;
    to.y_0 /= n;
    to.q_0 /= n;
    to.common /= n;
    Vector xx = {}, xy = {}, yy = {}, xq = {}, yq = {};
    for (int64_t s = 0; s < S; ++s) {
      const Vector in = load(inlier[s].of), dq = load(q[s].of) - to.q_0;
      const Vector dx = load(x[s].of) - to.x_0, dy = load(y[s].of) - to.y_0, x_in = in * dx, y_in = in * dy;
      xx += x_in * dx;
      xy += x_in * dy;
      yy += y_in * dy;
      xq += x_in * dq;
      yq += y_in * dq;
    }
    for (Vector* sum : {&xx, &xy, &yy, &xq, &yq}) *sum /= n;
    const float within = static_cast<float>(options.side * options.side) / 12.0f;  // scatter within one cell
    const Vector det = larger(xx * yy - xy * xy, zero + within * within), scale = one / (det * n);
    to.a = (yy * xq - xy * yq) / det;
    to.b = (xx * yq - xy * xq) / det;
    to.xx = yy * scale;
    to.xy = -xy * scale;
    to.yy = xx * scale;
    for (int64_t s = 0; s < S; ++s) {
      const Vector dx = load(x[s].of) - to.x_0, dy = load(y[s].of) - to.y_0, own = load(q[s].of);
      const Vector off = (to.a * dx + to.b * dy - (own - to.q_0)) / larger(own, zero + options.min_q);
      to.residual += load(inlier[s].of) * (off * off);
    }
    to.residual /= n;
    return to;
  }

  // The inliers become the support near the planes.
  void choose_again(const Planes& planes, float inlier_ratio) {
    const Vector any = planes.n > 0.0f ? Vector{} + 1.0f : Vector{};
    for (int64_t s = 0; s < S; ++s) {
      const Vector own = load(q[s].of), off = magnitude(planes.at(load(x[s].of), load(y[s].of)) - own);
      store(off < inlier_ratio * own ? smaller(any, load(exists[s].of)) : Vector{}, inlier[s].of);
    }
  }

  // Whether the sensor's silence refutes the plane of lane i, of _is_refuted in planes.py.
  bool is_refuted(const Plane& plane, int64_t i, float reach, const Options& options) const {
    const float side = static_cast<float>(options.side);
    float on_plane = 0, refuted = 0;
    for (int64_t s = 0; s < S; s += options.ray_support) {
      const float right = x[s].of[i], down = y[s].of[i], own = q[s].of[i];
      if (exists[s].of[i] == 0.0f || !(std::fabs(plane.at(right, down) - own) < options.inlier_ratio * own)) continue;
      const float before = 1.0f - side / std::max(std::sqrt(right * right + down * down), side);
      on_plane += 1.0f;
      if (plane.at(before * right, before * down) * reach > 1.0f) refuted += 1.0f;
    }
    return refuted > options.max_refuted * on_plane;
  }

  // The plane of lane i of `planes` with its tests, of _tested in planes.py.
  Plane test(const Planes& planes, int64_t i, float reach, const Options& options) const {
    Plane one = {planes.q_0[i], planes.x_0[i], planes.y_0[i],          planes.a[i],     planes.b[i], planes.n[i], planes.xx[i],
                 planes.xy[i],  planes.yy[i],  std::sqrt(planes.residual[i]), planes.common[i]};
    float count = 0;
    for (int64_t s = 0; s < S; ++s) count += exists[s].of[i];
    one.q = one.at(0.0f, 0.0f);
    one.enough = one.n >= static_cast<float>(options.min_support) && one.q > options.min_q;
    one.holds = one.enough && one.n >= options.min_share * count &&
                options.spread * std::sqrt(one.leverage(0.0f, 0.0f)) <= options.max_sigma &&
                !is_refuted(one, i, reach, options);
    one.fitted = true;
    return one;
  }
};

// The planes of the cells of one view.
struct Fits {
  const Cells& cells;
  const Rays& rays;
  const Options& options;
  Support& support;
  float reach;
  std::vector<Plane> plane;
  std::vector<int32_t> slots;

  Fits(const Cells& cells, const Rays& rays, const Options& options, Support& support, float reach)
      : cells(cells), rays(rays), options(options), support(support), reach(reach), plane(cells.rows * cells.columns),
        slots(support.S) {}

  // Fit the planes of cells, LANES of them at once; without as much support as a plane needs there is none.
  void fit(const std::vector<char>& wanted) {
    int64_t taken[LANES], count = 0;
    for (int64_t n = 0; n < static_cast<int64_t>(plane.size()); ++n) {
      if (!wanted[n] || plane[n].fitted) continue;
      plane[n].fitted = true;
      if (rays.trace(cells, n, options, slots.data()) < std::max<int64_t>(options.min_support, 1)) continue;
      support.take(cells, n, slots.data(), count);
      taken[count++] = n;
      if (count < LANES) continue;
      fit(taken, count);
      count = 0;
    }
    for (int64_t i = count; count && i < LANES; ++i) support.take(cells, 0, nullptr, i);
    if (count) fit(taken, count);
  }

  void fit(const int64_t* taken, int64_t count) {
    support.choose(options);
    support.choose_again(support.fit(options), options.inlier_ratio);
    const Planes planes = support.fit(options);
    for (int64_t i = 0; i < count; ++i) plane[taken[i]] = support.test(planes, i, reach, options);
  }

  // Call `visit` for the cells around cell n, itself too, with their steps right and down.
  template <typename Visit>
  void around(int64_t n, Visit visit) const {
    const int64_t row = n / cells.columns, column = n % cells.columns, radius = options.neighbours;
    for (int64_t y = std::max<int64_t>(row - radius, 0); y <= std::min(row + radius, cells.rows - 1); ++y) {
      for (int64_t x = std::max<int64_t>(column - radius, 0); x <= std::min(column + radius, cells.columns - 1); ++x) {
        visit(y * cells.columns + x, x - column, y - row);
      }
    }
  }

  // Mean relative difference of a plane from those around, of _disagreement in planes.py.
  float disagreement(int64_t n) const {
    const float q = plane[n].q, side = static_cast<float>(cells.side);
    float total = 0, count = 0;
    around(n, [&](int64_t m, int64_t right, int64_t down) {
      const Plane& of = plane[m];
      if (!of.enough || m == n) return;
      const float there = of.q - side * (of.a * static_cast<float>(right) + of.b * static_cast<float>(down));
      total += std::min(std::fabs(there / q - 1.0f), options.max_difference);
      count += 1.0f;
    });
    return total / std::max(count, 1.0f);
  }

  // Answer the unanswered pixels of cell n, of _at_pixels in planes.py and fill_fields in map_filters.py.
  void answer(const Maps& maps, int64_t n, float differing) const {
    const Plane& of = plane[n];
    const int64_t row = n / cells.columns, column = n % cells.columns;
    const float constant = of.residual * of.residual, both = differing * differing + options.common * of.common;
    for (int64_t v = row * cells.side; v < std::min((row + 1) * cells.side, maps.h); ++v) {
      for (int64_t u = column * cells.side; u < std::min((column + 1) * cells.side, maps.w); ++u) {
        const int64_t pixel = v * maps.w + u;
        if (!maps.is_unanswered(pixel)) continue;
        const float x = static_cast<float>(u) - cells.middle(column), y = static_cast<float>(v) - cells.middle(row);
        const float q = of.at(x, y), depth = 1.0f / q;
        const float relative = std::sqrt(constant + options.independent * of.leverage(x, y) + both);
        if (!(q > options.min_q) || !(relative <= options.max_relative) || q * reach > 1.0f) continue;
        maps.depth[pixel] = depth;
        maps.sigma[pixel] = relative * depth;
        maps.score[pixel] = 0.1f / (0.1f + relative);
        maps.source[pixel] = SOURCE_FILLED;
        maps.gate[pixel] = GATE_ANSWER;
      }
    }
  }
};

// Maps (B, h, w): swept and its sigma, float32, and gate, int32, before the filters; returned, its sigma and usable, bool;
// grey. reach (B) m; steps (directions, cells, 2) and triples (H, 3) int32. In and out: depth, sigma, score float32, source
// and gate int32, (B, h, w).
void fill_planes(Tensor swept, Tensor swept_sigma, Tensor swept_gate, Tensor returned, Tensor returned_sigma, Tensor usable,
                 Tensor grey, Tensor reach, Tensor steps, Tensor triples, Tensor depth, Tensor sigma, Tensor score,
                 Tensor source, Tensor gate, int64_t plane_cell_px, int64_t min_cell_pixels, int64_t plane_ray_support,
                 int64_t min_plane_support, int64_t plane_neighbours, double plane_grey_difference, double plane_inlier_ratio,
                 double min_triple_area, double min_plane_share, double max_plane_sigma_rel, double max_plane_disagreement,
                 double max_plane_difference, double max_refuted_rays, double independent_support, double common_sigma_ratio,
                 double max_sigma_rel, double min_inverse_depth) {
  const int64_t B = depth.size(0), h = depth.size(1), w = depth.size(2);
  const double spread = plane_inlier_ratio / 3;
  const auto single = [](double x) { return static_cast<float>(x); };
  const Options options = {plane_cell_px, min_cell_pixels, plane_ray_support, min_plane_support, plane_neighbours,
                           single(plane_grey_difference), single(plane_inlier_ratio),
                           single(static_cast<double>(plane_cell_px * plane_cell_px) * min_triple_area),
                           single(min_plane_share), single(max_plane_sigma_rel), single(max_plane_disagreement),
                           single(max_plane_difference), single(max_refuted_rays), single(spread),
                           single(spread * spread / independent_support), single(common_sigma_ratio * common_sigma_ratio),
                           single(max_sigma_rel), single(min_inverse_depth)};
  const Rays rays = {data<int32_t>(steps), steps.size(0), steps.size(1)};
  Support support(rays.directions * plane_ray_support, data<int32_t>(triples), triples.size(0));
  Cells cells(h, w, plane_cell_px);
  std::vector<char> compared(cells.rows * cells.columns);
  for (int64_t k = 0; k < B; ++k) {
    const int64_t at = h * w * k;
    const Maps maps = {h, w, data<float>(swept) + at, data<float>(swept_sigma) + at, data<int32_t>(swept_gate) + at,
                       data<float>(returned) + at, data<float>(returned_sigma) + at, data<bool>(usable) + at,
                       data<float>(grey) + at, data<float>(depth) + at, data<float>(sigma) + at, data<float>(score) + at,
                       data<int32_t>(source) + at, data<int32_t>(gate) + at};
    if (std::find(maps.swept_gate, maps.swept_gate + h * w, GATE_ANSWER) == maps.swept_gate + h * w) continue;
    cells.read(maps, min_cell_pixels);
    Fits fits(cells, rays, options, support, data<float>(reach)[k]);
    fits.fit(cells.to_fill);
    std::fill(compared.begin(), compared.end(), 0);
    for (int64_t n = 0; n < cells.rows * cells.columns; ++n) {
      if (fits.plane[n].holds) fits.around(n, [&](int64_t m, int64_t, int64_t) { compared[m] = 1; });
    }
    fits.fit(compared);
    for (int64_t n = 0; n < cells.rows * cells.columns; ++n) {
      if (!cells.to_fill[n] || !fits.plane[n].holds) continue;
      const float differing = fits.disagreement(n);
      if (differing <= options.max_disagreement) fits.answer(maps, n, differing);
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "fill_planes(Tensor swept, Tensor swept_sigma, Tensor swept_gate, Tensor returned, Tensor returned_sigma, "
      "Tensor usable, Tensor grey, Tensor reach, Tensor steps, Tensor triples, Tensor(a!) depth, Tensor(b!) sigma, "
      "Tensor(c!) score, Tensor(d!) source, Tensor(e!) gate, int plane_cell_px, int min_cell_pixels, "
      "int plane_ray_support, int min_plane_support, int plane_neighbours, float plane_grey_difference, "
      "float plane_inlier_ratio, float min_triple_area, float min_plane_share, float max_plane_sigma_rel, "
      "float max_plane_disagreement, float max_plane_difference, float max_refuted_rays, float independent_support, "
      "float common_sigma_ratio, float max_sigma_rel, float min_inverse_depth) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) { m.impl("fill_planes", TORCH_BOX(&fill_planes)); }
