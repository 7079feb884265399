// A few numbers about the window around each sample: extremes of depth, brightness, texture. Twin of
// what dhtorch/geometry/lookup.py reads for stages 2 and 3, which is the reference: whole numbers are exact, sums are
// taken in torch's order. One thread, no gradient. Callers check shapes, types and strides.

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "native_vectors.h"

namespace {

// Rows of a window, with room for the lanes that are computed beside it; points that are summed together.
constexpr int64_t WIDE = 16, ROOM = WIDE + 2, POINTS = 16;

// Images as one row of numbers, the steps in it, and the samples (B, N, 2) whose windows are asked.
struct Windows {
  int64_t image, channel, row, column;
  int64_t channels, height, width, size;
  const int32_t* pixel;
  int64_t batch, n;
  const uint8_t* end = nullptr;  // of a picture

  // Where the window of a sample begins, moved inside.
  int64_t first(int64_t b, int64_t k) const {
    const int32_t* at = pixel + 2 * (b * n + k);
    const int64_t before = size / 2, after = size - before;
    const int64_t u = std::clamp<int64_t>(at[0], before, width - after) - before;
    const int64_t v = std::clamp<int64_t>(at[1], before, height - after) - before;
    return b * image + v * row + u * column;
  }
};

Windows windows(const Tensor& pixel, int64_t image, int64_t channel, int64_t row, int64_t column, int64_t channels,
                int64_t height, int64_t width, int64_t size) {
  return {image, channel, row, column, channels, height, width, size, data<int32_t>(pixel), pixel.size(0), pixel.size(1)};
}

// depth (B h w) float32; found (2, B, N): the smallest and the largest return, infinity and 0 where there is none.
void window_extremes(Tensor depth, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row, int64_t column,
                     int64_t channels, int64_t height, int64_t width, int64_t size) {
  const Windows w = windows(pixel, image, channel, row, column, channels, height, width, size);
  const float* from = data<float>(depth);
  const int64_t all = w.batch * w.n;
  float *low = data<float>(found), *high = low + all;
  for (int64_t b = 0, i = 0; b < w.batch; ++b) {
    for (int64_t k = 0; k < w.n; ++k, ++i) {
      const float* at = from + w.first(b, k);
      float least = std::numeric_limits<float>::infinity(), most = -least;
      for (int64_t y = 0; y < size; ++y) {
        for (int64_t x = 0; x < size; ++x) {
          const float read = at[y * row + x * column], z = std::isfinite(read) ? read : 0.0f;
          least = z > 0 ? std::min(least, z) : least;
          most = std::max(most, z);
        }
      }
      low[i] = least;
      high[i] = most;
    }
  }
}

inline float luma(float red, float green, float blue, int64_t channels) {
  return channels == 1 ? red : fused(blue, 0.114f, fused(green, 0.587f, red * 0.299f));
}

// Sums over the window, channel by channel. Rows of interleaved pixels are added as they lie in memory.
template <int64_t SIZE>
void sums(const uint8_t* at, const Windows& w, int32_t* sum) {
  const int64_t size = SIZE ? SIZE : w.size;
  std::fill_n(sum, w.channels, 0);
  if (w.column == 3) {
    int32_t all[3 * WIDE] = {};
    for (int64_t y = 0; y < size; ++y) {
      for (int64_t x = 0; x < 3 * size; ++x) all[x] += at[y * w.row + x];
    }
    for (int64_t x = 0; x < 3 * size; ++x) sum[x % 3] += all[x];
    return;
  }
  for (int64_t c = 0; c < w.channels; ++c) {
    for (int64_t y = 0; y < size; ++y) {
      for (int64_t x = 0; x < size; ++x) sum[c] += at[c * w.channel + y * w.row + x * w.column];
    }
  }
}

// picture of bytes; found (4, B, N): mean grey of the window, and of the pixel in the middle grey, largest and smallest
// channel, all of them from 0 to 255.
void window_brightness(Tensor picture, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row,
                       int64_t column, int64_t channels, int64_t height, int64_t width, int64_t size) {
  const Windows w = windows(pixel, image, channel, row, column, channels, height, width, size);
  const uint8_t* from = data<uint8_t>(picture);
  const int64_t all = w.batch * w.n;
  float* to = data<float>(found);
  for (int64_t b = 0, i = 0; b < w.batch; ++b) {
    for (int64_t k = 0; k < w.n; ++k, ++i) {
      const uint8_t* at = from + w.first(b, k);
      const uint8_t* centre = at + (size / 2) * (row + column);
      int32_t sum[3];
      (size == 5 ? sums<5> : sums<0>)(at, w, sum);
      float mean[3] = {}, middle[3] = {};
      for (int64_t c = 0; c < channels; ++c) {
        mean[c] = static_cast<float>(sum[c]) / static_cast<float>(size * size);
        middle[c] = static_cast<float>(centre[c * channel]);
      }
      to[i] = luma(mean[0], mean[1], mean[2], channels);
      to[all + i] = luma(middle[0], middle[1], middle[2], channels);
      to[2 * all + i] = *std::max_element(middle, middle + channels);
      to[3 * all + i] = *std::min_element(middle, middle + channels);
    }
  }
}

// A whole number divided, rounded as a division is, which takes longer: right for all bytes over 255 and all whole numbers
// up to 255000 over that.
template <int DIVISOR>
inline float over(float x) {
#ifdef __FMA__
  constexpr float part = 1.0f / DIVISOR;
  const float near = x * part;
  return fused(fused(-static_cast<float>(DIVISOR), near, x), part, near);
#else
  return x / DIVISOR;
#endif
}

// Grey values of a row of a window, and of what happens to lie beside it: of pixels that are interleaved as one division
// of whole numbers, else as of a picture's channels.
#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define DHTORCH_SHUFFLES
#endif
#endif

#ifdef DHTORCH_SHUFFLES
typedef uint8_t Bytes __attribute__((vector_size(16)));
typedef int32_t Whole __attribute__((vector_size(16 * sizeof(int32_t))));

// Of nine interleaved pixels, of which the last eight bytes are read twice over.
inline void nine_greys(const uint8_t* at, float* to) {
  Bytes a, b;
  std::memcpy(&a, at, 16);
  std::memcpy(&b, at + 11, 16);
  const Bytes red = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 23, 26, 29, 0, 0, 0, 0, 0, 0, 0);
  const Bytes green = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 21, 24, 27, 30, 0, 0, 0, 0, 0, 0, 0);
  const Bytes blue = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 22, 25, 28, 31, 0, 0, 0, 0, 0, 0, 0);
  const Whole sum = 299 * __builtin_convertvector(red, Whole) + 587 * __builtin_convertvector(green, Whole) +
                    114 * __builtin_convertvector(blue, Whole);
  for (int64_t x = 0; x < WIDE; ++x) to[x] = over<255000>(static_cast<float>(sum[x]));
}
#endif

