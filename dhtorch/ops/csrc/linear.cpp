// Solutions of small positive definite systems. Reference: _solve in dhtorch/geometry/least_squares.py; the same scaling,
// factorisation and refinement, sums in another order. One thread, no gradient. The dispatch checks dtypes and strides,
// Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

// Lower Cholesky factor of A (n, n) in place, of whose upper half nothing is read; false where a pivot is at most `least`.
bool factor(double* A, int64_t n, double least) {
  for (int64_t j = 0; j < n; ++j) {
    double* row = A + j * n;
    double square = row[j];
    for (int64_t k = 0; k < j; ++k) square -= row[k] * row[k];
    const double pivot = std::sqrt(square);
    if (!(pivot > least)) return false;  // NaN, too
    row[j] = pivot;
    for (int64_t i = j + 1; i < n; ++i) {
      double x = A[i * n + j];
      for (int64_t k = 0; k < j; ++k) x -= A[i * n + k] * row[k];
      A[i * n + j] = x / pivot;
    }
  }
  return true;
}

// Solution of L L' x = b in place, b (n).
void substitute(const double* L, int64_t n, double* b) {
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t k = 0; k < i; ++k) b[i] -= L[i * n + k] * b[k];
    b[i] /= L[i * n + i];
  }
  for (int64_t i = n - 1; i >= 0; --i) {
    for (int64_t k = i + 1; k < n; ++k) b[i] -= L[k * n + i] * b[k];
    b[i] /= L[i * n + i];
  }
}

// H (B, n, n) symmetric, b (B, n, k) float64. Outputs: x (B, n, k), zero where not ok, and ok (B) bool: pivots of H scaled
// to a unit diagonal above `least`, and b finite.
void solve_spd(Tensor H, Tensor b, Tensor x, Tensor ok, double least) {
  const int64_t B = H.size(0), n = H.size(1), columns = b.size(2);
  std::vector<double> A(n * n), L(n * n), scale(n), right(n), first(n), rest(n);
  for (int64_t k = 0; k < B; ++k) {
    const double *from = data<double>(H) + n * n * k, *given = data<double>(b) + n * columns * k;
    double* to = data<double>(x) + n * columns * k;
    for (int64_t i = 0; i < n; ++i) scale[i] = from[i * n + i] > 0 ? 1 / std::sqrt(from[i * n + i]) : 1;
    for (int64_t i = 0; i < n; ++i) {
      for (int64_t j = 0; j < n; ++j) A[i * n + j] = from[i * n + j] * (scale[i] * scale[j]);
    }
    L = A;
    bool sound = factor(L.data(), n, least);
    for (int64_t i = 0; i < n; ++i) {
      for (int64_t c = 0; c < columns; ++c) sound = sound && std::isfinite(given[i * columns + c] * scale[i]);
    }
    data<bool>(ok)[k] = sound;
    std::fill_n(to, n * columns, 0.0);
    if (!sound) continue;
    for (int64_t c = 0; c < columns; ++c) {
      for (int64_t i = 0; i < n; ++i) first[i] = right[i] = given[i * columns + c] * scale[i];
      substitute(L.data(), n, first.data());
      for (int64_t i = 0; i < n; ++i) {
        double found = 0;
        for (int64_t j = 0; j < n; ++j) found += A[i * n + j] * first[j];
        rest[i] = right[i] - found;
      }
      substitute(L.data(), n, rest.data());
      for (int64_t i = 0; i < n; ++i) to[i * columns + c] = (first[i] + rest[i]) * scale[i];
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def("solve_spd(Tensor H, Tensor b, Tensor(a!) x, Tensor(b!) ok, float least) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) { m.impl("solve_spd", TORCH_BOX(&solve_spd)); }
