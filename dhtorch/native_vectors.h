// What the parts of the compiled code share: a tensor's numbers, and vectors of as many floats as this processor adds at
// once; see dhtorch/native.py.

#pragma once

#include <torch/csrc/stable/tensor.h>

#include <cstdint>
#include <cstring>

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

inline float total(Vector x) {
  float part[LANES];
  store(x, part);
  for (int64_t half = LANES / 2; half; half /= 2) {
    for (int64_t i = 0; i < half; ++i) part[i] += part[i + half];
  }
  return part[0];
}

}  // namespace
