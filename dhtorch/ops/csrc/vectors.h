// Shared by all kernels: access to a tensor's data, vectors of as many floats as one instruction of this processor
// processes, medians, motions of a pose, and the weights of grey values. See dhtorch/ops/loader.py.

#pragma once

#include <torch/csrc/stable/tensor.h>

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "constants.h"

#if defined(__FMA__)
#include <immintrin.h>
#endif

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

// Floats of a vector, aligned so that none of its loads crosses a cache line.
struct alignas(Vector) Lanes {
  float of[LANES];
};

template <typename T>
T* data(const Tensor& x) {
  return static_cast<T*>(x.data_ptr());
}

inline Vector load(const float* from) {
  Vector found;
  std::memcpy(&found, from, sizeof(found));
  return found;
}

// A value that is read from memory once, where compilers would read it again for each of its uses.
inline Vector kept_in_register(Vector x) {
#if defined(__AVX512F__)
  asm("" : "+v"(x));
#elif defined(__AVX__)
  asm("" : "+x"(x));
#endif
  return x;
}

inline void store(Vector x, float* to) { std::memcpy(to, &x, sizeof(x)); }

// a * b + c with one rounding where the processor has FMA instructions, as torch's own kernels compute it.
inline float fused(float a, float b, float c) {
#ifdef __FMA__
  return __builtin_fmaf(a, b, c);
#else
  return a * b + c;
#endif
}

// The same for vectors.
inline Vector fused(Vector a, Vector b, Vector c) {
#if defined(__AVX512F__)
  return reinterpret_cast<Vector>(_mm512_fmadd_ps(reinterpret_cast<__m512>(a), reinterpret_cast<__m512>(b), reinterpret_cast<__m512>(c)));
#elif defined(__FMA__)
  return reinterpret_cast<Vector>(_mm256_fmadd_ps(reinterpret_cast<__m256>(a), reinterpret_cast<__m256>(b), reinterpret_cast<__m256>(c)));
#else
  return a * b + c;
#endif
}
inline Vector fused(float a, Vector b, Vector c) { return fused(Vector{} + a, b, c); }

// x / DIVISOR, correctly rounded, faster than a division. Exact for integers up to 255 over 255, 25 * 255 over 25, 255000
// over 255000 and 65535 over 1000.
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

// x within 0 and `most`; 0 where it is no number.
inline Vector within(Vector x, float most) {
  x = x > 0.0f ? x : Vector{};
  return x < most ? x : Vector{} + most;
}

// from[at] of each lane.
inline Bits gather(const int32_t* from, Bits at) {
#if defined(__AVX512F__)
  return reinterpret_cast<Bits>(_mm512_i32gather_epi32(reinterpret_cast<__m512i>(at), from, 4));
#elif defined(__AVX2__)
  return reinterpret_cast<Bits>(_mm256_i32gather_epi32(from, reinterpret_cast<__m256i>(at), 4));
#else
  for (int64_t i = 0; i < LANES; ++i) at[i] = from[at[i]];
  return at;
#endif
}

inline Vector gather(const float* from, Bits at) {
  return reinterpret_cast<Vector>(gather(reinterpret_cast<const int32_t*>(from), at));
}

// Sum of the lanes, by halves.
inline float total(Vector x) {
#ifdef DHTORCH_SHUFFLES  // g++ 12 has none and would write the vector to memory
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

// Sums of the lanes of four vectors, each as total().
inline void totals(Vector a, Vector b, Vector c, Vector d, float* to) {
#ifdef DHTORCH_SHUFFLES
#ifdef __AVX512F__
  const auto ab = __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
                  __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
  const auto cd = __builtin_shufflevector(c, d, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
                  __builtin_shufflevector(c, d, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
  const auto fours = __builtin_shufflevector(ab, cd, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27) +
                     __builtin_shufflevector(ab, cd, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
  const auto ac = __builtin_shufflevector(fours, fours, 0, 1, 2, 3, 8, 9, 10, 11),
             bd = __builtin_shufflevector(fours, fours, 4, 5, 6, 7, 12, 13, 14, 15);
#else
  const auto ac = __builtin_shufflevector(a, c, 0, 1, 2, 3, 8, 9, 10, 11) + __builtin_shufflevector(a, c, 4, 5, 6, 7, 12, 13, 14, 15),
             bd = __builtin_shufflevector(b, d, 0, 1, 2, 3, 8, 9, 10, 11) + __builtin_shufflevector(b, d, 4, 5, 6, 7, 12, 13, 14, 15);
#endif
  const auto twos = __builtin_shufflevector(ac, bd, 0, 1, 8, 9, 4, 5, 12, 13) + __builtin_shufflevector(ac, bd, 2, 3, 10, 11, 6, 7, 14, 15);
  const auto found = __builtin_shufflevector(twos, twos, 0, 2, 4, 6) + __builtin_shufflevector(twos, twos, 1, 3, 5, 7);
  std::memcpy(to, &found, sizeof(found));
#else
  to[0] = total(a);
  to[1] = total(b);
  to[2] = total(c);
  to[3] = total(d);
#endif
}

// Lower median of values, which are reordered; `without` where there is none.
template <typename T>
T lower_median(std::vector<T>& values, T without) {
  if (values.empty()) return without;
  const auto middle = values.begin() + (values.size() - 1) / 2;
  std::nth_element(values.begin(), middle, values.end());
  return *middle;
}

// The pose R (3, 3), t displaced by xi = (rotation rad, translation m), of move_pose in least_squares.py.
template <typename T>
void move_pose(T* R, T* t, const T* xi) {
  const T half[3] = {xi[0] / 2, xi[1] / 2, xi[2] / 2};
  const T by = 2 / (1 + (half[0] * half[0] + half[1] * half[1] + half[2] * half[2]));
  const auto cross = [&](const T* b, T* c) {
    for (int i = 0; i < 3; ++i) c[i] = half[(i + 1) % 3] * b[(i + 2) % 3] - half[(i + 2) % 3] * b[(i + 1) % 3];
  };
  for (int k = 0; k < 4; ++k) {
    T column[3], once[3], twice[3];
    for (int i = 0; i < 3; ++i) column[i] = k < 3 ? R[3 * i + k] : t[i];
    cross(column, once);
    cross(once, twice);
    for (int i = 0; i < 3; ++i) {
      const T moved = column[i] + (once[i] + twice[i]) * by;
      (k < 3 ? R[3 * i + k] : t[i]) = k < 3 ? moved : moved + xi[3 + i];
    }
  }
}

// BT.601 weights of red, green and blue.
constexpr float LUMA[3] = {static_cast<float>(LUMA_THOUSANDTHS[0] / 1000.0), static_cast<float>(LUMA_THOUSANDTHS[1] / 1000.0),
                           static_cast<float>(LUMA_THOUSANDTHS[2] / 1000.0)};
constexpr int32_t LUMA_SUM = LUMA_THOUSANDTHS[0] + LUMA_THOUSANDTHS[1] + LUMA_THOUSANDTHS[2];
constexpr int32_t GREY_UNIT = 255 * LUMA_SUM;  // integer grey value of white bytes

inline float luma(float red, float green, float blue) {
  return fused(blue, LUMA[2], fused(green, LUMA[1], red * LUMA[0]));
}

}  // namespace
