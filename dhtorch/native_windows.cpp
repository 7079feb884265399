// A few numbers about the window around each sample: extremes of depth, brightness, texture; and what stages 2 and 3 make of
// them. Twin of dhtorch/geometry/lookup.py, stages/backproject.py and stages/holes.py, which are the reference: whole numbers are exact, textures up to
// the rounding of their sums. One thread, no gradient. Callers check shapes, types and strides.

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "native_vectors.h"

namespace {

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

inline void extend(float read, float& least, float& most) {
  const float z = std::isfinite(read) ? read : 0.0f;
  least = z > 0 ? std::min(least, z) : least;
  most = std::max(most, z);
}

constexpr int64_t EIGHT = 8;
typedef float Eight __attribute__((vector_size(EIGHT * sizeof(float))));

// Of five rows of five returns, which are read with the three beside them.
inline void five_extremes(const float* at, int64_t row, float& least, float& most) {
  const Eight none = {};
  Eight low = none + std::numeric_limits<float>::infinity(), high = none;
  for (int64_t y = 0; y < 5; ++y) {
    Eight read;
    std::memcpy(&read, at + y * row, sizeof(read));
    const Eight z = (read > none) & (read < std::numeric_limits<float>::infinity() + none) ? read : none;
    low = (z > none) & (z < low) ? z : low;
    high = z > high ? z : high;
  }
  for (int64_t x = 0; x < 5; ++x) {
    least = std::min(least, low[x]);
    most = std::max(most, high[x]);
  }
}

// depth (B h w) float32; found (2, B, N): the smallest and the largest return, infinity and 0 where there is none.
void window_extremes(Tensor depth, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row, int64_t column,
                     int64_t channels, int64_t height, int64_t width, int64_t size) {
  const Windows w = windows(pixel, image, channel, row, column, channels, height, width, size);
  const float *from = data<float>(depth), *end = from + w.batch * height * width;
  const int64_t all = w.batch * w.n;
  float *low = data<float>(found), *high = low + all;
  for (int64_t b = 0, i = 0; b < w.batch; ++b) {
    for (int64_t k = 0; k < w.n; ++k, ++i) {
      const float* at = from + w.first(b, k);
      float least = std::numeric_limits<float>::infinity(), most = -least;
      if (size == 5 && column == 1 && at + 4 * row + EIGHT <= end) {
        five_extremes(at, row, least, most);
      } else {
        for (int64_t y = 0; y < size; ++y) {
          for (int64_t x = 0; x < size; ++x) extend(at[y * row + x * column], least, most);
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
inline void sums(const uint8_t* at, const Windows& w, int32_t* sum) {
  const int64_t size = SIZE ? SIZE : w.size;
  std::fill_n(sum, w.channels, 0);
  if (SIZE == 5 && w.column == 3 && at + 4 * w.row + WIDE <= w.end) {
    uint16_t all[WIDE] = {};  // of five rows of five pixels, and of the byte beside them
    for (int64_t y = 0; y < 5; ++y) {
      for (int64_t x = 0; x < WIDE; ++x) all[x] += at[y * w.row + x];
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

template <int64_t SIZE, int64_t CHANNELS>
void brightnesses(const uint8_t* from, const Windows& w, float* to) {
  const int64_t channels = CHANNELS ? CHANNELS : w.channels, all = w.batch * w.n, centre = w.size / 2 * (w.row + w.column);
  const float count = static_cast<float>(w.size * w.size);
  for (int64_t b = 0, i = 0; b < w.batch; ++b) {
    for (int64_t k = 0; k < w.n; ++k, ++i) {
      const uint8_t* at = from + w.first(b, k);
      int32_t sum[3];
      sums<SIZE>(at, w, sum);
      float mean[3] = {}, middle[3] = {};
      for (int64_t c = 0; c < channels; ++c) {
        mean[c] = static_cast<float>(sum[c]) / count;
        middle[c] = static_cast<float>(at[centre + c * w.channel]);
      }
      float most = middle[0], least = middle[0];
      for (int64_t c = 1; c < channels; ++c) {
        most = std::max(most, middle[c]);
        least = std::min(least, middle[c]);
      }
      to[i] = luma(mean[0], mean[1], mean[2], channels);
      to[all + i] = luma(middle[0], middle[1], middle[2], channels);
      to[2 * all + i] = most;
      to[3 * all + i] = least;
    }
  }
}

// picture of bytes; found (4, B, N): mean grey of the window, and of the pixel in the middle grey, largest and smallest
// channel, all of them from 0 to 255.
void window_brightness(Tensor picture, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row,
                       int64_t column, int64_t channels, int64_t height, int64_t width, int64_t size) {
  Windows w = windows(pixel, image, channel, row, column, channels, height, width, size);
  const uint8_t* from = data<uint8_t>(picture);
  w.end = from + w.batch * channels * height * width;
  (size == 5 && channels == 3 ? brightnesses<5, 3> : brightnesses<0, 0>)(from, w, data<float>(found));
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

// Where rows of grey values lie, and how far apart.
struct Rows {
  const float* first;
  int64_t step;
};

// The smaller eigenvalue of ((a, b), (b, c)), as dhtorch/geometry/small.py finds it.
inline float smaller(float a, float b, float c) {
  const float half = (a - c) / 2, middle = (a + c) / 2, square = half * half + b * b;
  return middle - (square > 0 ? std::sqrt(square) : square);
}

// Of the gradient matrix summed over a window's inner pixels: columns side by side, each over all rows. What happens to lie
// beside the window is computed and left out.
template <int64_t SIZE>
inline float least_texture(const Rows& grey, int64_t size) {
  constexpr int64_t SIDE = SIZE == 9 ? 8 : WIDE;
  const int64_t inner = (SIZE ? SIZE : size) - 2;
  float xx[SIDE] = {}, xy[SIDE] = {}, yy[SIDE] = {};
  for (int64_t y = 0; y < inner; ++y) {
    const float *a = grey.first + y * grey.step, *b = a + grey.step, *c = b + grey.step;
    for (int64_t x = 0; x < SIDE; ++x) {
      const float g_x = fused(b[x + 2] - b[x], 2.0f, (a[x + 2] - a[x]) + (c[x + 2] - c[x]));
      const float g_y = fused(c[x + 1] - a[x + 1], 2.0f, (c[x] - a[x]) + (c[x + 2] - a[x + 2]));
      xx[x] += g_x * g_x;
      xy[x] += g_x * g_y;
      yy[x] += g_y * g_y;
    }
  }
  float each[3] = {};
  for (int64_t x = 0; x < inner; ++x) {
    each[0] += xx[x];
    each[1] += xy[x];
    each[2] += yy[x];
  }
  return smaller(each[0], each[1], each[2]);
}

// Of a window whose pixels are read for it alone.
template <int64_t SIZE>
inline float read_texture(const uint8_t* at, const Windows& w, bool whole) {
  float grey[WIDE * ROOM] = {};  // beside a window as well, where what is no number would cost more
  for (int64_t y = 0; y < (SIZE ? SIZE : w.size); ++y) grey_row<SIZE>(at + y * w.row, w, whole, grey + y * ROOM);
  return least_texture<SIZE>({grey, ROOM}, w.size);
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

template <int64_t SIZE>
void textures(const uint8_t* from, const Windows& w, bool whole, float* to) {
  std::vector<float> grey;
  const float count = 16.0f * (w.size - 2) * (w.size - 2);
  for (int64_t b = 0; b < w.batch; ++b) {
    const bool once = grey_picture(from + b * w.image, w, whole, grey);
    for (int64_t k = 0; k < w.n; ++k) {
      const int64_t first = w.first(b, k), pixel = (first - b * w.image) / 3;
      const float least = once ? least_texture<SIZE>({grey.data() + pixel, w.width}, w.size)
                               : read_texture<SIZE>(from + first, w, whole);
      *to++ = least / count;
    }
  }
}

// picture of bytes; found (1, B, N): smaller eigenvalue of the mean gradient matrix, by the Sobel filters over all but the
// outermost pixels. Windows are at most WIDE pixels wide. With `whole` interleaved pixels become grey as whole numbers.
void window_texture(Tensor picture, Tensor pixel, Tensor found, int64_t image, int64_t channel, int64_t row, int64_t column,
                    int64_t channels, int64_t height, int64_t width, int64_t size, bool whole) {
  Windows w = windows(pixel, image, channel, row, column, channels, height, width, size);
  const uint8_t* from = data<uint8_t>(picture);
  w.end = from + w.batch * channels * height * width;
  (size == 9 ? textures<9> : textures<0>)(from, w, whole, data<float>(found));
}

// Bits of dhtorch/codes.py, Flag.
constexpr int32_t NO_DEPTH = 1, LOW_CONF = 2, SPECULAR = 4, SATURATED = 8, UNDEREXPOSED = 16, DEPTH_EDGE = 32,
                  BEYOND_NEAR = 64, BORDER = 128;

// Whether a window around a pixel of a picture lies in it.
inline bool fits(const int32_t* at, int64_t height, int64_t width, int64_t size) {
  const int64_t before = size / 2, after = size - before;
  return at[0] >= before && at[0] <= width - after && at[1] >= before && at[1] <= height - after;
}

// The pixel that a place lies in, as dhtorch/geometry/lookup.py, pixels, finds it: one outside of any picture where it is none.
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
  for (int64_t i = 0; i < batch * n; ++i) {
    for (int64_t k = 0; k < 2; ++k) {
      const float x = from[2 * i + k];
      const int64_t of = 2 * (i / n) + k;
      pixels[2 * i + k] = pixel_of(x);
      const float scaled = same ? x : (x + 0.5f) * scale[k] - 0.5f;
      map[2 * i + k] = pixel_of(own ? (x - centre[of]) / focal[of] * own_focal[of] + own_centre[of] : scaled);
      rays[3 * i + k] = ((std::isfinite(x) ? x : 0.0f) - centre[of]) / focal[of];
    }
    rays[3 * i + 2] = 1.0f;
  }
}

void pixels(Tensor uv, Tensor pixel) {
  const float* from = data<float>(uv);
  int32_t* to = data<int32_t>(pixel);
  const int64_t all = uv.numel();
  for (int64_t i = 0; i < all; ++i) to[i] = pixel_of(from[i]);
}

// Stage 2 from what was read: depth (B h w) and levels conf of its size (or of none) at pixels `at` (B, N, 2), extremes of
// the depth around them, and of the picture (height, width) around pixels (B, N, 2) what window_brightness finds; rays
// (B, N, 3). Fills depth, sigma and confidence (B, N), xyz (B, N, 3), flags (B, N).
void samples(Tensor depth, Tensor conf, Tensor at, Tensor low, Tensor high, Tensor pixel, Tensor mean, Tensor centre,
             Tensor top, Tensor bottom, Tensor ray, Tensor found, Tensor sigma, Tensor confidence, Tensor xyz, Tensor flag,
             int64_t height, int64_t width, int64_t size, double near, double least_conf, double sigma_m, double sigma_rel,
             double edge_rel, double dark, double saturated, double highlight) {
  const int64_t batch = at.size(0), n = at.size(1), h = depth.size(1), w = depth.size(2);
  const float *map = data<float>(depth), *lowest = data<float>(low), *highest = data<float>(high), *rays = data<float>(ray);
  const float *means = data<float>(mean), *centres = data<float>(centre), *tops = data<float>(top), *bottoms = data<float>(bottom);
  const int32_t *places = data<int32_t>(at), *pixels = data<int32_t>(pixel);
  const uint8_t* levels = conf.numel() > 0 ? data<uint8_t>(conf) : nullptr;
  float *z_of = data<float>(found), *sigmas = data<float>(sigma), *sures = data<float>(confidence), *points = data<float>(xyz);
  int32_t* flags = data<int32_t>(flag);
  const float beyond_near = near, least = least_conf, relative = sigma_rel, fixed = sigma_m * sigma_m, edge = 1.0 + edge_rel;
  const float dim = dark * 255, white = saturated * 255, bright = highlight * 255;
  for (int64_t i = 0; i < batch * n; ++i) {
    const int32_t* place = places + 2 * i;
    float z = 0.0f, level = 2.0f;
    const int64_t column = std::clamp<int64_t>(place[0], 0, w - 1), row = std::clamp<int64_t>(place[1], 0, h - 1);
    const int64_t index = (i / n * h + row) * w + column;
    if (fits(place, h, w, 1)) {
      const float read = map[index];
      z = std::isfinite(read) && read > 0 ? read : 0.0f;
    }
    if (levels) level = levels[index];
    const float grey = means[i], middle = centres[i], most = tops[i];
    const bool returned = z > 0, beyond = z > beyond_near, unsure = returned && level < least;
    const bool differs = returned && highest[i] > lowest[i] * edge, clipped = grey >= white;
    const bool shine = most - bottoms[i] <= 0.15f * most && middle >= bright && middle - grey >= 25.5f;
    bool usable = returned && !unsure && !beyond;
    for (int64_t k = 0; k < 3; ++k) usable = usable && std::isfinite(rays[3 * i + k] * z);
    for (int64_t k = 0; k < 3; ++k) {
      points[3 * i + k] = usable ? rays[3 * i + k] * z : std::numeric_limits<float>::quiet_NaN();
    }
    float sure = std::clamp(level / 2, 0.0f, 1.0f);
    for (const bool doubt : {differs, shine, clipped}) sure = doubt ? sure / 2 : sure;
    z_of[i] = z;
    const float noise = relative * z;
    sigmas[i] = sigma_m > 0 ? std::sqrt(fixed + noise * noise) : noise;
    sures[i] = usable ? sure : 0.0f;
    flags[i] = !returned * NO_DEPTH | unsure * LOW_CONF | beyond * BEYOND_NEAR | differs * DEPTH_EDGE |
                             !fits(pixels + 2 * i, height, width, size) * BORDER | (grey <= dim) * UNDEREXPOSED |
                             clipped * SATURATED | shine * SPECULAR;
  }
}

// Stage 3 from what was read: of a hole (B, N) the first class of dhtorch/codes.py, Hole, that holds.
void holes(Tensor xyz, Tensor flag, Tensor trackability, Tensor hole, double min_trackability) {
  constexpr int32_t NONE = 0, TRACKABLE_NO_LIDAR = 1, LOW_TEXTURE = 2, TOO_BRIGHT = 3, TOO_DARK = 4, HIGHLIGHT = 5,
                    AT_BORDER = 6;
  const float *points = data<float>(xyz), *textures = data<float>(trackability), least = min_trackability;
  const int32_t* flags = data<int32_t>(flag);
  int32_t* kinds = data<int32_t>(hole);
  const int64_t all = hole.numel();
  for (int64_t i = 0; i < all; ++i) {
    const float* x = points + 3 * i;
    const int32_t bits = flags[i];
    int32_t kind = textures[i] < least ? LOW_TEXTURE : TRACKABLE_NO_LIDAR;
    if (bits & SPECULAR) kind = HIGHLIGHT;
    if (bits & SATURATED) kind = TOO_BRIGHT;
    if (bits & UNDEREXPOSED) kind = TOO_DARK;
    if (bits & BORDER) kind = AT_BORDER;
    if (std::isfinite(x[0]) && std::isfinite(x[1]) && std::isfinite(x[2])) kind = NONE;
    kinds[i] = kind;
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
      "samples(Tensor depth, Tensor conf, Tensor at, Tensor low, Tensor high, Tensor pixel, Tensor mean, Tensor centre, "
      "Tensor top, Tensor bottom, Tensor ray, Tensor(a!) found, Tensor(b!) sigma, Tensor(c!) confidence, Tensor(d!) xyz, "
      "Tensor(e!) flag, int height, int width, int size, float near_limit, float min_conf, float sigma_m, float sigma_rel, "
      "float edge_rel, float dark, float saturated, float highlight) -> ()");
  m.def("holes(Tensor xyz, Tensor flag, Tensor trackability, Tensor(a!) hole, float min_trackability) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("window_extremes", TORCH_BOX(&window_extremes));
  m.impl("window_brightness", TORCH_BOX(&window_brightness));
  m.impl("window_texture", TORCH_BOX(&window_texture));
  m.impl("places", TORCH_BOX(&places));
  m.impl("pixels", TORCH_BOX(&pixels));
  m.impl("samples", TORCH_BOX(&samples));
  m.impl("holes", TORCH_BOX(&holes));
}
