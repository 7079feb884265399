// Affine registration of windows on one level, one point after another. Reference: _register_level in
// dhtorch/geometry/affine_alignment.py; the same steps and stopping criterion. Sums over a window are taken in another
// order, so that results agree up to rounding; a point's result does not depend on the others. One thread, no gradient. The
// dispatch checks dtypes and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <type_traits>
#include <vector>

namespace {

// Limits of the search: pixels around a window's start that are read, pixels outside the image where a window may stand,
// share of an extrapolated step, range of gains, damping of the affine part, least pivot of the normal equations.
struct Options {
  int64_t search_padding, margin;
  float max_extrapolation, min_gain, max_gain;
  double damping, min_pivot;
};

// A warp W_0, W_1, W_2, or a change of it: each (x, y).
struct Warp {
  float of[3][2];
};

// The pixel that a window is read around: the position, clamped; NaN becomes `least`.
inline int64_t pixel(float place, int64_t least, int64_t most) {
  return place > static_cast<float>(least) ? static_cast<int64_t>(std::min(place, static_cast<float>(most))) : least;
}

struct Level {
  const float* pixels;
  int64_t planes, rows, width, pad;

  Level(const Tensor& x, int64_t pad)
      : pixels(data<float>(x)), planes(x.size(1)), rows(x.size(2)), width(x.size(3)), pad(pad) {}

  const float* at(int64_t batch, int64_t plane, int64_t column, int64_t row) const {
    return pixels + ((batch * planes + plane) * rows + row + pad) * width + column + pad;
  }
};

// A square of pixels of image 1.
struct Patch {
  const float* pixels;
  int64_t stride;
  float corner[2];  // its first pixel in the image
  float last;       // its last pixel in its own coordinates

  Patch(const Level& level, int64_t batch, const float* x, int64_t reach) : stride(level.width) {
    const int64_t column = pixel(std::floor(x[0] + 0.5f), 0, level.width - 2 * level.pad - 1),
                  row = pixel(std::floor(x[1] + 0.5f), 0, level.rows - 2 * level.pad - 1);
    pixels = level.at(batch, 0, column - reach, row - reach);
    corner[0] = static_cast<float>(column - reach);
    corner[1] = static_cast<float>(row - reach);
    last = static_cast<float>(2 * reach);
  }

  inline Vector clamped(Vector x, Vector y) const;
};

#if defined(__FMA__) && defined(DHTORCH_SHUFFLES)
// Four pixels and their right neighbours, pair by pair: assembled in registers, where compilers write lanes to memory.
inline __m256d four_pairs(const float* pixels, const int32_t* at) {
  const auto pair = [&](int k) { return reinterpret_cast<const double*>(pixels + at[k]); };
  const __m128d low = _mm_loadh_pd(_mm_load_sd(pair(0)), pair(1)), high = _mm_loadh_pd(_mm_load_sd(pair(2)), pair(3));
  return _mm256_insertf128_pd(_mm256_castpd128_pd256(low), high, 1);
}
#endif

// Pixels at indices, and their right neighbours.
inline void neighbours(const float* pixels, const int32_t* at, Vector& left, Vector& right) {
#if defined(__AVX512F__) && defined(DHTORCH_SHUFFLES)
  const auto eight = [&](int k) {
    return reinterpret_cast<Vector>(_mm512_insertf64x4(_mm512_castpd256_pd512(four_pairs(pixels, at + k)), four_pairs(pixels, at + k + 4), 1));
  };
  const Vector a = eight(0), b = eight(8);
  left = __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
  right = __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
#elif defined(__FMA__) && defined(DHTORCH_SHUFFLES)
  const Vector a = reinterpret_cast<Vector>(four_pairs(pixels, at)), b = reinterpret_cast<Vector>(four_pairs(pixels, at + 4));
  left = __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14);
  right = __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15);
#else
  for (int64_t k = 0; k < LANES; ++k) {
    left[k] = pixels[at[k]];
    right[k] = pixels[at[k] + 1];
  }
#endif
}