template <int64_t SIZE>
inline void grey_row(const uint8_t* at, const Windows& w, bool whole, float* __restrict to) {
  const int64_t size = SIZE ? SIZE : w.size;
#ifdef DHTORCH_SHUFFLES
  if (whole && SIZE == 9) return nine_greys(at, to);
#endif
  if (whole) {
    for (int64_t x = 0; x < size; ++x) {
      to[x] = over<255000>(static_cast<float>(299 * at[3 * x] + 587 * at[3 * x + 1] + 114 * at[3 * x + 2]));
    }
    return;
  }
  const uint8_t *red = at, *green = at + (w.channels - 1) / 2 * w.channel, *blue = at + (w.channels - 1) * w.channel;
  if (w.column == 1 && blue + WIDE <= w.end) {  // what lies beside the window is read with it
    float r[WIDE], g[WIDE], b[WIDE];
    for (int64_t x = 0; x < WIDE; ++x) r[x] = over<255>(red[x]);
    for (int64_t x = 0; x < WIDE; ++x) g[x] = over<255>(green[x]);
    for (int64_t x = 0; x < WIDE; ++x) b[x] = over<255>(blue[x]);
    for (int64_t x = 0; x < WIDE; ++x) to[x] = luma(r[x], g[x], b[x], w.channels);
    return;
  }
  for (int64_t x = 0; x < size; ++x) {
    to[x] = luma(over<255>(red[x * w.column]), over<255>(green[x * w.column]), over<255>(blue[x * w.column]), w.channels);
  }
}

// Squared and mixed gradients of points side by side, summed as torch sums rows: sixteen at a time, these one by one.
struct Sums {
  float part[3][POINTS] = {}, whole[3][POINTS] = {};
  int64_t n = 0;

  void add(const float* __restrict g_x, const float* __restrict g_y) {
    for (int64_t p = 0; p < POINTS; ++p) {
      part[0][p] += g_x[p] * g_x[p];
      part[1][p] += g_x[p] * g_y[p];
      part[2][p] += g_y[p] * g_y[p];
    }
    if (++n % 16) return;
    for (int64_t s = 0; s < 3; ++s) {
      for (int64_t p = 0; p < POINTS; ++p) {
        whole[s][p] += part[s][p];
        part[s][p] = 0.0f;
      }
    }
  }
};

// Where rows of grey values lie, and how far apart.
struct Rows {
  const float* first;
  int64_t step;
};

