// One level of the Lucas-Kanade search, one point after another. Reference: _lk_level in
// dhtorch/geometry/lucas_kanade.py; the same maps, steps and criteria. Sums over a window are taken in another order, so
// that displacements agree up to rounding; a point's result does not depend on the others. One thread, no gradient. The
// dispatch checks dtypes and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

constexpr int64_t MAX_NODES = 2 * MAX_MAP_RADIUS_PX + 2;  // along a side of the largest map
static_assert(MAX_NODES * MAX_NODES <= 64);               // one bit each

inline Vector between(Vector a, Vector b, float weight) {  // as torch.lerp
  return weight < 0.5f ? a + weight * (b - a) : b - (b - a) * (1.0f - weight);
}

struct Level {
  const float* pixels;
  int64_t planes, rows, width, pad, margin;

  Level(const Tensor& x, int64_t pad, int64_t margin)
      : pixels(data<float>(x)), planes(x.size(1)), rows(x.size(2)), width(x.size(3)), pad(pad), margin(margin) {}

  // The pixel left of (axis 0) or above (1) a position, on the level or in the margin around it.
  float corner(float place, int axis) const {
    const float most = static_cast<float>((axis ? rows : width) - 2 * pad - 1 + margin), least = static_cast<float>(-margin);
    const float whole = std::floor(place);
    return whole > least ? std::min(whole, most) : least;
  }
  const float* at(int64_t batch, int64_t plane, float u, float v, int64_t before) const {
    const int64_t column = static_cast<int64_t>(u) + pad - before, row = static_cast<int64_t>(v) + pad - before;
    return pixels + ((planes * batch + plane) * rows + row) * width + column;
  }
};

// The window of image 0 as three planes g_x, g_y, T of `size` rows, padded with zeros to whole vectors, after the
// normalisation; and sums over it: g T, A, T T.
//
// Rows are read in whole vectors, past their end but not past the image's: a level has more padding than a window reaches.
struct Window {
  int64_t size, wide, count;
  std::vector<float> planes, inside;  // inside: 1 in the window, 0 in the padding
  Bits last;                          // mask of the lanes of a row's last vector that belong to the window
  float moments[6];

  explicit Window(int64_t size)
      : size(size), wide((size + LANES - 1) / LANES * LANES), count(size * wide), planes(3 * count), inside(count) {
    for (int64_t i = 0; i < size; ++i) std::fill_n(inside.data() + i * wide, size, 1.0f);
    for (int64_t i = 0; i < LANES; ++i) last[i] = wide - LANES + i < size ? -1 : 0;
  }

  float* plane(int64_t k) { return planes.data() + k * count; }
  const float* plane(int64_t k) const { return planes.data() + k * count; }

  void read(const Level& level, float x, float y, int64_t batch, bool exactly) {
    const float u = level.corner(x, 0), v = level.corner(y, 1), right = x - u, down = y - v;
    for (int64_t k = 0; k < 3; ++k) {
      const float* from = level.at(batch, (k + 1) % 3, u, v, size / 2);
      for (int64_t j = 0; j < wide; j += LANES) {
        const Bits kept = j + LANES < wide ? ~Bits{} : last;
        const auto row = [&](int64_t i) {
          const float* pixel = from + i * level.width + j;
          return exactly ? between(load(pixel), load(pixel + 1), right) : load(pixel);
        };
        float* to = plane(k) + j;
        Vector above = row(0);
        for (int64_t i = 0; i < size; ++i) {
          const Vector below = row(exactly ? i + 1 : i);
          const Vector here = exactly ? between(above, below, down) : below;
          store(reinterpret_cast<Vector>(reinterpret_cast<Bits>(here) & kept), to + i * wide);
          above = below;
        }
      }
    }
  }

  float sum(const float* a, const float* b) const {
    Vector sums = {};
    for (int64_t i = 0; i < count; i += LANES) sums += load(a + i) * load(b + i);
    return total(sums);
  }

  void subtract(float* __restrict from, const float* __restrict what, float share) {
    for (int64_t i = 0; i < count; ++i) from[i] -= share * what[i];
  }

