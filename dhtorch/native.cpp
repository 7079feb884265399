// The whole-number part of a plane sweep as three operators on torch's stable ABI: what dhtorch/geometry/sweep.py does
// in torch, and bit for bit the same (-ffp-contract=off: no product is fused with a sum). One thread. Callers check
// shapes, types and that everything is contiguous; see dhtorch/native.py.

#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

using torch::stable::Tensor;

namespace {

constexpr int16_t NOWHERE = std::numeric_limits<int16_t>::max() / 2;

template <typename T>
T* data(const Tensor& x) {
  return static_cast<T*>(x.data_ptr());
}

inline int32_t bits(int32_t code) {  // of the lower 31, as count_bits: vectors have no such instruction everywhere
  uint32_t x = static_cast<uint32_t>(code);
  x = x - ((x >> 1) & 0x55555555u);
  x = (x & 0x33333333u) + ((x >> 2) & 0x33333333u);
  x = (x + (x >> 4)) & 0x0F0F0F0Fu;
  return static_cast<int32_t>((x * 0x01010101u) >> 24);
}

// Add to C (B, h, w, D) uint8 how badly each pixel fits at every plane. code_0 (B, N) and code_1 (B, rows * columns)
// int32; a (B, 2, N), b (B, 2), c (B) and q (B, D) float32: pixels are seen at (a + q b) / (1 + q c), margin further in.
void add_costs(Tensor C, Tensor code_0, Tensor code_1, Tensor a, Tensor b, Tensor c, Tensor q, int64_t rows,
               int64_t columns, int64_t margin, int64_t unseen) {
  const int64_t B = q.size(0), D = q.size(1), N = code_0.size(1), M = code_1.size(1);
  const float inside = static_cast<float>(margin + 0.5), right = static_cast<float>(columns - 1),
              down = static_cast<float>(rows - 1);
  const int32_t width = static_cast<int32_t>(columns), none = static_cast<int32_t>(unseen);
  std::vector<float> scale(D), along(D), across(D);
  std::vector<int32_t> cell(D);
  for (int64_t k = 0; k < B; ++k) {
    const float *bk = data<float>(b) + 2 * k, *qk = data<float>(q) + D * k, *ak = data<float>(a) + 2 * N * k;
    for (int64_t d = 0; d < D; ++d) {
      const float z = 1.0f + qk[d] * data<float>(c)[k];
      scale[d] = z > 1e-3f ? 1.0f / z : 1e9f;
      along[d] = qk[d] * bk[0];
      across[d] = qk[d] * bk[1];
    }
    const int32_t *here = data<int32_t>(code_0) + N * k, *there = data<int32_t>(code_1) + M * k;
    uint8_t* cost = data<uint8_t>(C) + N * D * k;
    const float *s = scale.data(), *u_step = along.data(), *v_step = across.data();
    int32_t* at = cell.data();
    for (int64_t n = 0; n < N; ++n, cost += D) {
      const float u0 = ak[n], v0 = ak[N + n];
      const int32_t own = here[n];
#pragma GCC ivdep
      for (int64_t d = 0; d < D; ++d) {
        float u = (u0 + u_step[d]) * s[d] + inside, v = (v0 + v_step[d]) * s[d] + inside;
        u = u > 0.0f ? u : 0.0f;
        v = v > 0.0f ? v : 0.0f;
        u = u < right ? u : right;
        v = v < down ? v : down;
        at[d] = static_cast<int32_t>(v) * width + static_cast<int32_t>(u);
      }
#pragma GCC ivdep
      for (int64_t d = 0; d < D; ++d) {
        const int32_t code = there[at[d]];
        at[d] = code < 0 ? none : bits(code ^ own);
      }
#pragma GCC ivdep
      for (int64_t d = 0; d < D; ++d) cost[d] = static_cast<uint8_t>(cost[d] + at[d]);
    }
  }
}

// One step of a path: the costs of the best paths that end at the pixel before, in place, become those at this one.
// `path` has a place before and one behind its D planes. Returns the least of them.
inline int16_t step_on(int16_t* __restrict path, int16_t* __restrict next, const uint8_t* __restrict cost, int64_t D,
                       int16_t low, int16_t step, int16_t jump) {
  const int16_t far = static_cast<int16_t>(low + jump);
  int16_t least = std::numeric_limits<int16_t>::max();
#pragma GCC ivdep
  for (int64_t d = 0; d < D; ++d) {
    int16_t best = std::min(path[d], path[d + 2]);
    best = static_cast<int16_t>(best + step);
    best = std::min(best, path[d + 1]);
    best = std::min(best, far);
    best = static_cast<int16_t>(best - low + cost[d]);
    next[d + 1] = best;
    least = std::min(least, best);
  }
  return least;
}

inline int16_t begin(int16_t* next, const uint8_t* cost, int64_t D) {
  int16_t least = std::numeric_limits<int16_t>::max();
  for (int64_t d = 0; d < D; ++d) {
    next[d + 1] = cost[d];
    least = std::min(least, next[d + 1]);
  }
  return least;
}

// S (B, h, w, D) int16 of C (B, h, w, D) uint8: the sum of the best paths from four sides; step and jump (B) int16.
// Twice through the picture: from its first pixel on with the paths from the left and from above, and back.
void aggregate(Tensor C, Tensor S, Tensor step, Tensor jump) {
  const int64_t B = C.size(0), h = C.size(1), w = C.size(2), D = C.size(3), wide = D + 2;
  std::vector<int16_t> columns(w * wide), other(wide), row(wide), row_next(wide), low(w);
  for (int64_t k = 0; k < B; ++k) {
    const int16_t one = data<int16_t>(step)[k], more = data<int16_t>(jump)[k];
    for (int back = 0; back < 2; ++back) {
      std::fill(columns.begin(), columns.end(), NOWHERE);
      std::fill(other.begin(), other.end(), NOWHERE);
      std::fill(row.begin(), row.end(), NOWHERE);
      std::fill(row_next.begin(), row_next.end(), NOWHERE);
      for (int64_t i = 0; i < h; ++i) {
        const int64_t y = back ? h - 1 - i : i;
        int16_t row_low = 0;
        for (int64_t j = 0; j < w; ++j) {
          const int64_t x = back ? w - 1 - j : j, place = ((k * h + y) * w + x) * D;
          const uint8_t* cost = data<uint8_t>(C) + place;
          int16_t* column = columns.data() + x * wide;
          row_low = j ? step_on(row.data(), row_next.data(), cost, D, row_low, one, more)
                      : begin(row_next.data(), cost, D);
          std::swap(row, row_next);
          low[x] = i ? step_on(column, other.data(), cost, D, low[x], one, more) : begin(other.data(), cost, D);
          std::memcpy(column + 1, other.data() + 1, D * sizeof(int16_t));
          int16_t* __restrict sum = data<int16_t>(S) + place;
          const int16_t *__restrict p = row.data() + 1, *__restrict r = column + 1;
          if (back) {
            for (int64_t d = 0; d < D; ++d) sum[d] = static_cast<int16_t>(sum[d] + p[d] + r[d]);
          } else {
            for (int64_t d = 0; d < D; ++d) sum[d] = static_cast<int16_t>(p[d] + r[d]);
          }
        }
      }
    }
  }
}

// Of S (N, D) int16: the first plane of least cost (N) int64, where between its neighbours a parabola is least (N)
// float32, and that cost (N) int16.
void winner(Tensor S, Tensor plane, Tensor shift, Tensor cost) {
  const int64_t N = S.size(0), D = S.size(1);
  const int16_t* s = data<int16_t>(S);
  for (int64_t n = 0; n < N; ++n, s += D) {
    int16_t low = s[0];
    for (int64_t d = 1; d < D; ++d) low = std::min(low, s[d]);
    int64_t d = 0;
    while (s[d] != low) ++d;
    float between = 0.0f;
    if (d > 0 && d < D - 1) {
      const float before = s[d - 1], here = s[d], after = s[d + 1], bend = before + after - 2.0f * here;
      if (bend > 0.0f) between = std::clamp(0.5f * (before - after) / std::max(bend, 1e-6f), -0.5f, 0.5f);
    }
    data<int16_t>(cost)[n] = low;
    data<int64_t>(plane)[n] = d;
    data<float>(shift)[n] = between;
  }
}

// Of S (h, w, D) int16, at every other pixel both ways: the least cost further than `reach` planes from `plane` (h, w)
// int64; the type's most where there is none.
void elsewhere(Tensor S, Tensor plane, Tensor cost, int64_t reach) {
  const int64_t h = S.size(0), w = S.size(1), D = S.size(2);
  int16_t* found = data<int16_t>(cost);
  for (int64_t y = 0; y < h; y += 2) {
    for (int64_t x = 0; x < w; x += 2) {
      const int16_t* s = data<int16_t>(S) + (y * w + x) * D;
      const int64_t at = data<int64_t>(plane)[y * w + x];
      const int64_t before = std::max<int64_t>(at - reach, 0), after = std::min<int64_t>(at + reach + 1, D);
      int16_t low = std::numeric_limits<int16_t>::max();
      for (int64_t d = 0; d < before; ++d) low = std::min(low, s[d]);
      for (int64_t d = after; d < D; ++d) low = std::min(low, s[d]);
      *found++ = low;
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY(dhtorch, m) {
  m.def(
      "add_costs(Tensor(a!) C, Tensor code_0, Tensor code_1, Tensor a, Tensor b, Tensor c, Tensor q, int rows, "
      "int columns, int margin, int unseen) -> ()");
  m.def("aggregate(Tensor C, Tensor(a!) S, Tensor step, Tensor jump) -> ()");
  m.def("winner(Tensor S, Tensor(a!) plane, Tensor(b!) shift, Tensor(c!) cost) -> ()");
  m.def("elsewhere(Tensor S, Tensor plane, Tensor(a!) cost, int reach) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("add_costs", TORCH_BOX(&add_costs));
  m.impl("aggregate", TORCH_BOX(&aggregate));
  m.impl("winner", TORCH_BOX(&winner));
  m.impl("elsewhere", TORCH_BOX(&elsewhere));
}
