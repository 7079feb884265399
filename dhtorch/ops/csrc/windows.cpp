// A few numbers about the window around each sample: extremes of depth, brightness, texture; what stages 2 and 3 make of them, and
// the sensor's own map; the same of one picture at once. Twin of dhtorch/geometry/patches.py, stages/backproject.py and
// stages/holes.py, of dhtorch/transforms/sample_spec.py and of dhtorch/pipeline/pair.py, merge, which are the reference: whole numbers are exact,
// textures up to the rounding of their sums. One thread, no gradient. Callers check shapes, types and strides.

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

// Bytes that come near the processor together, and how many such lines can be read in a row while one is waited for.
constexpr int64_t LINE = 64, FAR = 8;

// Rows of a window, with room for the lanes that are computed beside it.
constexpr int64_t WIDE = 16, ROOM = WIDE + 2;

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

struct Extremes {
  float least = std::numeric_limits<float>::infinity(), most = 0.0f;  // as where there is no return
};

template <typename Raw>
inline void extend(Raw raw, Extremes& found) {
  const float read = raw, z = std::isfinite(read) ? read : 0.0f;
  found.least = z > 0 ? std::min(found.least, z) : found.least;
  found.most = std::max(found.most, z);
}

constexpr int64_t EIGHT = 8;
typedef float Eight __attribute__((vector_size(EIGHT * sizeof(float))));
typedef int32_t EightWhole __attribute__((vector_size(4 * EIGHT)));

template <typename Raw>
inline Eight eight(const Raw* at) {
  typedef Raw EightRaw __attribute__((vector_size(EIGHT * sizeof(Raw))));
  EightRaw read;
  std::memcpy(&read, at, sizeof(read));
  if constexpr (std::is_same_v<Raw, float>) {
    return read;
  } else {
    return __builtin_convertvector(__builtin_convertvector(read, EightWhole), Eight);
  }
}

// What `join` makes of the first few of eight numbers, two by two.
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

