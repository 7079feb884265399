// Values around samples: extremes of depth, brightness and texture of windows, and from them depth, flags and hole classes
// of the samples, and the sensor's own depth map. References: dhtorch/geometry/patches.py, dhtorch/stages/backproject.py and
// holes.py, dhtorch/transforms/sample_spec.py and merge of dhtorch/pipeline/pair.py; integers are exact, textures agree up
// to the rounding of their sums. One thread, no gradient. The dispatch checks dtypes and strides, Python the shapes.

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <numeric>
#include <type_traits>
#include <vector>

#include "vectors.h"

namespace {

// Bytes of a cache line, and lines that are read in sequence in the time of one random access.
constexpr int64_t LINE = 64, FAR = 8;

// Rows of a window, with room for the lanes that are computed beside it.
constexpr int64_t WIDE = MAX_KERNEL_WINDOW_PX, ROOM = WIDE + 2;

// Images in one row of memory, its strides, and the pixels (B, N, 2) of the windows.
struct Windows {
  int64_t image, channel, row, column;
  int64_t channels, height, width, size;
  const int32_t* pixel;
  int64_t batch, n;
  const uint8_t* end = nullptr;  // of the images' memory

  // Offset of the first pixel of a window, which is moved inside the image.
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

struct Extremes {
  float least = std::numeric_limits<float>::infinity(), most = 0.0f;  // without a return
};

inline void extend(float read, Extremes& found) {
  const float z = std::isfinite(read) ? read : 0.0f;
  found.least = z > 0 ? std::min(found.least, z) : found.least;
  found.most = std::max(found.most, z);
}

constexpr int64_t EIGHT = 8;
typedef float Eight __attribute__((vector_size(EIGHT * sizeof(float))));
typedef int32_t EightWhole __attribute__((vector_size(4 * EIGHT)));

inline Eight eight(const float* at) {
  Eight read;
  std::memcpy(&read, at, sizeof(read));
  return read;
}

// Reduction of the first FEW of eight values by `join`, by halves.
template <int64_t FEW, typename Join>
inline float joined(Eight x, float none, const Join& join) {
  for (int64_t k = FEW; k < EIGHT; ++k) x[k] = none;
#ifdef DHTORCH_SHUFFLES
  x = join(x, __builtin_shufflevector(x, x, 4, 5, 6, 7, 4, 5, 6, 7));
  x = join(x, __builtin_shufflevector(x, x, 2, 3, 2, 3, 2, 3, 2, 3));
  return join(x, __builtin_shufflevector(x, x, 1, 1, 1, 1, 1, 1, 1, 1))[0];
#else
  for (int64_t half = EIGHT / 2; half; half /= 2) {
    for (int64_t k = 0; k < half; ++k) x[k] = join(Eight{} + x[k], Eight{} + x[k + half])[0];
  }
  return x[0];
#endif
}

// Of five rows of five returns; three more values of each row are read and ignored.
inline Extremes five_extremes(const float* at, int64_t row) {
  const Eight none = {};
  const Eight infinity = none + std::numeric_limits<float>::infinity();
  Eight low = infinity, high = none;
  for (int64_t y = 0; y < 5; ++y) {
    const Eight read = eight(at + y * row);
    const auto some = (read > none) & (read < infinity);
    const Eight least = some ? read : infinity, most = some ? read : none;
    low = least < low ? least : low;
    high = most > high ? most : high;
  }
  const auto less = [](Eight a, Eight b) { return a < b ? a : b; };
  const auto more = [](Eight a, Eight b) { return a > b ? a : b; };
  return {joined<5>(low, std::numeric_limits<float>::infinity(), less), joined<5>(high, 0.0f, more)};
}

// Of the window that begins at a return; `end` is the end of the map.
inline Extremes extremes_at(const float* at, const Windows& w, const float* end) {
  if (w.size == 5 && w.column == 1 && at + 4 * w.row + EIGHT <= end) return five_extremes(at, w.row);
  Extremes found;
  for (int64_t y = 0; y < w.size; ++y) {
    for (int64_t x = 0; x < w.size; ++x) extend(at[y * w.row + x * w.column], found);
  }
  return found;
}

// depth (B h w) float32. Output: found (2, B, N), smallest and largest return, infinity and 0 where there is none.
void window_extremes(Tensor depth, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row, int64_t column,
                     int64_t channels, int64_t height, int64_t width, int64_t size) {
  const Windows w = windows(pixel, image, channel, row, column, channels, height, width, size);
  const float *from = data<float>(depth), *end = from + w.batch * height * width;
  float *low = data<float>(found), *high = low + w.batch * w.n;
  for (int64_t b = 0; b < w.batch; ++b) {
    for (int64_t k = 0; k < w.n; ++k) {
      const Extremes seen = extremes_at(from + w.first(b, k), w, end);
      *low++ = seen.least;
      *high++ = seen.most;
    }
  }
}

inline float grey_of(float red, float green, float blue, int64_t channels) {
  return channels == 1 ? red : luma(red, green, blue);
}

typedef uint8_t Bytes __attribute__((vector_size(WIDE)));
typedef uint16_t Words __attribute__((vector_size(2 * WIDE)));

// Sums over the window for each channel. Rows of interleaved pixels are added as they lie in memory.
template <int64_t SIZE>
inline void sums(const uint8_t* at, const Windows& w, int32_t* sum) {
  const int64_t size = SIZE ? SIZE : w.size;
  std::fill_n(sum, w.channels, 0);
  if (SIZE == 5 && w.column == 3 && at + 4 * w.row + WIDE <= w.end) {
    Words all = {};  // of five rows of five pixels and one more byte
    for (int64_t y = 0; y < 5; ++y) {
      Bytes read;
      std::memcpy(&read, at + y * w.row, sizeof(read));
      all += __builtin_convertvector(read, Words);
    }
    for (int64_t c = 0; c < 3; ++c) sum[c] = all[c] + all[c + 3] + all[c + 6] + all[c + 9] + all[c + 12];
    return;
  }
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

struct Brightness {
  float mean, centre, most, least;  // mean grey of the window; grey, largest and smallest channel of its middle pixel
};

// From the sums over a window and its middle pixel.
template <int64_t SIZE, int64_t CHANNELS, typename Sum>
inline Brightness brightness_of(const Sum& sum, const uint8_t* centre, const Windows& w) {
  const int64_t channels = CHANNELS ? CHANNELS : w.channels;
  const float count = static_cast<float>(w.size * w.size);
  float mean[3] = {}, middle[3] = {};
  for (int64_t c = 0; c < channels; ++c) {
    mean[c] = SIZE == 5 ? over<25>(sum(c)) : static_cast<float>(sum(c)) / count;
    middle[c] = static_cast<float>(centre[c * w.channel]);
  }
  float most = middle[0], least = middle[0];
  for (int64_t c = 1; c < channels; ++c) {
    most = std::max(most, middle[c]);
    least = std::min(least, middle[c]);
  }
  return {grey_of(mean[0], mean[1], mean[2], channels), grey_of(middle[0], middle[1], middle[2], channels), most, least};
}

template <int64_t SIZE, int64_t CHANNELS>
inline Brightness brightness_at(const uint8_t* at, const Windows& w) {
  int32_t sum[3];
  sums<SIZE>(at, w, sum);
  const auto sum_of = [&](int64_t c) { return sum[c]; };
  return brightness_of<SIZE, CHANNELS>(sum_of, at + w.size / 2 * (w.row + w.column), w);
}

// Smallest and largest return in the 5x5 window of every pixel of a map but the outermost two.
struct WholeMap {
  std::vector<float> least, most, low, high;

  void find(const float* at, const Windows& w) {
    const int64_t wide = w.width;
    constexpr float none = std::numeric_limits<float>::infinity();
    for (auto* all : {&least, &most}) all->resize(w.height * wide);
    for (auto* row : {&low, &high}) row->resize(wide);
    for (int64_t y = 2; y + 2 < w.height; ++y) {
      float *__restrict a = low.data(), *__restrict b = high.data();
      std::fill_n(a, wide, none);
      std::fill_n(b, wide, 0.0f);
      for (int64_t k = y - 2; k <= y + 2; ++k) {
        const float* __restrict read = at + k * wide;
        for (int64_t x = 0; x < wide; ++x) {
          const bool some = (read[x] > 0.0f) & (read[x] < none);
          const float z = some ? read[x] : none, up = some ? read[x] : 0.0f;
          a[x] = z < a[x] ? z : a[x];
          b[x] = up > b[x] ? up : b[x];
        }
      }
      float *__restrict to = least.data() + y * wide, *__restrict up_to = most.data() + y * wide;
      for (int64_t x = 2; x < wide - 2; ++x) {
        to[x] = std::min(std::min(std::min(a[x - 2], a[x - 1]), std::min(a[x + 1], a[x + 2])), a[x]);
        up_to[x] = std::max(std::max(std::max(b[x - 2], b[x - 1]), std::max(b[x + 1], b[x + 2])), b[x]);
      }
    }
  }

  Extremes at(int64_t first, const Windows& w) const {
    const int64_t centre = first + 2 * (w.row + w.column);
    return {least[centre], most[centre]};
  }
};

// Sums over the 5x5 window of every pixel of an image but the outermost two, in the image's layout.
struct WholePicture {
  std::vector<uint16_t> sum, column;

  void find(const uint8_t* at, const Windows& w) {
    const int64_t planes = w.column > 1 ? 1 : w.channels, step = w.column, line = w.row;  // a line holds all channels, or one
    sum.resize(w.channels * w.height * w.width);
    column.resize(line);
    for (int64_t p = 0; p < planes; ++p) {
      for (int64_t y = 2; y + 2 < w.height; ++y) {
        const int64_t place = p * w.channel + y * line;
        const uint8_t *__restrict a = at + place - 2 * line, *__restrict b = a + line, *__restrict c = b + line;
        const uint8_t *__restrict d = c + line, *__restrict e = d + line;
        uint16_t *__restrict five = column.data(), *__restrict to = sum.data() + place;
        for (int64_t x = 0; x < line; ++x) five[x] = static_cast<uint16_t>(a[x] + b[x] + c[x] + d[x] + e[x]);
        for (int64_t x = 2 * step; x < line - 2 * step; ++x) {
          to[x] = static_cast<uint16_t>(five[x - 2 * step] + five[x - step] + five[x] + five[x + step] + five[x + 2 * step]);
        }
      }
    }
  }

  template <int64_t SIZE, int64_t CHANNELS>
  Brightness at(int64_t first, const uint8_t* picture, const Windows& w) const {
    const int64_t centre = first + 2 * (w.row + w.column);
    const auto sum_of = [&](int64_t c) { return sum[centre + c * w.channel]; };
    return brightness_of<SIZE, CHANNELS>(sum_of, picture + centre, w);
  }
};

template <int64_t SIZE, int64_t CHANNELS>
void brightnesses(const uint8_t* from, const Windows& w, float* to) {
  const int64_t all = w.batch * w.n;
  for (int64_t b = 0, i = 0; b < w.batch; ++b) {
    for (int64_t k = 0; k < w.n; ++k, ++i) {
      const Brightness seen = brightness_at<SIZE, CHANNELS>(from + w.first(b, k), w);
      to[i] = seen.mean;
      to[all + i] = seen.centre;
      to[2 * all + i] = seen.most;
      to[3 * all + i] = seen.least;
    }
  }
}

// Windows of uint8 images; 5x5 pixels and three channels are the usual case, which is compiled by itself.
Windows of_picture(Windows w, const uint8_t* from) {
  w.end = from + w.batch * w.channels * w.height * w.width;
  return w;
}

inline bool usual(const Windows& w) { return w.size == 5 && w.channels == 3; }

// picture uint8. Output: found (4, B, N), mean grey of the window, and grey, largest and smallest channel of its middle
// pixel, 0 to 255.
void window_brightness(Tensor picture, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row,
                       int64_t column, int64_t channels, int64_t height, int64_t width, int64_t size) {
  const uint8_t* from = data<uint8_t>(picture);
  const Windows w = of_picture(windows(pixel, image, channel, row, column, channels, height, width, size), from);
  (usual(w) ? brightnesses<5, 3> : brightnesses<0, 0>)(from, w, data<float>(found));
}

// Grey value of a pixel in units of 1 / GREY_UNIT: an integer, exact however such values are summed.
inline float integer_grey(const uint8_t* at) {
  return static_cast<float>(LUMA_THOUSANDTHS[0] * at[0] + LUMA_THOUSANDTHS[1] * at[1] + LUMA_THOUSANDTHS[2] * at[2]);
}

// Grey values of a row of a window, and perhaps of pixels beside it: with `whole`, of interleaved pixels, one division of
// an integer, else the weighted sum of channels.
inline void grey_row(const uint8_t* at, const Windows& w, bool whole, float* __restrict to) {
  if (whole) {
    for (int64_t x = 0; x < w.size; ++x) {
      to[x] = over<GREY_UNIT>(integer_grey(at + 3 * x));
    }
    return;
  }
  const uint8_t *red = at, *green = at + (w.channels - 1) / 2 * w.channel, *blue = at + (w.channels - 1) * w.channel;
  if (w.column == 1 && blue + WIDE <= w.end) {  // WIDE pixels, the window and some beside it
    float r[WIDE], g[WIDE], b[WIDE];
    for (int64_t x = 0; x < WIDE; ++x) r[x] = over<255>(red[x]);
    for (int64_t x = 0; x < WIDE; ++x) g[x] = over<255>(green[x]);
    for (int64_t x = 0; x < WIDE; ++x) b[x] = over<255>(blue[x]);
    for (int64_t x = 0; x < WIDE; ++x) to[x] = grey_of(r[x], g[x], b[x], w.channels);
    return;
  }
  for (int64_t x = 0; x < w.size; ++x) {
    to[x] = grey_of(over<255>(red[x * w.column]), over<255>(green[x * w.column]), over<255>(blue[x * w.column]), w.channels);
  }
}

// Smaller eigenvalue of ((a, b), (b, c)), as in dhtorch/geometry/linalg.py.
inline float smaller(float a, float b, float c) {
  const float half = (a - c) / 2, middle = (a + c) / 2, square = half * half + b * b;
  return middle - (square > 0 ? std::sqrt(square) : square);
}

// Gradient matrices of many windows, whose eigenvalues are computed together.
struct Matrices {
  static constexpr int64_t ROOM = 64;
  float xx[ROOM], xy[ROOM], yy[ROOM];

  void keep(int64_t at, float of_xx, float of_xy, float of_yy) {
    xx[at] = of_xx;
    xy[at] = of_xy;
    yy[at] = of_yy;
  }
};

// Gradient matrix of a window, summed over its inner pixels. Lanes beside the window are computed and left out.
inline void gradients(const uint8_t* at, const Windows& w, bool whole, Matrices& into, int64_t k) {
  float grey[WIDE * ROOM] = {};  // also beside the window: NaN and denormals would be slower
  for (int64_t y = 0; y < w.size; ++y) grey_row(at + y * w.row, w, whole, grey + y * ROOM);
  float xx[WIDE] = {}, xy[WIDE] = {}, yy[WIDE] = {};
  for (int64_t y = 0; y < w.size - 2; ++y) {
    const float *a = grey + y * ROOM, *b = a + ROOM, *c = b + ROOM;
    for (int64_t x = 0; x < WIDE; ++x) {
      const float g_x = fused(b[x + 2] - b[x], 2.0f, (a[x + 2] - a[x]) + (c[x + 2] - c[x]));
      const float g_y = fused(c[x + 1] - a[x + 1], 2.0f, (c[x] - a[x]) + (c[x + 2] - a[x + 2]));
      xx[x] += g_x * g_x;
      xy[x] += g_x * g_y;
      yy[x] += g_y * g_y;
    }
  }
  const auto sum = [&](const float* x) { return std::accumulate(x, x + w.size - 2, 0.0f); };
  into.keep(k, sum(xx), sum(xy), sum(yy));
}

#ifdef DHTORCH_SHUFFLES
typedef uint16_t EightWords __attribute__((vector_size(2 * EIGHT)));

// Every other byte, as floats.
inline Eight even_bytes(Bytes from) {
  EightWords words;
  std::memcpy(&words, &from, sizeof(words));
  return __builtin_convertvector(__builtin_convertvector(words & 255, EightWhole), Eight);
}

inline Eight eight_greys(const uint8_t* at) {
  Bytes a, b;
  std::memcpy(&a, at, WIDE);
  std::memcpy(&b, at + 8, WIDE);
  const Bytes red = __builtin_shufflevector(a, b, 0, 16, 3, 16, 6, 16, 9, 16, 12, 16, 15, 16, 26, 16, 29, 16);
  const Bytes green = __builtin_shufflevector(a, b, 1, 16, 4, 16, 7, 16, 10, 16, 13, 16, 24, 16, 27, 16, 30, 16);
  const Bytes blue = __builtin_shufflevector(a, b, 2, 16, 5, 16, 8, 16, 11, 16, 14, 16, 25, 16, 28, 16, 31, 16);
  const float r = LUMA_THOUSANDTHS[0], g = LUMA_THOUSANDTHS[1], b_ = LUMA_THOUSANDTHS[2];
  return r * even_bytes(red) + g * even_bytes(green) + b_ * even_bytes(blue);
}

// The horizontal part of both Sobel filters on a row of nine pixels: differences and weighted sums; seven are valid.
struct Row {
  Eight across, along;

  explicit Row(const uint8_t* at) {
    const Eight left = eight_greys(at), last = Eight{} + integer_grey(at + 24);
    *this = {left, __builtin_shufflevector(left, last, 1, 2, 3, 4, 5, 6, 7, 8),
             __builtin_shufflevector(left, last, 2, 3, 4, 5, 6, 7, 8, 8)};
  }

  // Reads one value beside the nine.
  explicit Row(const float* at) : Row(eight(at), eight(at + 1), eight(at + 2)) {}

  Row(Eight left, Eight middle, Eight right) : across(right - left), along(left + middle + (middle + right)) {}
};

// Gradient matrix of 9x9 pixels in registers, from bytes or integer grey values; gradients are exact.
template <typename Pixel>
inline void nine_gradients(const Pixel* at, int64_t row, Matrices& into, int64_t k) {
  Row above(at), middle(at + row);
  Eight xx = {}, xy = {}, yy = {};
  for (int64_t y = 2; y < 9; ++y) {
    const Row below(at + y * row);
    const Eight g_x = above.across + middle.across + (middle.across + below.across), g_y = below.along - above.along;
    xx += g_x * g_x;
    xy += g_x * g_y;
    yy += g_y * g_y;
    above = middle;
    middle = below;
  }
  const auto sum = [](Eight x) { return joined<7>(x, 0.0f, [](Eight a, Eight b) { return a + b; }); };
  into.keep(k, sum(xx), sum(xy), sum(yy));
}

// Integer grey values of a whole interleaved image, if its windows have more pixels than it has; else nothing.
std::unique_ptr<float[]> grey_picture(const uint8_t* at, const Windows& w) {
  const int64_t all = w.height * w.width;
  if (w.n * w.size * w.size < all) return {};
  std::unique_ptr<float[]> grey(new float[all + WIDE]);
  int64_t k = 0;
  for (; k + EIGHT <= all; k += EIGHT) {
    const Eight some = eight_greys(at + 3 * k);
    std::memcpy(&grey[k], &some, sizeof(some));
  }
  for (; k < all; ++k) grey[k] = integer_grey(at + 3 * k);
  std::fill_n(&grey[all], WIDE, 0.0f);  // beside the last windows
  return grey;
}
#endif

// Read an image in sequence, which fills the cache several times as fast as reading its windows; does nothing where the
// windows are so few that they take less time.
template <typename T>
inline void prefetch(const T* from, int64_t count, const Windows& w) {
  const int64_t bytes = count * static_cast<int64_t>(sizeof(T));
  if (w.n * w.size * FAR * LINE < bytes) return;
  const volatile uint8_t* at = reinterpret_cast<const uint8_t*>(from);
  for (int64_t k = 0; k < bytes; k += LINE) (void)at[k];
}

// Calls `each` for every window, which stores a gradient matrix, and writes the textures of one image.
template <typename Each>
void textures(const Windows& w, float unit, float* to, const Each& each) {
  const float count = 16.0f * (w.size - 2) * (w.size - 2);
  Matrices kept;
  for (int64_t begin = 0; begin < w.n; begin += Matrices::ROOM) {
    const int64_t some = std::min(Matrices::ROOM, w.n - begin);
    for (int64_t k = 0; k < some; ++k) each(begin + k, kept, k);
    for (int64_t k = 0; k < some; ++k) *to++ = smaller(kept.xx[k], kept.xy[k], kept.yy[k]) / unit / unit / count;
  }
}

// Textures of one of the images that begin at `from`; see window_texture.
void textures_of(const uint8_t* from, const Windows& w, int64_t b, bool whole, float* to) {
  const uint8_t* picture = from + b * w.image;
#ifdef DHTORCH_SHUFFLES
  if (whole && w.size == 9) {
    const std::unique_ptr<float[]> grey = grey_picture(picture, w);
    if (!grey) prefetch(picture, w.image, w);
    textures(w, static_cast<float>(GREY_UNIT), to, [&](int64_t i, Matrices& kept, int64_t k) {
      const int64_t first = w.first(b, i);
      if (grey) {
        nine_gradients(&grey[(first - b * w.image) / 3], w.width, kept, k);
      } else {
        nine_gradients(from + first, w.row, kept, k);
      }
    });
    return;
  }
#endif
  prefetch(picture, w.image, w);
  textures(w, 1.0f, to, [&](int64_t i, Matrices& kept, int64_t k) { gradients(from + w.first(b, i), w, whole, kept, k); });
}

// picture uint8. Output: found (B, N), smaller eigenvalue of the mean gradient matrix, by Sobel filters over all but the
// outermost pixels of windows of at most WIDE pixels. With `whole`, grey values of interleaved pixels are integers first.
void window_texture(Tensor picture, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row, int64_t column,
                    int64_t channels, int64_t height, int64_t width, int64_t size, bool whole) {
  const uint8_t* from = data<uint8_t>(picture);
  const Windows w = of_picture(windows(pixel, image, channel, row, column, channels, height, width, size), from);
  for (int64_t b = 0; b < w.batch; ++b) textures_of(from, w, b, whole, data<float>(found) + b * w.n);
}

// Whether the window around a pixel lies in the image.
inline bool fits(const int32_t* at, int64_t height, int64_t width, int64_t size) {
  const int64_t before = size / 2, after = size - before;
  return at[0] >= before && at[0] <= width - after && at[1] >= before && at[1] <= height - after;
}

// The pixel that contains a coordinate, as containing_pixels of dhtorch/geometry/patches.py; outside of any image for NaN.
inline int32_t pixel_of(float at) {
  const float whole = std::floor((std::isnan(at) ? -1.0f : at) + 0.5f);
  return whole >= -2147483648.0f && whole < 2147483648.0f ? static_cast<int32_t>(whole) : std::numeric_limits<int32_t>::min();
}

// Pixels (B, N, 2) of uv (B, N, 2) in the image and in the depth map (`at`), and rays (B, N, 3), of cameras without
// distortion with focal lengths f and centres c (B, 2). The map has intrinsics of its own, or empty ones where it covers the
// image, at (across, down) times its size.
void project_samples(Tensor uv, Tensor f, Tensor c, Tensor map_f, Tensor map_c, Tensor pixel, Tensor at, Tensor ray, double across, double down) {
  const int64_t batch = uv.size(0), n = uv.size(1);
  const float *from = data<float>(uv), *focal = data<float>(f), *centre = data<float>(c);
  const float scale[2] = {static_cast<float>(across), static_cast<float>(down)};
  const bool same = across == 1 && down == 1, own = map_f.numel() > 0;
  const float *own_focal = own ? data<float>(map_f) : focal, *own_centre = own ? data<float>(map_c) : centre;
  int32_t *pixels = data<int32_t>(pixel), *map = data<int32_t>(at);
  float* rays = data<float>(ray);
  for (int64_t b = 0, i = 0; b < batch; ++b, focal += 2, centre += 2, own_focal += 2, own_centre += 2) {
    for (const int64_t end = i + n; i < end; ++i) {
      for (int64_t k = 0; k < 2; ++k) {
        const float x = from[2 * i + k];
        pixels[2 * i + k] = pixel_of(x);
        const float scaled = same ? x : (x + 0.5f) * scale[k] - 0.5f;
        map[2 * i + k] = pixel_of(own ? (x - centre[k]) / focal[k] * own_focal[k] + own_centre[k] : scaled);
        rays[3 * i + k] = ((std::isfinite(x) ? x : 0.0f) - centre[k]) / focal[k];
      }
      rays[3 * i + 2] = 1.0f;
    }
  }
}

void containing_pixels(Tensor uv, Tensor pixel) {
  const float* from = data<float>(uv);
  int32_t* to = data<int32_t>(pixel);
  const int64_t all = uv.numel();
  for (int64_t i = 0; i < all; ++i) to[i] = pixel_of(from[i]);
}

inline bool is_point(const float* x) { return std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2]); }

// ReturnLimits of backproject.py, and what makes a highlight.
struct Limits {
  float near, conf, fixed, relative, edge, dim, white, bright, colour, contrast;