  void project(bool remove_bias, bool estimate_gain) {
    if (remove_bias) {
      for (int64_t k = 0; k < 3; ++k) {
        const float mean = sum(plane(k), inside.data()) / static_cast<float>(size * size);
        subtract(plane(k), inside.data(), mean);
      }
    }
    float *g_x = plane(0), *g_y = plane(1), *T = plane(2);
    moments[5] = sum(T, T);
    if (estimate_gain) {
      for (float* g : {g_x, g_y}) subtract(g, T, sum(g, T) / (moments[5] > 0.0f ? moments[5] : 1.0f));
    }
    const float found[5] = {sum(g_x, T), sum(g_y, T), sum(g_x, g_x), sum(g_y, g_x), sum(g_y, g_y)};
    std::copy_n(found, 5, moments);
  }
};

// The correlation map of one point: the window's K planes correlated with J (rows of `stride` pixels) at n x n offsets,
// as Gauss-Newton steps. Only a few nodes are read, so each is computed on first use.
template <int K>
struct Map {
  const Window& window;
  const float *inverse, *moments, *J;
  int64_t stride, n;
  uint64_t known = 0;  // one bit per node
  float field[K * MAX_NODES * MAX_NODES];

  // R x M nodes, the first at row v and column u.
  template <int R, int M>
  void correlate(int64_t v, int64_t u) {
    Vector sums[K][R][M] = {};
    for (int64_t i = 0; i < window.size; ++i) {
      for (int64_t j = 0; j < window.wide; j += LANES) {
        Vector own[K];
        for (int k = 0; k < K; ++k) own[k] = load(window.plane(k) + i * window.wide + j);
        for (int r = 0; r < R; ++r) {
          for (int m = 0; m < M; ++m) {
            const Vector there = load(J + (i + v + r) * stride + j + u + m);
            for (int k = 0; k < K; ++k) sums[k][r][m] += own[k] * there;
          }
        }
      }
    }
    for (int r = 0; r < R; ++r) {
      for (int m = 0; m < M; ++m) {
        float C[K];
        for (int k = 0; k < K; ++k) C[k] = total(sums[k][r][m]);
        put((v + r) * n + u + m, C);
      }
    }
  }

  void put(int64_t node, const float* C) {
    const float a = C[0] - moments[0], b = C[1] - moments[1];
    field[node] = inverse[0] * a + inverse[1] * b;
    field[n * n + node] = inverse[1] * a + inverse[2] * b;
    if constexpr (K == 3) field[2 * n * n + node] = moments[5] > 0.0f ? C[2] / moments[5] : 1.0f;
    known |= uint64_t{1} << node;
  }

  // Nodes of two rows and columns, or one at a border.
  void ensure(int64_t v, int64_t last_v, int64_t u, int64_t last_u) {
    const bool square = last_v > v && last_u > u;
    const uint64_t two = uint64_t{3} << (v * n + u), four = two | two << n;
    if (square && !(known & four)) return correlate<2, 2>(v, u);
    if (square && (known & four) == four) return;
    for (int64_t i = v; i <= last_v; ++i) {
      for (int64_t j = u; j <= last_u; ++j) {
        if (!(known >> (i * n + j) & 1)) correlate<1, 1>(i, j);
      }
    }
  }

  // Bilinear interpolation of the field, which is zero beyond its border.
  void interpolate(const float* p, float* found) {
    const float u = std::floor(p[0]), v = std::floor(p[1]);
    std::fill_n(found, K, 0.0f);
    if (!(u >= -1.0f && v >= -1.0f && u < static_cast<float>(n) && v < static_cast<float>(n))) return;
    const int64_t column = static_cast<int64_t>(u), row = static_cast<int64_t>(v);
    const int64_t first[2] = {std::max<int64_t>(column, 0), std::max<int64_t>(row, 0)};
    const int64_t last[2] = {std::min(column + 1, n - 1), std::min(row + 1, n - 1)};
    ensure(first[1], last[1], first[0], last[0]);
    for (int k = 0; k < K; ++k) {
      for (int64_t i = first[1]; i <= last[1]; ++i) {
        float along = 0.0f;
        for (int64_t j = first[0]; j <= last[0]; ++j) {
          along += field[(k * n + i) * n + j] * (1.0f - std::abs(p[0] - static_cast<float>(j)));
        }
        found[k] += along * (1.0f - std::abs(p[1] - static_cast<float>(i)));
      }
    }
  }
};