// Bilinear values at positions; beyond the border the border's.
inline Vector Patch::clamped(Vector x, Vector y) const {
  const int32_t most = static_cast<int32_t>(last) - 1;
  x = within(x, last);
  y = within(y, last);
  Bits column = __builtin_convertvector(x, Bits), row = __builtin_convertvector(y, Bits);
  column = column < most ? column : Bits{} + most;
  row = row < most ? row : Bits{} + most;
  const Vector right = x - __builtin_convertvector(column, Vector), down = y - __builtin_convertvector(row, Vector);
  const Bits first = row * static_cast<int32_t>(stride) + column;
  int32_t at[LANES];
  std::memcpy(at, &first, sizeof(at));
  asm("" : "+m"(at));  // they are read from memory: shifting each out of the vector takes longer
  Vector left[2], next[2];
  neighbours(pixels, at, left[0], next[0]);
  neighbours(pixels + stride, at, left[1], next[1]);
  const Vector above = fused(right, next[0] - left[0], left[0]), below = fused(right, next[1] - left[1], left[1]);
  return fused(down, below - above, above);
}

// Vectors of a window's pixels. A lane has the same column in all of them; rows lie below each other, and where the last
// columns fill less than half of a vector, also beside each other in it.
struct Block {
  int64_t begin, end;             // of its vectors in the window
  int64_t column, columns, rows;  // of the first vector
  Lanes u;
  std::vector<Lanes> top, bottom;  // v of the first and the last row of each vector, one in a lane
};

#ifdef __AVX512F__
constexpr int64_t MOST_LINES = 6;  // rows of pixels that a row of a window is read from

inline Vector pick(Vector a, Bits at, Vector b) {
  return reinterpret_cast<Vector>(_mm512_permutex2var_ps(reinterpret_cast<__m512>(a), reinterpret_cast<__m512i>(at), reinterpret_cast<__m512>(b)));
}

// The pixels of a patch that the vectors of a block are read from, where these are few and none beyond its border: they are
// picked from registers, as pixel after pixel from memory takes longer.
struct Rectangles {
  // Of each vector, one in a lane: x and y of the middle of its first row; first column and row, and how many more.
  struct Place {
    Lanes middle[2], first[2], more[2];
  };

  const float* pixels;
  const int64_t stride;
  Place* const places;
  int64_t lines;     // rows of pixels that any vector of one row is read from; 0: too many
  bool in_squares;  // vectors of several rows

  Rectangles(std::vector<Place>& work, const Block& block, const Patch& patch, const Warp& warp)
      : pixels(patch.pixels), stride(patch.stride), places(work.data()), lines(0), in_squares(false) {
    const auto& W = warp.of;
    const float ends[2] = {block.u.of[0], block.u.of[block.columns - 1]}, share = ends[1] - ends[0];
    bool holds = true;
    for (int axis = 0; axis < 2; ++axis) {
      const float reach = std::abs(W[1][axis]) + std::abs(W[2][axis]);
      holds = holds && W[0][axis] - reach >= 1.0f && W[0][axis] + reach <= patch.last - 2.0f;
    }
    const float across = std::abs(W[1][0]) * share, down = std::abs(W[1][1]) * share;
    if (holds && block.rows == 1 && across < 2 * LANES - 3 && down < MOST_LINES - 2) lines = static_cast<int64_t>(down) + 3;
    in_squares = holds && block.rows > 1;
    if (!lines && !in_squares) return;
    for (size_t k = 0; k < block.top.size(); ++k) {
      const Vector top = load(block.top[k].of), bottom = load(block.bottom[k].of);
      for (int axis = 0; axis < 2; ++axis) {
        const Vector above = W[0][axis] + W[2][axis] * top, below = W[0][axis] + W[2][axis] * bottom;
        const float left = W[1][axis] * ends[0], right = W[1][axis] * ends[1];
        const Vector ab = above + left, cd = above + right, ef = below + left, gh = below + right;
        const Vector least_above = ab < cd ? ab : cd, most_above = ab < cd ? cd : ab, least_below = ef < gh ? ef : gh,
                     most_below = ef < gh ? gh : ef;
        const Bits least = __builtin_convertvector(least_above < least_below ? least_above : least_below, Bits),
                   most = __builtin_convertvector(most_above < most_below ? most_below : most_above, Bits);
        store(above, places[k].middle[axis].of);
        store(reinterpret_cast<Vector>(least), places[k].first[axis].of);
        store(reinterpret_cast<Vector>(most - least), places[k].more[axis].of);
      }
    }
  }