// Of five rows of five returns, which are read with the three beside them.
template <typename Raw>
inline Extremes five_extremes(const Raw* at, int64_t row) {
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

// Of the window that begins at a return; `end` is behind the last one.
template <typename Raw>
inline Extremes extremes_at(const Raw* at, const Windows& w, const Raw* end) {
  if (w.size == 5 && w.column == 1 && at + 4 * w.row + EIGHT <= end) return five_extremes(at, w.row);
  Extremes found;
  for (int64_t y = 0; y < w.size; ++y) {
    for (int64_t x = 0; x < w.size; ++x) extend(at[y * w.row + x * w.column], found);
  }
  return found;
}

// depth (B h w) float32; found (2, B, N): the smallest and the largest return, infinity and 0 where there is none.
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

inline float luma(float red, float green, float blue, int64_t channels) {
  return channels == 1 ? red : fused(blue, 0.114f, fused(green, 0.587f, red * 0.299f));
}

typedef uint8_t Bytes __attribute__((vector_size(WIDE)));
typedef uint16_t Words __attribute__((vector_size(2 * WIDE)));

// Sums over the window, channel by channel. Rows of interleaved pixels are added as they lie in memory.
template <int64_t SIZE>
inline void sums(const uint8_t* at, const Windows& w, int32_t* sum) {
  const int64_t size = SIZE ? SIZE : w.size;
  std::fill_n(sum, w.channels, 0);
  if (SIZE == 5 && w.column == 3 && at + 4 * w.row + WIDE <= w.end) {
    Words all = {};  // of five rows of five pixels, and of the byte beside them
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
  float mean, centre, most, least;  // grey of the window; of the pixel in the middle grey, largest and smallest channel
};

// Of the sums over a window and its pixel in the middle.
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
  return {luma(mean[0], mean[1], mean[2], channels), luma(middle[0], middle[1], middle[2], channels), most, least};
}

template <int64_t SIZE, int64_t CHANNELS>
inline Brightness brightness_at(const uint8_t* at, const Windows& w) {
  int32_t sum[3];
  sums<SIZE>(at, w, sum);
  const auto told = [&](int64_t c) { return sum[c]; };
  return brightness_of<SIZE, CHANNELS>(told, at + w.size / 2 * (w.row + w.column), w);
}

// Whether windows of five pixels are asked around so many of an image's that all are found first, each from its neighbours':
// lookup.py, WHOLE.
inline bool most_are_asked(const Windows& w) { return w.size == 5 && 4 * w.n >= w.height * w.width; }

// Smallest and largest return around every pixel of a map, but for the outermost two.
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

// Sums of the bytes around every pixel of a picture, but for the outermost two, where the picture has those bytes.
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
    const auto told = [&](int64_t c) { return sum[centre + c * w.channel]; };
    return brightness_of<SIZE, CHANNELS>(told, picture + centre, w);
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

// Pictures of bytes, whose windows are usually of five pixels in three channels.
Windows of_picture(Windows w, const uint8_t* from) {
  w.end = from + w.batch * w.channels * w.height * w.width;
  return w;
}

inline bool usual(const Windows& w) { return w.size == 5 && w.channels == 3; }

// picture of bytes; found (4, B, N): mean grey of the window, and of the pixel in the middle grey, largest and smallest
// channel, all of them from 0 to 255.
void window_brightness(Tensor picture, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row,
                       int64_t column, int64_t channels, int64_t height, int64_t width, int64_t size) {
  const uint8_t* from = data<uint8_t>(picture);
  const Windows w = of_picture(windows(pixel, image, channel, row, column, channels, height, width, size), from);
  (usual(w) ? brightnesses<5, 3> : brightnesses<0, 0>)(from, w, data<float>(found));
}

// Grey values of a row of a window, and of what happens to lie beside it: of pixels that are interleaved as one division
// of whole numbers, else as of a picture's channels.
inline void grey_row(const uint8_t* at, const Windows& w, bool whole, float* __restrict to) {
  if (whole) {
    for (int64_t x = 0; x < w.size; ++x) {
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
  for (int64_t x = 0; x < w.size; ++x) {
    to[x] = luma(over<255>(red[x * w.column]), over<255>(green[x * w.column]), over<255>(blue[x * w.column]), w.channels);
  }
}

// The smaller eigenvalue of ((a, b), (b, c)), as dhtorch/geometry/linalg.py finds it.
inline float smaller(float a, float b, float c) {
  const float half = (a - c) / 2, middle = (a + c) / 2, square = half * half + b * b;
  return middle - (square > 0 ? std::sqrt(square) : square);
}

// Where gradient matrices of many windows are kept, so that their eigenvalues are found side by side.
struct Matrices {
  static constexpr int64_t ROOM = 64;
  float xx[ROOM], xy[ROOM], yy[ROOM];

  void keep(int64_t at, float of_xx, float of_xy, float of_yy) {
    xx[at] = of_xx;
    xy[at] = of_xy;
    yy[at] = of_yy;
  }
};

// Of the gradient matrix of a window, summed over its inner pixels. What happens to lie beside the window is computed and
// left out.
inline void gradients(const uint8_t* at, const Windows& w, bool whole, Matrices& into, int64_t k) {
  float grey[WIDE * ROOM] = {};  // beside a window as well, where what is no number would cost more
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

// Grey values of interleaved pixels are 255000 times as large here: whole numbers, exact however they are summed.
constexpr float UNIT = 255000.0f;

inline float grey_of(const uint8_t* at) { return static_cast<float>(299 * at[0] + 587 * at[1] + 114 * at[2]); }

// Every other byte.
inline Eight numbers(Bytes from) {
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
  return 299.0f * numbers(red) + 587.0f * numbers(green) + 114.0f * numbers(blue);
}

// A row of nine pixels, as what the Sobel filters make of it: differences and weighted sums of neighbours in the row, seven
// that count.
struct Row {
  Eight across, along;

  explicit Row(const uint8_t* at) {
    const Eight left = eight_greys(at), last = Eight{} + grey_of(at + 24);
    *this = {left, __builtin_shufflevector(left, last, 1, 2, 3, 4, 5, 6, 7, 8),
             __builtin_shufflevector(left, last, 2, 3, 4, 5, 6, 7, 8, 8)};
  }

  // What lies beside the nine is read with them.
  explicit Row(const float* at) : Row(eight(at), eight(at + 1), eight(at + 2)) {}

  Row(Eight left, Eight middle, Eight right) : across(right - left), along(left + middle + (middle + right)) {}
};

// Of nine rows of nine pixels, in registers from bytes or grey values on; gradients are exact.
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

// A whole interleaved picture, where its windows have more pixels than it has; else nothing.
std::unique_ptr<float[]> grey_picture(const uint8_t* at, const Windows& w) {
  const int64_t all = w.height * w.width;
  if (w.n * w.size * w.size < all) return {};
  std::unique_ptr<float[]> grey(new float[all + WIDE]);
  int64_t k = 0;
  for (; k + EIGHT <= all; k += EIGHT) {
    const Eight some = eight_greys(at + 3 * k);
    std::memcpy(&grey[k], &some, sizeof(some));
  }
  for (; k < all; ++k) grey[k] = grey_of(at + 3 * k);
  std::fill_n(&grey[all], WIDE, 0.0f);  // beside the last windows
  return grey;
}
#endif

// Read an image in the order in which it lies, which brings it near the processor several times as fast as its windows would
// come one by one; where so few rows of windows are asked that they take less, nothing.
template <typename T>
inline void bring_near(const T* from, int64_t count, const Windows& w) {
  const int64_t bytes = count * static_cast<int64_t>(sizeof(T));
  if (w.n * w.size * FAR * LINE < bytes) return;
  const volatile uint8_t* at = reinterpret_cast<const uint8_t*>(from);
  for (int64_t k = 0; k < bytes; k += LINE) (void)at[k];
}

// Calls `each` with every window and a place in `kept`, and writes the textures (B, N) of as many as that holds at once.
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

// Of one of the pictures that begin at `from`; see window_texture.
void textures_of(const uint8_t* from, const Windows& w, int64_t b, bool whole, float* to) {
  const uint8_t* picture = from + b * w.image;
#ifdef DHTORCH_SHUFFLES
  if (whole && w.size == 9) {
    const std::unique_ptr<float[]> grey = grey_picture(picture, w);
    if (!grey) bring_near(picture, w.image, w);
    textures(w, UNIT, to, [&](int64_t i, Matrices& kept, int64_t k) {
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
  bring_near(picture, w.image, w);
  textures(w, 1.0f, to, [&](int64_t i, Matrices& kept, int64_t k) { gradients(from + w.first(b, i), w, whole, kept, k); });
}

// picture of bytes; found (1, B, N): smaller eigenvalue of the mean gradient matrix, by the Sobel filters over all but the
// outermost pixels. Windows are at most WIDE pixels wide. With `whole` interleaved pixels become grey as whole numbers.
void window_texture(Tensor picture, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row, int64_t column,
                    int64_t channels, int64_t height, int64_t width, int64_t size, bool whole) {
  const uint8_t* from = data<uint8_t>(picture);
  const Windows w = of_picture(windows(pixel, image, channel, row, column, channels, height, width, size), from);
  for (int64_t b = 0; b < w.batch; ++b) textures_of(from, w, b, whole, data<float>(found) + b * w.n);
}

// Bits of dhtorch/codes.py, Flag.
constexpr int32_t NO_DEPTH = 1, LOW_CONF = 2, SPECULAR = 4, SATURATED = 8, UNDEREXPOSED = 16, DEPTH_EDGE = 32,
                  BEYOND_NEAR = 64, BORDER = 128;

// Whether a window around a pixel of a picture lies in it.
inline bool fits(const int32_t* at, int64_t height, int64_t width, int64_t size) {
  const int64_t before = size / 2, after = size - before;
  return at[0] >= before && at[0] <= width - after && at[1] >= before && at[1] <= height - after;
}

// The pixel that a place lies in, as dhtorch/geometry/patches.py, pixels, finds it: one outside of any picture where it is none.
inline int32_t pixel_of(float at) {
  const float whole = std::floor((std::isnan(at) ? -1.0f : at) + 0.5f);
  return whole >= -2147483648.0f && whole < 2147483648.0f ? static_cast<int32_t>(whole) : std::numeric_limits<int32_t>::min();
}

// Of places uv (B, N, 2) of pictures without distortion, with focal lengths f and centres c (B, 2): the pixels of picture and
// map (B, N, 2) and rays (B, N, 3). The map has focal lengths and centres of its own, or none (of no size), where its size
// over the picture's is (across, down).
void places(Tensor uv, Tensor f, Tensor c, Tensor map_f, Tensor map_c, Tensor pixel, Tensor at, Tensor ray, double across, double down) {
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

void pixels(Tensor uv, Tensor pixel) {
  const float* from = data<float>(uv);
  int32_t* to = data<int32_t>(pixel);
  const int64_t all = uv.numel();
  for (int64_t i = 0; i < all; ++i) to[i] = pixel_of(from[i]);
}

inline bool is_point(const float* x) { return std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2]); }

// The sensor's own answers: what is said of samples with a point, 0 elsewhere.
struct Sensed {
  float *depth, *sigma, *score;
  int32_t* source;

  bool take(int64_t i, const float* point, const float* z, const float* noise, const float* sure) const {
    const bool usable = is_point(point);
    depth[i] = usable ? z[i] : 0.0f;
    sigma[i] = usable ? noise[i] : 0.0f;
    score[i] = usable ? sure[i] : 0.0f;
    source[i] = usable;
    return usable;
  }
};

// What stage 2 takes for a return, and says of it.
struct Limits {
  float near, conf, fixed, relative, edge, dim, white, bright;

  Limits(double near_limit, double min_conf, double sigma_m, double sigma_rel, double edge_rel, double dark, double saturated,
         double highlight)
      : near(near_limit), conf(min_conf), fixed(sigma_m * sigma_m), relative(sigma_rel), edge(1.0 + edge_rel), dim(dark * 255),
        white(saturated * 255), bright(highlight * 255) {}
};

// What is read around a sample, and its ray.
struct Look {
  float z, level;
  Extremes around;
  Brightness seen;
  const float* ray;
  bool border;
};

// Where stage 2 writes what it says of samples: depth, sigma and confidence (B, N), xyz (B, N, 3), flags (B, N).
struct Said {
  float *depth, *sigma, *confidence, *xyz;
  int32_t* flag;

  void write(int64_t i, const Look& x, const Limits& limits) const {
    const bool returned = x.z > 0, beyond = x.z > limits.near, unsure = returned && x.level < limits.conf;
    const bool differs = returned && x.around.most > x.around.least * limits.edge, clipped = x.seen.mean >= limits.white;
    const bool shine = x.seen.most - x.seen.least <= 0.15f * x.seen.most && x.seen.centre >= limits.bright &&
                       x.seen.centre - x.seen.mean >= 25.5f;
    bool usable = returned && !unsure && !beyond;
    for (int64_t k = 0; k < 3; ++k) usable = usable && std::isfinite(x.ray[k] * x.z);
    for (int64_t k = 0; k < 3; ++k) xyz[3 * i + k] = usable ? x.ray[k] * x.z : std::numeric_limits<float>::quiet_NaN();
    float sure = std::clamp(x.level / 2, 0.0f, 1.0f);
    for (const bool doubt : {differs, shine, clipped}) sure = doubt ? sure / 2 : sure;
    const float noise = limits.relative * x.z;
    depth[i] = x.z;
    sigma[i] = limits.fixed > 0 ? std::sqrt(limits.fixed + noise * noise) : noise;
    confidence[i] = usable ? sure : 0.0f;
    flag[i] = !returned * NO_DEPTH | unsure * LOW_CONF | beyond * BEYOND_NEAR | differs * DEPTH_EDGE | x.border * BORDER |
              (x.seen.mean <= limits.dim) * UNDEREXPOSED | clipped * SATURATED | shine * SPECULAR;
  }
};

// What is read of a map of float32 or, as files hold it, of numbers of two bytes, `unit` to a metre.
template <typename Raw>
struct Returns {
  const Raw *map, *end;
  float unit;

  float over_unit(float read) const { return unit == 1.0f ? read : read / unit; }

  // Of the map's k-th number; what is no return is 0.
  float metres(int64_t k) const {
    const float read = map[k];
    return std::isfinite(read) && read > 0 ? over_unit(read) : 0.0f;
  }

  Extremes around(int64_t first, const Windows& w) const {
    const Extremes found = extremes_at(map + first, w, end);
    return {over_unit(found.least), over_unit(found.most)};
  }
};

template <int64_t SIZE, int64_t CHANNELS, typename Raw>
void say(const Returns<Raw>& map, const uint8_t* levels, const Windows& returns, const uint8_t* picture, const Windows& seen,
         const float* rays, const Said& said, const Limits& limits) {
  const int64_t h = returns.height, w = returns.width;
  constexpr bool in_metres = std::is_same_v<Raw, float>;
  const bool whole_map = in_metres && most_are_asked(returns), whole_picture = most_are_asked(seen);
  WholeMap returned;
  WholePicture shown;
  for (int64_t b = returns.batch; b-- > 0;) {  // the last picture was collated just now, the first one's textures are next
    const uint8_t* grey = picture + b * seen.image;
    if constexpr (in_metres) {
      if (whole_map) returned.find(map.map + b * h * w, returns);
    }
    if (!whole_map) bring_near(map.map + b * h * w, h * w, returns);
    whole_picture ? shown.find(grey, seen) : bring_near(grey, seen.image, seen);
    for (int64_t k = 0; k < returns.n; ++k) {
      const int64_t i = b * returns.n + k, first = returns.first(b, k), corner = seen.first(b, k) - b * seen.image;
      const int32_t* place = returns.pixel + 2 * i;
      const int64_t x = std::clamp<int64_t>(place[0], 0, w - 1), y = std::clamp<int64_t>(place[1], 0, h - 1);
      const int64_t there = (b * h + y) * w + x;
      said.write(i,
                 {fits(place, h, w, 1) ? map.metres(there) : 0.0f, levels ? levels[there] : 2.0f,
                  whole_map ? returned.at(first - b * h * w, returns) : map.around(first, returns),
                  whole_picture ? shown.at<SIZE, CHANNELS>(corner, grey, seen)
                                : brightness_at<SIZE, CHANNELS>(grey + corner, seen),
                  rays + 3 * i, !fits(seen.pixel + 2 * i, seen.height, seen.width, seen.size)},
                 limits);
    }
  }
}

// Stage 2: depth (B h w) and levels conf of its size (or of none) at pixels `at` (B, N, 2), returns around them as far as
// `reach`; a picture of bytes, as window_brightness takes it, at pixels (B, N, 2); rays (B, N, 3). Fills what it says.
void samples(Tensor depth, Tensor conf, Tensor at, Tensor picture, Tensor pixel, Tensor ray, Tensor found, Tensor sigma,
             Tensor confidence, Tensor xyz, Tensor flag, int64_t reach, int64_t image, int64_t channel, int64_t row,
             int64_t column, int64_t channels, int64_t height, int64_t width, int64_t size, double near, double least_conf,
             double sigma_m, double sigma_rel, double edge_rel, double dark, double saturated, double highlight) {
  const int64_t h = depth.size(1), w = depth.size(2);
  const float* map = data<float>(depth);
  const uint8_t *from = data<uint8_t>(picture), *levels = conf.numel() > 0 ? data<uint8_t>(conf) : nullptr;
  const Windows returns = windows(at, h * w, 0, w, 1, 1, h, w, reach);
  const Windows seen = of_picture(windows(pixel, image, channel, row, column, channels, height, width, size), from);
  const Said said = {data<float>(found), data<float>(sigma), data<float>(confidence), data<float>(xyz), data<int32_t>(flag)};
  const Limits limits(near, least_conf, sigma_m, sigma_rel, edge_rel, dark, saturated, highlight);
  const Returns<float> read = {map, map + depth.numel(), 1.0f};
  (usual(seen) ? say<5, 3, float> : say<0, 0, float>)(read, levels, returns, from, seen, data<float>(ray), said, limits);
}

// Stage 3 from what was read: of a hole the first class of dhtorch/codes.py, Hole, that holds.
void classes(const float* points, const int32_t* flags, const float* textures, float least, int32_t* kinds, int64_t all) {
  constexpr int32_t NONE = 0, TRACKABLE_NO_LIDAR = 1, LOW_TEXTURE = 2, TOO_BRIGHT = 3, TOO_DARK = 4, HIGHLIGHT = 5,
                    AT_BORDER = 6;
  for (int64_t i = 0; i < all; ++i) {
    const int32_t bits = flags[i];
    int32_t kind = textures[i] < least ? LOW_TEXTURE : TRACKABLE_NO_LIDAR;
    if (bits & SPECULAR) kind = HIGHLIGHT;
    if (bits & SATURATED) kind = TOO_BRIGHT;
    if (bits & UNDEREXPOSED) kind = TOO_DARK;
    if (bits & BORDER) kind = AT_BORDER;
    if (is_point(points + 3 * i)) kind = NONE;
    kinds[i] = kind;
  }
}

// xyz (B, N, 3), flag, trackability (B, N); hole (B, N), filled.
void holes(Tensor xyz, Tensor flag, Tensor trackability, Tensor hole, double min_trackability) {
  classes(data<float>(xyz), data<int32_t>(flag), data<float>(trackability), min_trackability, data<int32_t>(hole), hole.numel());
}

// Of every `step`-th number of a map how many are positive, and between both bounds.
template <typename Raw>
void count(const Returns<Raw>& map, int64_t step, float least, float most, int64_t* positive, int64_t* between) {
  int64_t some = 0, sound = 0;
  for (const Raw* at = map.map; at < map.end; at += step) {  // no branch that would wait for the number before
    const float z = map.over_unit(*at);
    some += z > 0;
    sound += (z > least) & (z < most);
  }
  *positive = some;
  *between = sound;
}

// depth (B h w); counts (2, B), filled: of every `step`-th number how many are positive, and between both bounds.
void probe(Tensor depth, Tensor counts, int64_t step, double low, double high) {
  const int64_t batch = depth.size(0), all = depth.size(1) * depth.size(2);
  int64_t* to = data<int64_t>(counts);
  for (int64_t b = 0; b < batch; ++b) {
    const float* map = data<float>(depth) + b * all;
    count<float>({map, map + all, 1.0f}, step, low, high, to + b, to + batch + b);
  }
}

// Stages 2 and 3 of one picture and its map as they were decoded, and what dhtorch/pipeline/pair.py, merge, makes of that: b is its row
// in what is filled, all of it (B, N) but xyz (B, N, 3) and what probe counts (2, B). A map of numbers of two bytes is one of
// int16, with a sign or without. Places as in `samples`, of one picture.
void look(Tensor map, Tensor at, Tensor picture, Tensor pixel, Tensor ray, Tensor depth, Tensor sigma, Tensor score, Tensor xyz,
          Tensor flag, Tensor hole, Tensor source, Tensor counts, int64_t b, double unit, bool sign, int64_t step, double low,
          double high, int64_t reach, int64_t image, int64_t channel, int64_t row, int64_t column, int64_t channels,
          int64_t height, int64_t width, int64_t size, double near, double least_conf, double sigma_m, double sigma_rel,
          double edge_rel, double dark, double saturated, double highlight, int64_t block, bool whole, double min_trackability) {
  const int64_t h = map.size(0), w = map.size(1), n = at.size(1), first = b * n;
  const uint8_t* from = data<uint8_t>(picture);
  const Windows returns = windows(at, h * w, 0, w, 1, 1, h, w, reach);
  const Windows seen = of_picture(windows(pixel, image, channel, row, column, channels, height, width, size), from);
  const Windows textured = of_picture(windows(pixel, image, channel, row, column, channels, height, width, block + 2), from);
  const Limits limits(near, least_conf, sigma_m, sigma_rel, edge_rel, dark, saturated, highlight);
  const Said said = {data<float>(depth) + first, data<float>(sigma) + first, data<float>(score) + first,
                     data<float>(xyz) + 3 * first, data<int32_t>(flag) + first};
  int64_t* counted = data<int64_t>(counts) + b;
  const auto read = [&]<typename Raw>(const Raw* begin) {
    const Returns<Raw> told = {begin, begin + h * w, static_cast<float>(unit)};
    (usual(seen) ? say<5, 3, Raw> : say<0, 0, Raw>)(told, nullptr, returns, from, seen, data<float>(ray), said, limits);
    count(told, step, low, high, counted, counted + counts.size(1));
  };
  if (map.scalar_type() == torch::headeronly::ScalarType::Float) {
    read(data<float>(map));
  } else {
    sign ? read(data<int16_t>(map)) : read(data<uint16_t>(map));
  }
  std::vector<float> textures(n);
  textures_of(from, textured, 0, whole, textures.data());
  classes(said.xyz, said.flag, textures.data(), min_trackability, data<int32_t>(hole) + first, n);
  const Sensed sensed = {said.depth, said.sigma, said.confidence, data<int32_t>(source) + first};
  for (int64_t i = 0; i < n; ++i) {
    if (sensed.take(i, said.xyz + 3 * i, said.depth, said.sigma, said.confidence)) continue;
    std::fill_n(said.xyz + 3 * i, 3, 0.0f);
  }
}

// Samples as stage 2 says them: depth, sigma, confidence (B, N), xyz (B, N, 3). Fills z, noise, score and source (B, N) of those
// with a point, 0 elsewhere.
void sensed(Tensor depth, Tensor sigma, Tensor confidence, Tensor xyz, Tensor z, Tensor noise, Tensor score, Tensor source) {
  const Sensed to = {data<float>(z), data<float>(noise), data<float>(score), data<int32_t>(source)};
  const float* points = data<float>(xyz);
  for (int64_t i = 0; i < depth.numel(); ++i) {
    to.take(i, points + 3 * i, data<float>(depth), data<float>(sigma), data<float>(confidence));
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
      "places(Tensor uv, Tensor f, Tensor c, Tensor map_f, Tensor map_c, Tensor(a!) pixel, Tensor(b!) at, Tensor(c!) ray, "
      "float across, float down) -> ()");
  m.def("pixels(Tensor uv, Tensor(a!) pixel) -> ()");
  m.def(
      "samples(Tensor depth, Tensor conf, Tensor at, Tensor picture, Tensor pixel, Tensor ray, Tensor(a!) found, "
      "Tensor(b!) sigma, Tensor(c!) confidence, Tensor(d!) xyz, Tensor(e!) flag, int reach, int image, int channel, int row, "
      "int column, int channels, int height, int width, int size, float near_limit, float min_conf, float sigma_m, "
      "float sigma_rel, float edge_rel, float dark, float saturated, float highlight) -> ()");
  m.def("holes(Tensor xyz, Tensor flag, Tensor trackability, Tensor(a!) hole, float min_trackability) -> ()");
  m.def("probe(Tensor depth, Tensor(a!) counts, int step, float low, float high) -> ()");
  m.def(
      "sensed(Tensor depth, Tensor sigma, Tensor confidence, Tensor xyz, Tensor(a!) z, Tensor(b!) noise, Tensor(c!) score, "
      "Tensor(d!) source) -> ()");
  m.def(
      "look(Tensor map, Tensor at, Tensor picture, Tensor pixel, Tensor ray, Tensor(a!) depth, Tensor(b!) sigma, Tensor(c!) score, "
      "Tensor(d!) xyz, Tensor(e!) flag, Tensor(f!) hole, Tensor(g!) source, Tensor(h!) counts, int b, float unit, bool sign, int step, "
      "float low, float high, int reach, int image, int channel, int row, int column, int channels, int height, int width, int size, "
      "float near_limit, float min_conf, float sigma_m, float sigma_rel, float edge_rel, float dark, float saturated, "
      "float highlight, int block, bool whole, float min_trackability) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("window_extremes", TORCH_BOX(&window_extremes));
  m.impl("window_brightness", TORCH_BOX(&window_brightness));
  m.impl("window_texture", TORCH_BOX(&window_texture));
  m.impl("places", TORCH_BOX(&places));
  m.impl("pixels", TORCH_BOX(&pixels));
  m.impl("samples", TORCH_BOX(&samples));
  m.impl("holes", TORCH_BOX(&holes));
  m.impl("probe", TORCH_BOX(&probe));
  m.impl("sensed", TORCH_BOX(&sensed));
  m.impl("look", TORCH_BOX(&look));
}