struct Options {
  int64_t iterations, steps_per_map;
  float epsilon;
  double min_eigenvalue;  // of A, summed over the window
  float min_gain, max_gain;
  bool extrapolate;  // on the finest level: Aitken's step, and its limits
  int64_t aitken_step;
  float min_ratio, max_ratio;
  float low[2], high[2];  // bounds of the points

  bool within(const float* x) const {
    return x[0] >= low[0] && x[0] <= high[0] && x[1] >= low[1] && x[1] <= high[1];
  }
};

// Inverse of A = ((a, b), (b, c)), zero where its smaller eigenvalue is not above the limit; returns whether it is.
bool invert(const float* A, double least, float* inverse) {
  const double a = A[0], b = A[1], c = A[2], half = (a - c) / 2, square = half * half + b * b;
  const bool textured = (a + c) / 2 - std::sqrt(square) > least;
  const double det = a * c - b * b;
  inverse[0] = textured ? static_cast<float>(c / det) : 0.0f;
  inverse[1] = textured ? static_cast<float>(-b / det) : 0.0f;
  inverse[2] = textured ? static_cast<float>(a / det) : 0.0f;
  return textured;
}

struct State {
  float d[2];
  bool live, held;
};

// Gauss-Newton steps of one point on a map whose first node is the target's pixel `corner`.
template <int K>
void walk(Map<K>& map, const float* corner, const float* x, int64_t steps, const Options& o, State& s) {
  const float start[2] = {x[0] + s.d[0] - corner[0], x[1] + s.d[1] - corner[1]};
  float p[2] = {start[0], start[1]}, step[2] = {0.0f, 0.0f}, square = 0.0f;
  for (int64_t k = 1; k <= steps; ++k) {
    const float last[2] = {step[0], step[1]};
    float found[K];
    map.interpolate(p, found);
    const float gain = K == 3 ? std::clamp(found[K - 1], o.min_gain, o.max_gain) : 1.0f;
    step[0] = found[0] / gain;
    step[1] = found[1] / gain;
    square = step[0] * step[0] + step[1] * step[1];
    if (k == o.aitken_step && k < steps && o.extrapolate && square > o.epsilon * o.epsilon) {
      const float before = std::max(last[0] * last[0] + last[1] * last[1], o.epsilon * o.epsilon);
      const float ratio = (step[0] * last[0] + step[1] * last[1]) / before;
      for (float& part : step) part /= 1.0f - std::clamp(ratio, o.min_ratio, o.max_ratio);
      square = step[0] * step[0] + step[1] * step[1];
    }
    p[0] -= step[0];
    p[1] -= step[1];
  }
  if (!s.live || !std::isfinite(p[0]) || !std::isfinite(p[1])) std::copy_n(start, 2, p);
  const float side = static_cast<float>(map.n - 1);
  s.held = p[0] >= 0.0f && p[0] <= side && p[1] >= 0.0f && p[1] <= side;
  const float place[2] = {p[0] + corner[0], p[1] + corner[1]};
  s.live = s.live && (!s.held || square > o.epsilon * o.epsilon) && o.within(place);
  for (int axis = 0; axis < 2; ++axis) s.d[axis] = place[axis] - x[axis];
}

// Whether rows are finite, in whole vectors.
bool finite(const float* from, int64_t stride, int64_t rows, int64_t columns) {
  Vector nothing = {};
  for (int64_t i = 0; i < rows; ++i) {
    for (int64_t j = 0; j < columns; j += LANES) nothing += 0.0f * load(from + i * stride + j);
  }
  return total(nothing) == 0.0f;
}

// One map of radius (n - 2) / 2 around a point's position, and the steps on it.
template <int K>
void on_map(Window& window, const float* inverse, const Level& target, int64_t batch, std::vector<float>& patch, int64_t n,
            const float* x, int64_t steps, const Options& o, State& s) {
  const float radius = static_cast<float>((n - 2) / 2);
  const float corner[2] = {target.corner(x[0] + s.d[0], 0) - radius, target.corner(x[1] + s.d[1], 1) - radius};
  const int64_t side = window.size + n - 1, stride = window.wide + LANES;
  Map<K> map{window, inverse, window.moments, target.at(batch, 0, corner[0], corner[1], window.size / 2), target.width, n};
  if (!finite(map.J, map.stride, side, stride)) {  // perhaps only beside the patch
    for (int64_t i = 0; i < side; ++i) {
      std::fill_n(std::copy_n(map.J + i * map.stride, side, &patch[i * stride]), stride - side, 0.0f);
    }
    map.J = patch.data();
    map.stride = stride;
    if (!finite(map.J, map.stride, side, stride)) {  // no step across NaN, as in torch
      std::fill_n(map.field, K * n * n, NAN);
      map.known = ~uint64_t{0};
    }
  }
  walk<K>(map, corner, x, steps, o, s);
}

