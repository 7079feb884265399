// Depth maps of 16-bit integers to metres, and pooling of samples to depth tokens. References:
// dhtorch/transforms/sample_spec.py and tokens.py; equal bit for bit, sums in double precision in the same order. One
// thread, no gradient. The dispatch checks dtypes and strides, Python the shapes.

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "vectors.h"

namespace {

// Sums over the samples of a patch: all, those with a depth, inverse depth and its variance.
struct Patch {
  double count = 0, answered = 0, inverse = 0, variance = 0;
};

inline double per(double count) { return 1.0 / (count < 1.0 ? 1.0 : count); }

// uv (B, N, 2), depth, sigma (B, N) float32, source, hole (B, N) int32. Outputs: tokens (B, P, 3 + classes) float32 and
// known (B, P) bool. A sample at uv lies at (uv + ½) · scale + margin in the network's image of `rows` × `columns` patches.
void patch_tokens(Tensor uv, Tensor depth, Tensor sigma, Tensor source, Tensor hole, Tensor tokens, Tensor known, int64_t patch,
                  int64_t rows, int64_t columns, double scale_x, double scale_y, double margin_x, double margin_y) {
  const int64_t B = depth.size(0), N = depth.size(1), P = rows * columns, channels = tokens.size(2), classes = channels - 3;
  const double side = static_cast<double>(patch);
  std::vector<Patch> patches(P);
  std::vector<double> holes(P * classes), inverse(N);
  std::vector<int64_t> cell(N);
  for (int64_t b = 0; b < B; ++b) {
    const float *place = data<float>(uv) + 2 * b * N, *z = data<float>(depth) + b * N, *noise = data<float>(sigma) + b * N;
    const int32_t *from = data<int32_t>(source) + b * N, *kind = data<int32_t>(hole) + b * N;
    const auto answered = [&](int64_t i) { return from[i] != SOURCE_NONE && z[i] > 0.0f; };
    patches.assign(P, Patch());
    holes.assign(P * classes, 0.0);
    for (int64_t i = 0; i < N; ++i) {
      const double column = std::floor(((place[2 * i] + 0.5) * scale_x + margin_x) / side);
      const double row = std::floor(((place[2 * i + 1] + 0.5) * scale_y + margin_y) / side);
      const bool inside = column >= 0 && column < columns && row >= 0 && row < rows;
      cell[i] = inside ? static_cast<int64_t>(row) * columns + static_cast<int64_t>(column) : -1;
      inverse[i] = answered(i) ? 1.0 / static_cast<double>(z[i]) : 0.0;
      if (!inside) continue;
      Patch& own = patches[cell[i]];
      own.count += 1.0;
      own.answered += answered(i);
      own.inverse += inverse[i];
      if (kind[i] >= 0 && kind[i] < classes) holes[cell[i] * classes + kind[i]] += 1.0;
    }
    for (int64_t i = 0; i < N; ++i) {
      if (cell[i] < 0 || !answered(i)) continue;
      Patch& own = patches[cell[i]];
      const double spread = inverse[i] - own.inverse * per(own.answered), own_noise = noise[i] * inverse[i] * inverse[i];
      own.variance += own_noise * own_noise + spread * spread;
    }
    for (int64_t p = 0; p < P; ++p) {
      const Patch& own = patches[p];
      const double share = per(own.count), variance = own.variance * per(own.answered);
      float* to = data<float>(tokens) + (b * P + p) * channels;
      to[0] = static_cast<float>(own.inverse * per(own.answered));
      to[1] = variance > 0 ? static_cast<float>(std::sqrt(variance)) : 0.0f;
      to[2] = static_cast<float>(own.answered * share);
      for (int64_t k = 0; k < classes; ++k) to[3 + k] = static_cast<float>(holes[p * classes + k] * share);
      data<bool>(known)[b * P + p] = own.answered > 0;
    }
  }
}

// Depth code as a number, 0 where it means no return: not positive, or 65535, the unsigned code that wraps to 0.
float depth_code(int16_t raw) { return std::max(static_cast<float>(raw), 0.0f); }
float depth_code(uint16_t raw) { return std::max(static_cast<float>(static_cast<uint16_t>(raw + 1)) - 1.0f, 0.0f); }

template <typename Word>
void over_unit(const Word* raw, float* __restrict z, int64_t n, float unit) {
  if (unit == 1000.0f) {
    for (int64_t k = 0; k < n; ++k) z[k] = over<1000>(depth_code(raw[k]));
  } else {
    for (int64_t k = 0; k < n; ++k) z[k] = depth_code(raw[k]) / unit;
  }
}

// raw: int16, or with `sign` false uint16 of the same bits. Output: z float32, raw / unit, 0 where that means no return.
void write_metres(Tensor raw, Tensor z, double unit, bool sign) {
  const float per_metre = unit;
  if (sign) {
    over_unit(data<int16_t>(raw), data<float>(z), z.numel(), per_metre);
  } else {
    over_unit(data<uint16_t>(raw), data<float>(z), z.numel(), per_metre);
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def("write_metres(Tensor raw, Tensor(a!) z, float unit, bool sign) -> ()");
  m.def(
      "patch_tokens(Tensor uv, Tensor depth, Tensor sigma, Tensor source, Tensor hole, Tensor(a!) tokens, Tensor(b!) known, int "
      "patch, int rows, int columns, float scale_x, float scale_y, float margin_x, float margin_y) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("write_metres", TORCH_BOX(&write_metres));
  m.impl("patch_tokens", TORCH_BOX(&patch_tokens));
}