  static int32_t lane(const Lanes& lanes, int64_t i) {
    int32_t value;
    std::memcpy(&value, lanes.of + i % LANES, sizeof(value));
    return value;
  }

  // Bilinear values of vector `i`, a row, at positions beside its middle.
  template <int LINES>
  Vector in_row(int64_t i, Vector to_x, Vector to_y) const {
    const Place& place = places[i / LANES];
    const Vector x = place.middle[0].of[i % LANES] + to_x, y = place.middle[1].of[i % LANES] + to_y;
    const int32_t column = lane(place.first[0], i), row = lane(place.first[1], i), last = lane(place.more[1], i) + 1;
    const Bits columns = __builtin_convertvector(x, Bits), rows = __builtin_convertvector(y, Bits);
    const Vector right = x - __builtin_convertvector(columns, Vector), down = y - __builtin_convertvector(rows, Vector);
    const Bits at = columns - column, next = at + 1;
    const float* first = pixels + row * stride + column;
    Vector above, below;
    for (int32_t k = 0; k < LINES; ++k) {
      const float* from = first + std::min(k, last) * stride;
      const Vector a = load(from), b = load(from + LANES), here = pick(a, at, b);
      const Vector line = fused(right, pick(a, next, b) - here, here);
      if (k < LINES - 1) above = k ? (rows == row + k ? line : above) : line;
      if (k) below = k > 1 ? (rows == row + k - 1 ? line : below) : line;
    }
    return fused(down, below - above, above);
  }

  // Whether a vector of several rows is read from four rows of eight columns, and another four below each.
  bool fits(int64_t i) const {
    const Place& place = places[i / LANES];
    return lane(place.more[0], i) < 7 && lane(place.more[1], i) < 4;
  }

  Vector in_square(int64_t i, Vector x, Vector y) const {
    const Place& place = places[i / LANES];
    const int32_t column = lane(place.first[0], i), row = lane(place.first[1], i), more = lane(place.more[1], i);
    const Bits columns = __builtin_convertvector(x, Bits), rows = __builtin_convertvector(y, Bits);
    const Vector right = x - __builtin_convertvector(columns, Vector), down = y - __builtin_convertvector(rows, Vector);
    const Bits at = (rows - row) * 8 + columns - column;
    const float* first = pixels + row * stride + column;
    __m256 of[5];
    for (int32_t k = 0; k < 5; ++k) of[k] = _mm256_loadu_ps(first + std::min(k, more + 1) * stride);
    const auto join = [](__m256 a, __m256 b) { return reinterpret_cast<Vector>(_mm512_insertf32x8(_mm512_castps256_ps512(a), b, 1)); };
    const auto along = [&](Vector a, Vector b) {
      const Vector here = pick(a, at, b);
      return fused(right, pick(a, at + 1, b) - here, here);
    };
    const Vector above = along(join(of[0], of[1]), join(of[2], of[3])), below = along(join(of[1], of[2]), join(of[3], of[4]));
    return fused(down, below - above, above);
  }
};
#endif

// The window of image 0: its gradient, also times v, and T without its mean; and J; in vectors padded with zeros.
struct Window {
  const Options& options;
  int64_t size, count, wide;
  std::vector<Block> blocks;
  std::vector<Lanes> v, inside, pixels;  // inside: all bits set in the window
  double H[8][8];                        // lower half of the normal equations of the six derivative images, T and 1
#ifdef __AVX512F__
  std::vector<Rectangles::Place> places;
#endif

