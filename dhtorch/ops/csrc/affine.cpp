// Affine registration of windows on one level, one point after another. Reference: _register_level in
// dhtorch/geometry/affine_alignment.py; the same steps and stopping criterion. Sums over a window are taken in another
// order, so that results agree up to rounding; a point's result does not depend on the others. One thread, no gradient. The
// dispatch checks dtypes and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
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
};

inline Vector within(Vector x, float most) {  // clamp to [0, most]; NaN becomes 0
  x = x > 0.0f ? x : Vector{};
  return x < most ? x : Vector{} + most;
}

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

// The window of image 0: six derivative images and T without its mean, and J, each one row padded with zeros to whole
// vectors.
struct Window {
  const Options& options;
  int64_t size, count, wide;
  std::vector<float> u, v, inside, pictures, J;  // inside: 1 in the window, 0 in the padding

  Window(const Options& options, int64_t size)
      : options(options), size(size), count(size * size), wide((count + LANES - 1) / LANES * LANES), u(wide), v(wide), inside(wide),
        pictures(7 * wide), J(wide) {
    const float step = 2.0f / static_cast<float>(size - 1);
    std::vector<float> place(size);  // as torch.linspace
    for (int64_t i = 0; i < size; ++i) {
      place[i] = i < size / 2 ? -1.0f + step * static_cast<float>(i) : 1.0f - step * static_cast<float>(size - 1 - i);
    }
    for (int64_t i = 0; i < count; ++i) {
      u[i] = place[i % size];
      v[i] = place[i / size];
      inside[i] = 1.0f;
    }
  }

  float* picture(int64_t k) { return pictures.data() + k * wide; }

  float sum(const float* a) const {
    Vector sums = {};
    for (int64_t i = 0; i < wide; i += LANES) sums += load(a + i);
    return total(sums);
  }

  float sum(const float* a, const float* b) const {
    Vector sums = {};
    for (int64_t i = 0; i < wide; i += LANES) sums = fused(load(a + i), load(b + i), sums);
    return total(sums);
  }

  void read(const Level& level, const float* q, int64_t batch) {
    const int64_t margin = options.margin, column = pixel(q[0], -margin, level.width - 2 * level.pad - 1 + margin),
                  row = pixel(q[1], -margin, level.rows - 2 * level.pad - 1 + margin);
    for (int64_t k = 0; k < 3; ++k) {
      const float* from = level.at(batch, (k + 1) % 3, column - size / 2, row - size / 2);
      float* to = picture(k < 2 ? k : 6);
      for (int64_t i = 0; i < size; ++i) std::copy_n(from + i * level.width, size, to + i * size);
    }
    float* T = picture(6);
    const float mean = sum(T) / static_cast<float>(count);
    for (int64_t i = 0; i < count; ++i) T[i] -= mean;
    for (int64_t i = 0; i < wide; i += LANES) {
      const Vector along = load(&u[i]), across = load(&v[i]);
      for (int64_t k = 0; k < 2; ++k) {
        const Vector g = load(picture(k) + i);
        store(g * along, picture(2 + k) + i);
        store(g * across, picture(4 + k) + i);
      }
    }
  }

  // Rows FIRST to LAST - 1 of the lower half of the pictures' products, and the rows' sums, in one pass.
  template <int FIRST, int LAST>
  void products(double (*H)[8]) {
    constexpr int COUNT = (LAST * (LAST + 1) - FIRST * (FIRST + 1)) / 2;
    Vector parts[(COUNT + LAST - FIRST + 3) / 4 * 4] = {};
    for (int64_t i = 0; i < wide; i += LANES) {
      Vector* to = parts;
      for (int a = FIRST; a < LAST; ++a) {
        const Vector own = load(picture(a) + i);
        for (int b = 0; b <= a; ++b, ++to) *to = fused(own, load(picture(b) + i), *to);
        *to++ += own;
      }
    }
    float found[sizeof(parts) / sizeof(Vector)];
    for (size_t k = 0; k < sizeof(found) / sizeof(float); k += 4) totals(parts[k], parts[k + 1], parts[k + 2], parts[k + 3], found + k);
    const float* from = found;
    for (int a = FIRST; a < LAST; ++a) {
      for (int b = 0; b <= a; ++b) H[a][b] = *from++;
      H[7][a] = *from++;
    }
  }

  // Lower half of the normal equations of the six derivative images, T and 1.
  void normal(double (*H)[8]) {
    products<0, 3>(H);
    products<3, 5>(H);
    products<5, 6>(H);
    products<6, 7>(H);
    H[7][7] = static_cast<double>(count);
    for (int64_t a = 2; a < 6; ++a) H[a][a] = static_cast<float>(H[a][a]) + static_cast<float>(options.damping);
  }