// Gradients of one point's window, of its inner pixels in the order in which torch sums them, which of interleaved pixels
// is column by column.
template <int64_t SIZE>
void gradients(const Rows& grey, const Windows& w, bool whole, float* __restrict slopes) {
  const int64_t size = SIZE ? SIZE : w.size, inner = size - 2;
  const int64_t down = 2 * POINTS * (whole ? 1 : inner), right = 2 * POINTS * (whole ? inner : 1);
  for (int64_t y = 0; y < inner; ++y) {
    const float *a = grey.first + y * grey.step, *b = a + grey.step, *c = b + grey.step;
    float g_x[WIDE], g_y[WIDE];
    for (int64_t x = 0; x < WIDE; ++x) {
      g_x[x] = fused(b[x + 2] - b[x], 2.0f, (a[x + 2] - a[x]) + (c[x + 2] - c[x]));
      g_y[x] = fused(c[x + 1] - a[x + 1], 2.0f, (c[x] - a[x]) + (c[x + 2] - a[x + 2]));
    }
    for (int64_t x = 0; x < inner; ++x) {
      slopes[y * down + x * right] = g_x[x];
      slopes[y * down + x * right + POINTS] = g_y[x];
    }
  }
}

// Gradients of a window whose pixels are read for it alone.
template <int64_t SIZE>
void read_gradients(const uint8_t* at, const Windows& w, bool whole, float* slopes) {
  float grey[WIDE * ROOM] = {};  // what happens to lie beside a window is computed, too, and costs more where it is no number
  for (int64_t y = 0; y < (SIZE ? SIZE : w.size); ++y) grey_row<SIZE>(at + y * w.row, w, whole, grey + y * ROOM);
  gradients<SIZE>({grey, ROOM}, w, whole, slopes);
}

// Grey values of an interleaved picture, where its windows have more rows than it has vectors; nothing elsewhere.
bool grey_picture(const uint8_t* at, const Windows& w, bool whole, std::vector<float>& grey) {
  const int64_t all = w.height * w.width;
  if (!whole || w.n * w.size * WIDE < all) return false;
  grey.resize(all + ROOM);
  for (int64_t k = 0; k < all; ++k) {
    grey[k] = over<255000>(static_cast<float>(299 * at[3 * k] + 587 * at[3 * k + 1] + 114 * at[3 * k + 2]));
  }
  return true;
}

// The smaller eigenvalue of ((a, b), (b, c)), as dhtorch/geometry/small.py finds it.
inline float smaller(float a, float b, float c) {
  const float half = (a - c) / 2, middle = (a + c) / 2, square = half * half + b * b;
  return middle - (square > 0 ? std::sqrt(square) : square);
}

// picture of bytes; found (1, B, N): smaller eigenvalue of the mean gradient matrix, by the Sobel filters over all but the
// outermost pixels. Windows are at most WIDE pixels wide. With `whole` interleaved pixels become grey as whole numbers.
void window_texture(Tensor picture, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row, int64_t column,
                    int64_t channels, int64_t height, int64_t width, int64_t size, bool whole) {
  Windows w = windows(pixel, image, channel, row, column, channels, height, width, size);
  const uint8_t* from = data<uint8_t>(picture);
  w.end = from + w.batch * channels * height * width;
  const int64_t inner = size - 2;
  std::vector<float> slopes(2 * inner * inner * POINTS), grey;
  float* to = data<float>(found);
  const float count = 16.0f * inner * inner;
  for (int64_t b = 0; b < w.batch; ++b, to += w.n) {
    const bool once = grey_picture(from + b * image, w, whole, grey);
    for (int64_t k = 0; k < w.n; k += POINTS) {
      const int64_t several = std::min(POINTS, w.n - k);
      for (int64_t p = 0; p < several; ++p) {
        const int64_t first = w.first(b, k + p);
        float* own = slopes.data() + p;
        if (once) {
          const Rows rows = {grey.data() + (first - b * image) / 3, width};
          (size == 9 ? gradients<9> : gradients<0>)(rows, w, whole, own);
        } else {
          (size == 9 ? read_gradients<9> : read_gradients<0>)(from + first, w, whole, own);
        }
      }
      Sums sums;
      for (int64_t e = 0; e < inner * inner; ++e) sums.add(slopes.data() + 2 * e * POINTS, slopes.data() + (2 * e + 1) * POINTS);
      for (int64_t p = 0; p < several; ++p) {
        float each[3];
        for (int64_t s = 0; s < 3; ++s) each[s] = sums.part[s][p] + sums.whole[s][p];
        to[k + p] = smaller(each[0], each[1], each[2]) / count;
      }
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def(
      "window_extremes(Tensor depth, Tensor pixel, Tensor(a!) found, int image, int channel, int row, int column, int channels, "
      "int height, int width, int size) -> ()");
  m.def(
      "window_brightness(Tensor picture, Tensor pixel, Tensor(a!) found, int image, int channel, int row, int column, "
      "int channels, int height, int width, int size) -> ()");
  m.def(
      "window_texture(Tensor picture, Tensor pixel, Tensor(a!) found, int image, int channel, int row, int column, "
      "int channels, int height, int width, int size, bool whole) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("window_extremes", TORCH_BOX(&window_extremes));
  m.impl("window_brightness", TORCH_BOX(&window_brightness));
  m.impl("window_texture", TORCH_BOX(&window_texture));
}