  Window(const Options& options, int64_t size) : options(options), size(size), count(size * size), wide(0) {
    const float step = 2.0f / static_cast<float>(size - 1);
    std::vector<float> place(size);  // as torch.linspace
    for (int64_t i = 0; i < size; ++i) {
      place[i] = i < size / 2 ? -1.0f + step * static_cast<float>(i) : 1.0f - step * static_cast<float>(size - 1 - i);
    }
    for (int64_t column = 0; column < size; column += LANES) {
      const int64_t columns = std::min(LANES, size - column), rows = LANES / columns;
      Block block{wide, wide + (size + rows - 1) / rows, column, columns, rows, {}, {}, {}};
      for (int64_t i = 0; i < rows * columns; ++i) block.u.of[i] = place[column + i % columns];
      v.resize(block.end);
      inside.resize(block.end);
      for (int64_t i = 0; i < (block.end - wide) * LANES; ++i) {
        const int64_t lane = i % LANES, row = i / LANES * rows + lane / columns;
        const bool held = lane < rows * columns && row < size;
        v[wide + i / LANES].of[lane] = held ? place[row] : 0.0f;
        reinterpret_cast<int32_t*>(inside[wide + i / LANES].of)[lane] = -held;
      }
      block.top.resize((block.end - wide + LANES - 1) / LANES);
      block.bottom.resize(block.top.size());
      for (int64_t i = 0; i < block.end - wide; ++i) {
        block.top[i / LANES].of[i % LANES] = place[i * rows];
        block.bottom[i / LANES].of[i % LANES] = place[std::min(i * rows + rows, size) - 1];
      }
      blocks.push_back(block);
      wide = block.end;
    }
    pixels.resize(6 * wide + 1);  // rows are stored in whole vectors
#ifdef __AVX512F__
    places.resize(size / LANES + 1);
#endif
  }

  enum Plane { G_X, G_Y, V_G_X, V_G_Y, T, J };  // V_G_X: v g_x
  Lanes* plane(int64_t k) { return pixels.data() + k * wide; }
  Vector at(int64_t k, int64_t vector) const { return load(pixels[k * wide + vector].of); }
  static Vector masked(Vector x, const Lanes& kept) {
    return reinterpret_cast<Vector>(reinterpret_cast<Bits>(x) & reinterpret_cast<Bits>(load(kept.of)));
  }
  Vector masked(Vector x, int64_t vector) const { return masked(x, inside[vector]); }

  void read(const Level& level, const float* q, int64_t batch) {
    const int64_t margin = options.margin, column = pixel(q[0], -margin, level.width - 2 * level.pad - 1 + margin),
                  row = pixel(q[1], -margin, level.rows - 2 * level.pad - 1 + margin);
    for (int64_t k = 0; k < 3; ++k) {
      const float* from = level.at(batch, (k + 1) % 3, column - size / 2, row - size / 2);
      for (const Block& block : blocks) {
        const float* pixel = from + block.column;
        for (int64_t i = block.begin, row = 0; i < block.end; ++i) {
          for (int64_t beside = 0; beside < block.rows && row < size; ++beside, ++row, pixel += level.width) {
            store(load(pixel), plane(k < 2 ? k : T)[i].of + beside * block.columns);  // over the end of the row before
          }
        }
      }
    }
    for (int64_t i = 0; i < wide; ++i) {
      for (int64_t k = 0; k < 2; ++k) {
        const Vector g = masked(at(k, i), i);
        store(g, plane(k)[i].of);
        store(g * load(v[i].of), plane(2 + k)[i].of);
      }
    }
    Vector sum = {};
    for (int64_t i = 0; i < wide; ++i) sum += masked(at(T, i), i);
    const float mean = total(sum) / static_cast<float>(count);
    for (int64_t i = 0; i < wide; ++i) store(masked(at(T, i) - mean, i), plane(T)[i].of);
  }

  // Sums over the window of x times 1, u, v, and of squares and products of these, from those of each block.
  struct Moments {
    Vector of[6] = {};  // 1, u, v, uu, uv, vv

    void add(Vector x, Vector by_v, Vector u) {
      of[0] += x;
      of[1] = fused(u, x, of[1]);
      of[2] += by_v;
    }
    void add(Vector x, Vector by_v, Vector by_vv, Vector u) {
      add(x, by_v, u);
      of[3] = fused(u * u, x, of[3]);
      of[4] = fused(u, by_v, of[4]);
      of[5] += by_vv;
    }
  };