template <int K>
void search_point(Window& window, const float* inverse, const Level& target, int64_t batch, std::vector<float>& patch,
                   const float* x, const Tensor& radii, const Options& o, State& s) {
  for (int64_t k = 0; k < radii.size(0); ++k) {
    const int64_t steps = std::min(o.steps_per_map, o.iterations - k * o.steps_per_map);
    if (k && (steps <= 0 || !s.live)) return;
    on_map<K>(window, inverse, target, batch, patch, 2 * data<int64_t>(radii)[k] + 2, x, steps, o, s);
  }
}

// source (B, 3, ., .), target (B, 1 or 3, ., .), x and d (2, M), limits (2, 2): lowest and highest position, float32; batch
// (M) and radii of the maps, at most MAX_MAP_RADIUS_PX, int64; known (M) bool: points to search for. Outputs: found (2, M)
// displacement and A (3, M) float32, held on the last map and textured (M) bool. `finest`: the level is read between
// pixels, and one step extrapolates.
void lk_level(Tensor source, Tensor target, Tensor x, Tensor d, Tensor batch, Tensor known, Tensor limits, Tensor radii,
              Tensor found, Tensor A, Tensor held, Tensor textured, int64_t window, int64_t iterations,
              int64_t steps_per_map, int64_t pad, int64_t margin, bool remove_bias, bool estimate_gain, double epsilon,
              double min_eigenvalue, double min_gain, double max_gain, bool finest, int64_t aitken_step, double min_ratio,
              double max_ratio) {
  const Level here(source, pad, margin), there(target, pad, margin);
  Options o{iterations, steps_per_map, static_cast<float>(epsilon), min_eigenvalue * static_cast<double>(window * window),
            static_cast<float>(min_gain), static_cast<float>(max_gain), finest, aitken_step,
            static_cast<float>(min_ratio), static_cast<float>(max_ratio), {}, {}};
  std::copy_n(data<float>(limits), 2, o.low);
  std::copy_n(data<float>(limits) + 2, 2, o.high);
  const int64_t M = x.size(1);
  Window own(window);
  std::vector<float> patch((window + MAX_NODES) * (own.wide + LANES));
  for (int64_t m = 0; m < M; ++m) {
    const float place[2] = {data<float>(x)[m], data<float>(x)[M + m]};
    const int64_t b = data<int64_t>(batch)[m];
    State s{{data<float>(d)[m], data<float>(d)[M + m]}, data<bool>(known)[m], false};
    own.read(here, place[0], place[1], b, finest);
    own.project(remove_bias, estimate_gain);
    float inverse[3];
    const bool fine = invert(own.moments + 2, o.min_eigenvalue, inverse);
    const float begun[2] = {place[0] + s.d[0], place[1] + s.d[1]};
    s.live = s.live && fine && o.within(begun);
    if (estimate_gain) {
      search_point<3>(own, inverse, there, b, patch, place, radii, o, s);
    } else {
      search_point<2>(own, inverse, there, b, patch, place, radii, o, s);
    }
    for (int axis = 0; axis < 2; ++axis) data<float>(found)[axis * M + m] = s.d[axis];
    for (int k = 0; k < 3; ++k) data<float>(A)[k * M + m] = own.moments[2 + k];
    data<bool>(held)[m] = s.held;
    data<bool>(textured)[m] = fine;
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "lk_level(Tensor source, Tensor target, Tensor x, Tensor d, Tensor batch, Tensor known, Tensor limits, "
      "Tensor radii, Tensor(a!) found, Tensor(b!) A, Tensor(c!) held, Tensor(d!) textured, int window, int iterations, "
      "int steps_per_map, int pad, int margin, bool remove_bias, bool estimate_gain, float epsilon, "
      "float min_eigenvalue, float min_gain, float max_gain, bool finest, int aitken_step, float min_ratio, "
      "float max_ratio) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) { m.impl("lk_level", TORCH_BOX(&lk_level)); }
