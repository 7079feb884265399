// One level of an image pyramid from an image or from the level below: grey value, mirrored border, Scharr gradients.
// Reference: dhtorch/geometry/pyramid.py. Products and sums are taken in the same order, with FMA where torch uses it, so
// that values agree up to rounding. One thread, no gradient. The dispatch checks dtypes and strides, Python the shapes.

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <vector>

#include "vectors.h"

namespace {

inline float binomial(float a, float b, float c, float d, float e) {
  return fused(6.0f, c, fused(4.0f, b + d, a + e)) * (1.0f / 16.0f);
}

// One image of a padded level (B, planes, rows, width).
struct Padded {
  float* first;
  int64_t rows, width, pad;

  Padded(const Tensor& level, int64_t pad, int64_t b)
      : first(data<float>(level) + b * level.size(1) * level.size(2) * level.size(3)), rows(level.size(2)), width(level.size(3)),
        pad(pad) {}

  float* row(int64_t plane, int64_t y) const { return first + (plane * rows + y) * width; }
  int64_t height() const { return rows - 2 * pad; }
  int64_t across() const { return width - 2 * pad; }
};

inline float unit(float x) { return x; }
inline float unit(uint8_t x) { return static_cast<float>(x) / 255.0f; }

template <typename T>
void grey(const T* picture, int64_t channels, const Padded& level, int64_t y) {
  const int64_t h = level.height(), w = level.across();
  const T* r = picture + y * w;
  float* __restrict to = level.row(0, level.pad + y) + level.pad;
  if (channels == 1) {
    for (int64_t x = 0; x < w; ++x) to[x] = unit(r[x]);
    return;
  }
  const T *g = r + h * w, *b = g + h * w;
  for (int64_t x = 0; x < w; ++x) to[x] = luma(unit(r[x]), unit(g[x]), unit(b[x]));
}

void half(const Padded& below, const Padded& level, int64_t y, std::vector<float>& smooth) {
  const int64_t w = level.across(), wide = 2 * w + 3;
  smooth.resize(wide);
  const float* from[5];
  for (int64_t k = 0; k < 5; ++k) from[k] = below.row(0, below.pad + 2 * y + k - 2) + below.pad - 2;
  float* __restrict s = smooth.data();
  for (int64_t x = 0; x < wide; ++x) s[x] = binomial(from[0][x], from[1][x], from[2][x], from[3][x], from[4][x]);
  float* __restrict to = level.row(0, level.pad + y) + level.pad;
  for (int64_t x = 0; x < w; ++x) to[x] = binomial(s[2 * x], s[2 * x + 1], s[2 * x + 2], s[2 * x + 3], s[2 * x + 4]);
}

void mirror_sides(const Padded& level, int64_t y) {
  const int64_t pad = level.pad;
  float *left = level.row(0, pad + y) + pad, *right = level.row(0, pad + y) + level.width - pad - 1;
  for (int64_t k = 1; k <= pad; ++k) {
    left[-k] = left[k];
    right[k] = right[-k];
  }
}

void mirror_ends(const Padded& level) {
  const int64_t pad = level.pad, bottom = level.rows - pad - 1;
  for (int64_t k = 1; k <= pad; ++k) {
    std::copy_n(level.row(0, pad + k), level.width, level.row(0, pad - k));
    std::copy_n(level.row(0, bottom - k), level.width, level.row(0, bottom + k));
  }
}

// Gradients of a row whose neighbours have their sides mirrored; above the first and below the last row is the mirror.
void gradients(const Padded& level, int64_t y, std::vector<float>& both) {
  const int64_t pad = level.pad, w = level.across(), wide = w + 2, last = level.height() - 1;
  both.resize(2 * wide);
  const auto row = [&](int64_t k) { return level.row(0, pad + k) + pad - 1; };
  const float *above = row(y ? y - 1 : 1), *here = row(y), *under = row(y < last ? y + 1 : last - 1);
  float *__restrict across = both.data(), *__restrict slope = both.data() + wide;
  for (int64_t x = 0; x < wide; ++x) {
    across[x] = fused(3.0f / 32.0f, above[x] + under[x], here[x] * (10.0f / 32.0f));
    slope[x] = under[x] - above[x];
  }
  float *__restrict g_x = level.row(1, pad + y), *__restrict g_y = level.row(2, pad + y);
  for (float* border : {g_x, g_y, g_x + pad + w, g_y + pad + w}) std::fill_n(border, pad, 0.0f);
  for (int64_t x = 0; x < w; ++x) {
    g_x[pad + x] = across[x + 2] - across[x];
    g_y[pad + x] = fused(3.0f / 32.0f, slope[x] + slope[x + 2], slope[x + 1] * (10.0f / 32.0f));
  }
}

// source: images (B, 1 or 3, h, w), float32 or uint8 (`bytes`), or with `halve` the level below (B, 1 or 3, ., .),
// float32. Output: level (B, 1 or 3, h + 2 pad, w + 2 pad) float32.
void pyramid_level(Tensor source, Tensor level, int64_t pad, bool halve, bool bytes) {
  std::vector<float> smooth, both;
  const int64_t channels = source.size(1), one = channels * source.size(2) * source.size(3);
  for (int64_t b = 0; b < level.size(0); ++b) {
    const Padded own(level, pad, b);
    const int64_t h = own.height(), planes = level.size(1);
    for (int64_t y = 0; y < h; ++y) {
      if (halve) {
        half(Padded(source, pad, b), own, y, smooth);
      } else if (bytes) {
        grey(data<uint8_t>(source) + b * one, channels, own, y);
      } else {
        grey(data<float>(source) + b * one, channels, own, y);
      }
      mirror_sides(own, y);
      if (planes == 3 && y) gradients(own, y - 1, both);  // while its rows are in the cache
    }
    mirror_ends(own);
    if (planes < 3) continue;
    gradients(own, h - 1, both);
    for (int64_t plane = 1; plane < 3; ++plane) {
      std::fill(own.row(plane, 0), own.row(plane, pad), 0.0f);
      std::fill(own.row(plane, own.rows - pad), own.row(plane, own.rows), 0.0f);
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def("pyramid_level(Tensor source, Tensor(a!) level, int pad, bool halve, bool bytes) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) { m.impl("pyramid_level", TORCH_BOX(&pyramid_level)); }