  // Read J at a warp, in pixels of the patch; beyond its border the border's value.
  void read_warped(const Patch& patch, const Warp& warp) {
    const auto& W = warp.of;
    const int32_t stride = static_cast<int32_t>(patch.stride), most = static_cast<int32_t>(patch.last) - 1;
    for (int64_t i = 0; i < wide; i += LANES) {
      const Vector along = load(&u[i]), across = load(&v[i]);
      const Vector x = within(W[0][0] + W[2][0] * across + W[1][0] * along, patch.last),
                   y = within(W[0][1] + W[2][1] * across + W[1][1] * along, patch.last);
      Bits column = __builtin_convertvector(x, Bits), row = __builtin_convertvector(y, Bits);
      column = column < most ? column : Bits{} + most;
      row = row < most ? row : Bits{} + most;
      const Vector right = x - __builtin_convertvector(column, Vector), down = y - __builtin_convertvector(row, Vector);
      const Bits first = row * stride + column;
      int32_t at[LANES];
      std::memcpy(at, &first, sizeof(at));
      asm("" : "+m"(at));  // they are read from memory: shifting each out of the vector takes longer
      Vector left[2], next[2];
      neighbours(patch.pixels, at, left[0], next[0]);
      neighbours(patch.pixels + stride, at, left[1], next[1]);
      const Vector above = fused(right, next[0] - left[0], left[0]), below = fused(right, next[1] - left[1], left[1]);
      store(fused(down, below - above, above) * load(&inside[i]), &J[i]);
    }
  }

  void project(float* sums) {  // inner products of the eight images with J
    Vector parts[8] = {};
    for (int64_t i = 0; i < wide; i += LANES) {
      const Vector there = load(&J[i]);
      for (int64_t k = 0; k < 7; ++k) parts[k] = fused(load(picture(k) + i), there, parts[k]);
      parts[7] += there;
    }
    for (int64_t k = 0; k < 8; k += 4) totals(parts[k], parts[k + 1], parts[k + 2], parts[k + 3], sums + k);
  }

  // Gain of J over T, and the mean square of the residual.
  void quality(float* fit) {
    float* T = picture(6);
    const float energy = sum(T, T), gain = sum(T, J.data()) / (energy > 0.0f ? energy : 1.0f);
    const float mean = (sum(J.data()) - gain * sum(T)) / static_cast<float>(count);
    Vector squares = {};
    for (int64_t i = 0; i < wide; i += LANES) {
      const Vector rest = (load(&J[i]) - gain * load(T + i) - mean) * load(&inside[i]);
      squares += rest * rest;
    }
    fit[0] = gain;
    fit[1] = total(squares) / static_cast<float>(count);
  }

  // Share of the variance of white noise that bilinear reading at a warp leaves.
  float share(const Warp& warp) const {
    const auto& W = warp.of;
    Vector sums = {};
    for (int64_t i = 0; i < wide; i += LANES) {
      Vector left = load(&inside[i]);
      for (int64_t axis = 0; axis < 2; ++axis) {
        left *= kept(W[0][axis] + W[2][axis] * load(&v[i]) + W[1][axis] * load(&u[i]));
      }
      sums += left;
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
  float solution[7];
  for (int i = 0; i < 7; ++i) {
    solution[i] = 0.0f;
    for (int k = 0; k < 8; ++k) solution[i] += inverse[i][k] * sums[k];
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

// Gauss-Newton steps of one point from a warp in pixels of the patch; leaves J as read at the last warp.
Warp gauss_newton(Window& window, const Patch& patch, const float (*inverse)[8], Warp warp, int64_t steps, float epsilon) {
  const float half = static_cast<float>(window.size / 2);
  Warp taken, before;
  for (int64_t k = 0; k < steps; ++k) {
    float sums[8];
    window.project(sums);
    const Warp now = change(inverse, sums, window.options);
    taken = k ? extrapolate(now, taken, before, window.options.max_extrapolation) : now;
    before = now;
    warp = compose(warp, taken, half);
    window.read_warped(patch, warp);
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
  Window own(options, window);
  for (int64_t m = 0; m < M; ++m) {
    const int64_t b = data<int64_t>(batch)[m];
    const float at[2] = {data<float>(q)[m], data<float>(q)[M + m]};
    own.read(here, at, b);
    double H[8][8];
    own.normal(H);
    float R[8][8];
    const bool fine = invert(H, R, options);
    Warp now;
    for (int k = 0; k < 6; ++k) now.of[k / 2][k % 2] = data<float>(begin)[k * M + m];
    const Patch patch(there, b, now.of[0], window / 2 + search_padding);
    for (int axis = 0; axis < 2; ++axis) now.of[0][axis] -= patch.corner[axis];
    own.read_warped(patch, now);
    float quality[3], kept[LANES];
    own.quality(quality);
    quality[2] = 1.0f;
    for (int axis = 0; axis < 2; ++axis) {
      store(Window::kept(Vector{} + now.of[0][axis]), kept);
      quality[2] *= kept[0];
    }
    for (int k = 0; k < 3; ++k) data<float>(first)[k * M + m] = quality[k];
    if (fine) now = gauss_newton(own, patch, R, now, steps, static_cast<float>(epsilon));
    if (steps) {
      own.quality(quality);
      quality[2] = own.share(now);
    }
    for (int k = 0; k < 3; ++k) data<float>(fit)[k * M + m] = quality[k];
    for (int axis = 0; axis < 2; ++axis) {
      now.of[0][axis] += patch.corner[axis];
      for (int k = 0; k < 8; ++k) {
        float row = 0.0f;
        for (int i = 0; i < 3; ++i) row += R[2 * i + axis][k] * data<float>(place)[i * M + m];
        data<float>(inverse)[(axis * 8 + k) * M + m] = row;
      }
    }
    for (int k = 0; k < 6; ++k) data<float>(warp)[k * M + m] = now.of[k / 2][k % 2];
    data<bool>(textured)[m] = fine;
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
