// What the parts of the compiled code share: a tensor's numbers, and vectors of as many floats as this processor adds at
// once; see dhtorch/ops/loader.py.

#pragma once

#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <cstring>

#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define DHTORCH_SHUFFLES
#endif
#endif

using torch::stable::Tensor;

namespace {

#ifdef __AVX512F__
constexpr int64_t LANES = 16;
#else
constexpr int64_t LANES = 8;
#endif
typedef float Vector __attribute__((vector_size(LANES * sizeof(float))));
typedef int32_t Bits __attribute__((vector_size(LANES * sizeof(int32_t))));

template <typename T>
T* data(const Tensor& x) {
  return static_cast<T*>(x.data_ptr());
}

inline Vector load(const float* from) {
  Vector found;
  std::memcpy(&found, from, sizeof(found));
  return found;
}

inline void store(Vector x, float* to) { std::memcpy(to, &x, sizeof(x)); }

// As torch fuses products with sums, where the processor can.
inline float fused(float a, float b, float c) {
#ifdef __FMA__
  return __builtin_fmaf(a, b, c);
#else
  return a * b + c;
#endif
}

// A whole number divided, rounded as a division is, which takes longer: right for all bytes over 255, 25 times as much over
// 25, 255000 over that, and numbers of two bytes over 1000.
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

// The sum of a vector's numbers, halves added to halves.
inline float total(Vector x) {
#ifdef DHTORCH_SHUFFLES  // without them g++ 12 goes through memory
#ifdef __AVX512F__
  const auto eight = __builtin_shufflevector(x, x, 0, 1, 2, 3, 4, 5, 6, 7) +
                     __builtin_shufflevector(x, x, 8, 9, 10, 11, 12, 13, 14, 15);
#else
  const auto eight = x;
#endif
  const auto four =
      __builtin_shufflevector(eight, eight, 0, 1, 2, 3) + __builtin_shufflevector(eight, eight, 4, 5, 6, 7);
  const auto two = __builtin_shufflevector(four, four, 0, 1) + __builtin_shufflevector(four, four, 2, 3);
  return two[0] + two[1];
#else
  float part[LANES];
  store(x, part);
  for (int64_t half = LANES / 2; half; half /= 2) {
    for (int64_t i = 0; i < half; ++i) part[i] += part[i + half];
  }
  return part[0];
#endif
}

}  // namespace