  Limits(double near_limit, double min_conf, double sigma_m, double sigma_rel, double edge_rel, double dark, double saturated,
         double highlight, double colour_rel, double min_contrast)
      : near(near_limit), conf(min_conf), fixed(sigma_m * sigma_m), relative(sigma_rel), edge(1.0 + edge_rel), dim(dark * 255),
        white(saturated * 255), bright(highlight * 255), colour(colour_rel), contrast(min_contrast * 255) {}
};

// Values around a sample, and its ray.
struct Reading {
  float z, level;
  Extremes around;
  Brightness seen;
  const float* ray;
  bool border;
};

// Outputs of backproject: depth, sigma and confidence (B, N), xyz (B, N, 3), flags (B, N).
struct Outputs {
  float *depth, *sigma, *confidence, *xyz;
  int32_t* flag;

  void write(int64_t i, const Reading& x, const Limits& limits) const {
    const bool returned = x.z > 0, beyond = x.z > limits.near, unsure = returned && x.level < limits.conf;
    const bool differs = returned && x.around.most > x.around.least * limits.edge, clipped = x.seen.mean >= limits.white;
    const bool shine = x.seen.most - x.seen.least <= limits.colour * x.seen.most && x.seen.centre >= limits.bright &&
                       x.seen.centre - x.seen.mean >= limits.contrast;
    bool usable = returned && !unsure && !beyond;
    for (int64_t k = 0; k < 3; ++k) usable = usable && std::isfinite(x.ray[k] * x.z);
    for (int64_t k = 0; k < 3; ++k) xyz[3 * i + k] = usable ? x.ray[k] * x.z : std::numeric_limits<float>::quiet_NaN();
    float sure = std::clamp(x.level / 2, 0.0f, 1.0f);
    for (const bool doubt : {differs, shine, clipped}) sure = doubt ? sure / 2 : sure;
    const float noise = limits.relative * x.z;
    depth[i] = x.z;
    sigma[i] = limits.fixed > 0 ? std::sqrt(limits.fixed + noise * noise) : noise;
    confidence[i] = usable ? sure : 0.0f;
    flag[i] = !returned * FLAG_NO_DEPTH | unsure * FLAG_LOW_CONF | beyond * FLAG_BEYOND_NEAR | differs * FLAG_DEPTH_EDGE |
              x.border * FLAG_BORDER | (x.seen.mean <= limits.dim) * FLAG_UNDEREXPOSED | clipped * FLAG_SATURATED |
              shine * FLAG_SPECULAR;
  }
};

template <int64_t SIZE, int64_t CHANNELS>
void read_samples(const float* map, const uint8_t* levels, const Windows& returns, bool whole_map, const uint8_t* picture,
                  const Windows& seen, bool whole_picture, const float* rays, const Outputs& outputs, const Limits& limits) {
  const int64_t h = returns.height, w = returns.width;
  const float* end = map + returns.batch * h * w;
  WholeMap extremes;
  WholePicture sums;
  for (int64_t b = returns.batch; b-- > 0;) {  // the last image was collated just now and is still in the cache
    const uint8_t* image = picture + b * seen.image;
    whole_map ? extremes.find(map + b * h * w, returns) : prefetch(map + b * h * w, h * w, returns);
    whole_picture ? sums.find(image, seen) : prefetch(image, seen.image, seen);
    for (int64_t k = 0; k < returns.n; ++k) {
      const int64_t i = b * returns.n + k, first = returns.first(b, k), corner = seen.first(b, k) - b * seen.image;
      const int32_t* place = returns.pixel + 2 * i;
      const int64_t x = std::clamp<int64_t>(place[0], 0, w - 1), y = std::clamp<int64_t>(place[1], 0, h - 1);
      const int64_t there = (b * h + y) * w + x;
      const float z = fits(place, h, w, 1) && std::isfinite(map[there]) && map[there] > 0 ? map[there] : 0.0f;
      outputs.write(i,
                    {z, levels ? levels[there] : 2.0f,
                     whole_map ? extremes.at(first - b * h * w, returns) : extremes_at(map + first, returns, end),
                     whole_picture ? sums.at<SIZE, CHANNELS>(corner, image, seen)
                                   : brightness_at<SIZE, CHANNELS>(image + corner, seen),
                     rays + 3 * i, !fits(seen.pixel + 2 * i, seen.height, seen.width, seen.size)},
                    limits);
    }
  }
}

// depth (B h w) and conf (B h w) or empty, at pixels `at` (B, N, 2), with windows of `reach` px; a picture of bytes at pixels
// (B, N, 2), with windows of `size` px; rays (B, N, 3). Outputs: see Outputs. `whole_map` and `whole_picture`: windows of
// all pixels are computed first, which is possible for windows of 5 px.
void backproject(Tensor depth, Tensor conf, Tensor at, Tensor picture, Tensor pixel, Tensor ray, Tensor found, Tensor sigma,
                 Tensor confidence, Tensor xyz, Tensor flag, int64_t reach, int64_t image, int64_t channel, int64_t row,
                 int64_t column, int64_t channels, int64_t height, int64_t width, int64_t size, double near_limit,
                 double min_conf, double sigma_m, double sigma_rel, double edge_rel, double dark, double saturated,
                 double highlight, double max_colour_rel, double min_contrast, bool whole_map, bool whole_picture) {
  const int64_t h = depth.size(1), w = depth.size(2);
  const uint8_t *from = data<uint8_t>(picture), *levels = conf.numel() > 0 ? data<uint8_t>(conf) : nullptr;
  const Windows returns = windows(at, h * w, 0, w, 1, 1, h, w, reach);
  const Windows seen = of_picture(windows(pixel, image, channel, row, column, channels, height, width, size), from);
  const Outputs outputs = {data<float>(found), data<float>(sigma), data<float>(confidence), data<float>(xyz), data<int32_t>(flag)};
  const Limits limits(near_limit, min_conf, sigma_m, sigma_rel, edge_rel, dark, saturated, highlight, max_colour_rel,
                      min_contrast);
  const bool all_returns = whole_map && reach == 5, all_pixels = whole_picture && size == 5;
  (usual(seen) ? read_samples<5, 3> : read_samples<0, 0>)(data<float>(depth), levels, returns, all_returns, from, seen,
                                                          all_pixels, data<float>(ray), outputs, limits);
}

// xyz (B, N, 3), flag, trackability (B, N). Output: hole (B, N), the first class that holds, see Hole in dhtorch/codes.py.
void classify_holes(Tensor xyz, Tensor flag, Tensor trackability, Tensor hole, double min_trackability) {
  const float *points = data<float>(xyz), *textures = data<float>(trackability), least = min_trackability;
  const int32_t* flags = data<int32_t>(flag);
  int32_t* kinds = data<int32_t>(hole);
  const int64_t all = hole.numel();
  for (int64_t i = 0; i < all; ++i) {
    const int32_t bits = flags[i];
    int32_t kind = textures[i] < least ? HOLE_LOW_TEXTURE : HOLE_TRACKABLE_NO_LIDAR;
    if (bits & FLAG_SPECULAR) kind = HOLE_HIGHLIGHT;
    if (bits & FLAG_SATURATED) kind = HOLE_TOO_BRIGHT;
    if (bits & FLAG_UNDEREXPOSED) kind = HOLE_TOO_DARK;
    if (bits & FLAG_BORDER) kind = HOLE_AT_BORDER;
    if (is_point(points + 3 * i)) kind = HOLE_NONE;
    kinds[i] = kind;
  }
}

// depth (B h w). Output: counts (2, B): of every `step`-th value how many are positive, and between both bounds.
void count_returns(Tensor depth, Tensor counts, int64_t step, double low, double high) {
  const int64_t batch = depth.size(0), all = depth.size(1) * depth.size(2);
  const float least = low, most = high;
  int64_t* to = data<int64_t>(counts);
  for (int64_t b = 0; b < batch; ++b) {
    const float *map = data<float>(depth) + b * all, *end = map + all;
    int64_t positive = 0, between = 0;
    for (const float* at = map; at < end; at += step) {  // without branches
      positive += *at > 0;
      between += (*at > least) & (*at < most);
    }
    to[b] = positive;
    to[batch + b] = between;
  }
}

// depth, sigma, confidence (B, N), xyz (B, N, 3). Outputs: z, noise, score and source (B, N) of samples with a point, 0
// elsewhere.
void sensor_values(Tensor depth, Tensor sigma, Tensor confidence, Tensor xyz, Tensor z, Tensor noise, Tensor score, Tensor source) {
  const float *own_z = data<float>(depth), *own_noise = data<float>(sigma), *own_score = data<float>(confidence);
  const float* points = data<float>(xyz);
  float *to_z = data<float>(z), *to_noise = data<float>(noise), *to_score = data<float>(score);
  int32_t* to_source = data<int32_t>(source);
  const int64_t all = depth.numel();
  for (int64_t i = 0; i < all; ++i) {
    const bool usable = is_point(points + 3 * i);
    to_z[i] = usable ? own_z[i] : 0.0f;
    to_noise[i] = usable ? own_noise[i] : 0.0f;
    to_score[i] = usable ? own_score[i] : 0.0f;
    to_source[i] = usable ? SOURCE_SENSOR : SOURCE_NONE;
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
  m.def(
      "project_samples(Tensor uv, Tensor f, Tensor c, Tensor map_f, Tensor map_c, Tensor(a!) pixel, Tensor(b!) at, Tensor(c!) ray, "
      "float across, float down) -> ()");
  m.def("containing_pixels(Tensor uv, Tensor(a!) pixel) -> ()");
  m.def(
      "backproject(Tensor depth, Tensor conf, Tensor at, Tensor picture, Tensor pixel, Tensor ray, Tensor(a!) found, "
      "Tensor(b!) sigma, Tensor(c!) confidence, Tensor(d!) xyz, Tensor(e!) flag, int reach, int image, int channel, int row, "
      "int column, int channels, int height, int width, int size, float near_limit, float min_conf, float sigma_m, "
      "float sigma_rel, float edge_rel, float dark, float saturated, float highlight, float max_colour_rel, "
      "float min_contrast, bool whole_map, bool whole_picture) -> ()");
  m.def("classify_holes(Tensor xyz, Tensor flag, Tensor trackability, Tensor(a!) hole, float min_trackability) -> ()");
  m.def("count_returns(Tensor depth, Tensor(a!) counts, int step, float low, float high) -> ()");
  m.def(
      "sensor_values(Tensor depth, Tensor sigma, Tensor confidence, Tensor xyz, Tensor(a!) z, Tensor(b!) noise, Tensor(c!) score, "
      "Tensor(d!) source) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("window_extremes", TORCH_BOX(&window_extremes));
  m.impl("window_brightness", TORCH_BOX(&window_brightness));
  m.impl("window_texture", TORCH_BOX(&window_texture));
  m.impl("project_samples", TORCH_BOX(&project_samples));
  m.impl("containing_pixels", TORCH_BOX(&containing_pixels));
  m.impl("backproject", TORCH_BOX(&backproject));
  m.impl("classify_holes", TORCH_BOX(&classify_holes));
  m.impl("count_returns", TORCH_BOX(&count_returns));
  m.impl("sensor_values", TORCH_BOX(&sensor_values));
}