  void normal() {
    Moments squares[3], linear[4];  // of g_x g_x, g_x g_y, g_y g_y; of g_x T, g_y T, g_x, g_y
    Vector energy = {}, sum = {};
    for (const Block& block : blocks) {
      const Vector u = load(block.u.of);
      Vector parts[3][3] = {}, with[4][2] = {};
      for (int64_t i = block.begin; i < block.end; ++i) {
        const Vector g_x = at(G_X, i), g_y = at(G_Y, i), across = load(v[i].of), second = across * across;
        const Vector products[3] = {g_x * g_x, g_x * g_y, g_y * g_y};
        for (int k = 0; k < 3; ++k) {
          parts[k][0] += products[k];
          parts[k][1] = fused(across, products[k], parts[k][1]);
          parts[k][2] = fused(second, products[k], parts[k][2]);
        }
      }
      for (int64_t i = block.begin; i < block.end; ++i) {
        const Vector g_x = at(G_X, i), g_y = at(G_Y, i), t = at(T, i), across = load(v[i].of);
        const Vector products[4] = {g_x * t, g_y * t, g_x, g_y};
        for (int k = 0; k < 4; ++k) {
          with[k][0] += products[k];
          with[k][1] = fused(across, products[k], with[k][1]);
        }
        energy = fused(t, t, energy);
        sum += t;
      }
      for (int k = 0; k < 3; ++k) squares[k].add(parts[k][0], parts[k][1], parts[k][2], u);
      for (int k = 0; k < 4; ++k) linear[k].add(with[k][0], with[k][1], u);
    }
    float S[3][8], L[4][4], rest[4];
    for (int k = 0; k < 3; ++k) {
      const Vector* of = squares[k].of;
      totals(of[0], of[1], of[2], of[3], S[k]);
      totals(of[4], of[5], Vector{}, Vector{}, S[k] + 4);
    }
    for (int k = 0; k < 4; ++k) totals(linear[k].of[0], linear[k].of[1], linear[k].of[2], Vector{}, L[k]);
    totals(energy, sum, Vector{}, Vector{}, rest);
    constexpr int PRODUCT[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
    for (int a = 0; a < 6; ++a) {
      for (int b = 0; b <= a; ++b) H[a][b] = S[a % 2 + b % 2][PRODUCT[a / 2][b / 2]];
      H[6][a] = L[a % 2][a / 2];
      H[7][a] = L[2 + a % 2][a / 2];
    }
    for (int a = 2; a < 6; ++a) H[a][a] = static_cast<float>(H[a][a]) + static_cast<float>(options.damping);
    H[6][6] = rest[0];
    H[7][6] = rest[1];
    H[7][7] = static_cast<double>(count);
  }

  // Read J at a warp, in pixels of the patch, beyond its border the border's value; and the inner products of the eight
  // images with it.
  void read_warped(const Patch& patch, const Warp& warp, float* sums) {
    const auto& W = warp.of;
    Moments with[2];  // of g_x J, g_y J
    Vector by_T = {}, sum = {};
    for (const Block& block : blocks) {
      const Vector u = load(block.u.of), right = W[1][0] * u, down = W[1][1] * u;
      Vector parts[2][2] = {};
      const auto read = [&](const auto& value) {
        const int64_t vectors = block.end - block.begin, step = wide;
        Lanes* const own = pixels.data() + block.begin;
        const Lanes* const kept = inside.data() + block.begin;
        for (int64_t i = 0; i < vectors; ++i) {
          const Vector there = masked(value(i), kept[i]);
          store(there, own[J * step + i].of);
          for (int k = 0; k < 2; ++k) {
            for (int by_v = 0; by_v < 2; ++by_v) {
              parts[k][by_v] = fused(load(own[(2 * by_v + k) * step + i].of), there, parts[k][by_v]);
            }
          }
          by_T = fused(load(own[T * step + i].of), there, by_T);
          sum += there;
        }
      };
      const Lanes* const along = v.data() + block.begin;
      const auto x = [&](int64_t i) { return W[0][0] + W[2][0] * load(along[i].of) + right; };
      const auto y = [&](int64_t i) { return W[0][1] + W[2][1] * load(along[i].of) + down; };
      const auto anywhere = [&](int64_t i) { return patch.clamped(x(i), y(i)); };
#ifdef __AVX512F__
      const Rectangles around(places, block, patch, warp);
      const auto row = [&](auto lines) { read([&](int64_t i) { return around.in_row<lines>(i, right, down); }); };
      if (around.lines == 3) {
        row(std::integral_constant<int, 3>());
      } else if (around.lines == 4) {
        row(std::integral_constant<int, 4>());
      } else if (around.lines == 5) {
        row(std::integral_constant<int, 5>());
      } else if (around.lines == 6) {
        row(std::integral_constant<int, 6>());
      } else if (around.in_squares) {
        read([&](int64_t i) { return around.fits(i) ? around.in_square(i, x(i), y(i)) : anywhere(i); });
      } else {
        read(anywhere);
      }
#else
      read(anywhere);
#endif
      for (int k = 0; k < 2; ++k) with[k].add(parts[k][0], parts[k][1], u);
    }
    totals(with[0].of[0], with[1].of[0], with[0].of[1], with[1].of[1], sums);
    totals(with[0].of[2], with[1].of[2], by_T, sum, sums + 4);
  }

  // Gain of J over T, and the mean square of the residual, from the inner products.
  void quality(const float* sums, float* fit) const {
    const float energy = static_cast<float>(H[6][6]), gain = sums[6] / (energy > 0.0f ? energy : 1.0f);
    const float mean = (sums[7] - gain * static_cast<float>(H[7][6])) / static_cast<float>(count);
    Vector squares = {};
    for (int64_t i = 0; i < wide; ++i) {
      const Vector rest = masked(at(J, i) - gain * at(T, i) - mean, i);
      squares += rest * rest;
    }
    fit[0] = gain;
    fit[1] = total(squares) / static_cast<float>(count);
  }

  // Share of the variance of white noise that bilinear reading at a warp leaves.
  float share(const Warp& warp) const {
    const auto& W = warp.of;
    Vector sums = {};
    for (const Block& block : blocks) {
      const Vector u = load(block.u.of);
      for (int64_t i = block.begin; i < block.end; ++i) {
        const Vector across = load(v[i].of);
        Vector left = Vector{} + 1.0f;
        for (int64_t axis = 0; axis < 2; ++axis) left *= kept(W[0][axis] + W[2][axis] * across + W[1][axis] * u);
        sums += masked(left, i);
      }
    }
    return total(sums) / static_cast<float>(count);
  }

  static Vector kept(Vector x) {
    x = x < 1e6f && x > -1e6f ? x : Vector{};  // beyond any image
    const Vector whole = __builtin_convertvector(__builtin_convertvector(x, Bits), Vector), fraction = x - whole;
    const Vector off = (fraction < 0.0f ? -fraction : fraction) - 0.5f;
    return off * off * 2.0f + 0.5f;
  }
};

// Inverse of normal equations from their lower half; returns whether they are regular.
bool invert(const double (*H)[8], float (*inverse)[8], const Options& o) {
  double scale[8], L[8][8], R[8][8] = {};  // R = 1 / L
  bool textured = true;
  for (int i = 0; i < 8; ++i) scale[i] = H[i][i] > 0 ? 1 / std::sqrt(H[i][i]) : 1.0;
  for (int j = 0; j < 8; ++j) {
    for (int i = j; i < 8; ++i) {
      double rest = H[i][j] * (scale[i] * scale[j]);
      for (int k = 0; k < j; ++k) rest -= L[i][k] * L[j][k];
      if (i == j) {
        textured = textured && rest > o.min_pivot * o.min_pivot;
        L[j][j] = std::sqrt(rest);
        R[j][j] = 1 / L[j][j];
      } else {
        L[i][j] = rest * R[j][j];
      }
    }
  }
  if (!textured) {  // that of a multiple of the identity
    for (int i = 0; i < 8; ++i) {
      std::fill_n(inverse[i], 8, 0.0f);
      inverse[i][i] = static_cast<float>(scale[i] * scale[i] / o.damping);
    }
    return false;
  }
  for (int j = 0; j < 8; ++j) {
    for (int i = j + 1; i < 8; ++i) {
      double sum = 0;
      for (int k = j; k < i; ++k) sum += L[i][k] * R[k][j];
      R[i][j] = -sum * R[i][i];
    }
  }
  for (int i = 0; i < 8; ++i) {
    for (int j = 0; j <= i; ++j) {
      double sum = 0;
      for (int k = i; k < 8; ++k) sum += R[k][i] * R[k][j];
      inverse[i][j] = inverse[j][i] = static_cast<float>(sum * (scale[i] * scale[j]));
    }
  }
  return true;
}

// The change of the warp by regression on the eight images.
Warp change(const float (*inverse)[8], const float* sums, const Options& o) {
  float solution[8] = {};
  for (int k = 0; k < 8; ++k) {
    for (int i = 0; i < 8; ++i) solution[i] += inverse[k][i] * sums[k];  // it is symmetric
  }
  const float gain = std::clamp(solution[6], o.min_gain, o.max_gain);
  Warp found;
  for (int i = 0; i < 6; ++i) found.of[i / 2][i % 2] = solution[i] / gain;
  return found;
}

// The step to take where regression gives `now`, after `before`, for which `taken` was taken (Anderson acceleration).
Warp extrapolate(const Warp& now, const Warp& taken, const Warp& before, float most) {
  float along = 0.0f, square = 0.0f;
  for (int i = 0; i < 6; ++i) {
    const float bend = now.of[i / 2][i % 2] - before.of[i / 2][i % 2];
    along += now.of[i / 2][i % 2] * bend;
    square += bend * bend;
  }
  const float share = std::clamp(along / std::max(square, 1e-20f), -most, most / (1.0f + most));
  Warp found;
  for (int i = 0; i < 6; ++i) {
    const float bend = now.of[i / 2][i % 2] - before.of[i / 2][i % 2];
    found.of[i / 2][i % 2] = now.of[i / 2][i % 2] - share * (taken.of[i / 2][i % 2] + bend);
  }
  return found;
}

Warp compose(const Warp& warp, const Warp& change, float half) {
  const float(*D)[2] = change.of + 1;
  const float a = 1.0f + D[0][0] / half, b = D[0][1] / half, c = D[1][0] / half, d = 1.0f + D[1][1] / half;
  float det = a * d - b * c;
  if (!(std::abs(det) > 1e-30f)) det = 1e-30f;
  const float inverse[2][2] = {{d / det, -b / det}, {-c / det, a / det}};
  Warp found;
  for (int axis = 0; axis < 2; ++axis) {
    for (int k = 0; k < 2; ++k) {
      found.of[1 + k][axis] = inverse[k][0] * warp.of[1][axis] + inverse[k][1] * warp.of[2][axis];
    }
    const float back = found.of[1][axis] * change.of[0][0] + found.of[2][axis] * change.of[0][1];
    found.of[0][axis] = warp.of[0][axis] - back / half;
  }
  return found;
}

float furthest(const Warp& change) {  // largest motion of the window's corners along an axis
  float most[2];
  for (int axis = 0; axis < 2; ++axis) {
    most[axis] = std::abs(change.of[0][axis]) + std::abs(change.of[1][axis]) + std::abs(change.of[2][axis]);
  }
  return std::max(most[0], most[1]);
}

// Gauss-Newton steps of one point from a warp in pixels of the patch; leaves J and its inner products as read at the last.
Warp gauss_newton(Window& window, const Patch& patch, const float (*inverse)[8], Warp warp, int64_t steps, float epsilon, float* sums) {
  const float half = static_cast<float>(window.size / 2);
  Warp taken, before;
  for (int64_t k = 0; k < steps; ++k) {
    const Warp now = change(inverse, sums, window.options);
    taken = k ? extrapolate(now, taken, before, window.options.max_extrapolation) : now;
    before = now;
    warp = compose(warp, taken, half);
    window.read_warped(patch, warp, sums);
    if (!(furthest(now) > epsilon)) break;
  }
  return warp;
}

// source (B, 3, ., .), target (B, 1 or 3, ., .), q (2, M) integer pixels, place (3, M) and begin (3, 2, M), px of the
// target, float32; batch (M) int64. Outputs, the fields of _State in affine_alignment.py: warp (3, 2, M), fit (quality
// there) and first (start_quality) (3, M), inverse (2, 8, M) float32, textured (M) bool.
void register_affine(Tensor source, Tensor target, Tensor q, Tensor place, Tensor begin, Tensor batch, Tensor warp,
                     Tensor textured, Tensor fit, Tensor first, Tensor inverse, int64_t window, int64_t steps,
                     int64_t source_pad, int64_t target_pad, double epsilon, int64_t search_padding, int64_t margin,
                     double max_extrapolation, double min_gain, double max_gain, double damping, double min_pivot) {
  const Options options{search_padding, margin, static_cast<float>(max_extrapolation), static_cast<float>(min_gain),
                        static_cast<float>(max_gain), damping, min_pivot};
  const Level here(source, source_pad), there(target, target_pad);
  const int64_t M = q.size(1);
  const int64_t* pairs = data<int64_t>(batch);
  const float *centres = data<float>(q), *points = data<float>(place), *starts = data<float>(begin);
  float *ends = data<float>(warp), *fits = data<float>(fit), *firsts = data<float>(first), *inverses = data<float>(inverse);
  bool* with_texture = data<bool>(textured);
  Window own(options, window);
  for (int64_t m = 0; m < M; ++m) {
    const float at[2] = {centres[m], centres[M + m]};
    own.read(here, at, pairs[m]);
    own.normal();
    float R[8][8];
    const bool fine = invert(own.H, R, options);
    Warp now;
    for (int k = 0; k < 6; ++k) now.of[k / 2][k % 2] = starts[k * M + m];
    const Patch patch(there, pairs[m], now.of[0], window / 2 + search_padding);
    for (int axis = 0; axis < 2; ++axis) now.of[0][axis] -= patch.corner[axis];
    float quality[3], kept[LANES], sums[8];
    own.read_warped(patch, now, sums);
    own.quality(sums, quality);
    quality[2] = 1.0f;
    for (int axis = 0; axis < 2; ++axis) {
      store(Window::kept(Vector{} + now.of[0][axis]), kept);
      quality[2] *= kept[0];
    }
    for (int k = 0; k < 3; ++k) firsts[k * M + m] = quality[k];
    if (fine) now = gauss_newton(own, patch, R, now, steps, static_cast<float>(epsilon), sums);
    if (steps) {
      own.quality(sums, quality);
      quality[2] = own.share(now);
    }
    for (int k = 0; k < 3; ++k) fits[k * M + m] = quality[k];
    for (int axis = 0; axis < 2; ++axis) {
      now.of[0][axis] += patch.corner[axis];
      for (int k = 0; k < 8; ++k) {
        float row = 0.0f;
        for (int i = 0; i < 3; ++i) row += R[2 * i + axis][k] * points[i * M + m];
        inverses[(axis * 8 + k) * M + m] = row;
      }
    }
    for (int k = 0; k < 6; ++k) ends[k * M + m] = now.of[k / 2][k % 2];
    with_texture[m] = fine;
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "register_affine(Tensor source, Tensor target, Tensor q, Tensor place, Tensor begin, Tensor batch, Tensor(a!) warp, "
      "Tensor(b!) textured, Tensor(c!) fit, Tensor(d!) first, Tensor(e!) inverse, int window, int steps, "
      "int source_pad, int target_pad, float epsilon, int search_padding, int margin, float max_extrapolation, "
      "float min_gain, float max_gain, float damping, float min_pivot) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) { m.impl("register_affine", TORCH_BOX(&register_affine)); }
