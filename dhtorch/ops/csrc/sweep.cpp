// Census, costs and the best surface of the plane sweep, and smoothing of inverse depths. References:
// dhtorch/geometry/plane_sweep.py and windows.py; equal bit for bit: integers, and sums of products in torch's order
// (-ffp-contract=off: none is fused). One thread, no gradient. The dispatch checks dtypes and strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#ifdef __linux__
#include <sys/mman.h>
#endif

namespace {

// Advise the kernel to back new memory with large pages, which saves a page fault for every 4 KiB.
inline void large_pages(void* from, size_t bytes) {
#if defined(__linux__) && defined(MADV_HUGEPAGE)
  constexpr uintptr_t PAGE = uintptr_t{1} << 21;
  const uintptr_t at = reinterpret_cast<uintptr_t>(from), first = (at + PAGE - 1) & ~(PAGE - 1), end = (at + bytes) & ~(PAGE - 1);
  if (first < end) madvise(reinterpret_cast<void*>(first), end - first, MADV_HUGEPAGE);
#endif
}

// Set bits of each lane, as count_set_bits.
inline Bits set_bits(Bits code) {
#if defined(__AVX512BW__)
  const __m512i x = reinterpret_cast<__m512i>(code), nibble = _mm512_set1_epi8(0x0F),
                counts = _mm512_broadcast_i32x4(_mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4));
  const __m512i bytes = _mm512_add_epi8(_mm512_shuffle_epi8(counts, _mm512_and_si512(x, nibble)),
                                        _mm512_shuffle_epi8(counts, _mm512_and_si512(_mm512_srli_epi32(x, 4), nibble)));
  const __m512i pairs = _mm512_maddubs_epi16(bytes, _mm512_set1_epi8(1));
  return reinterpret_cast<Bits>(_mm512_madd_epi16(pairs, _mm512_set1_epi16(1)));
#elif defined(__AVX2__)
  const __m256i x = reinterpret_cast<__m256i>(code), nibble = _mm256_set1_epi8(0x0F),
                counts = _mm256_broadcastsi128_si256(_mm_setr_epi8(0, 1, 1, 2, 1, 2, 2, 3, 1, 2, 2, 3, 2, 3, 3, 4));
  const __m256i bytes = _mm256_add_epi8(_mm256_shuffle_epi8(counts, _mm256_and_si256(x, nibble)),
                                        _mm256_shuffle_epi8(counts, _mm256_and_si256(_mm256_srli_epi32(x, 4), nibble)));
  const __m256i pairs = _mm256_maddubs_epi16(bytes, _mm256_set1_epi8(1));
  return reinterpret_cast<Bits>(_mm256_madd_epi16(pairs, _mm256_set1_epi16(1)));
#else
  for (int64_t i = 0; i < LANES; ++i) code[i] = __builtin_popcount(static_cast<uint32_t>(code[i]));
  return code;
#endif
}

// Add the census cost of every pixel and plane to C (B, h, w, D) uint8, or write it if C is `fresh`. code_0 (B, N) and
// code_1 (B, rows * columns) int32; a (B, 2, N), b (B, 2), c (B) and q (B, D) float32: a pixel is seen at
// (a + q b) / (1 + q c) + margin. `unseen`: cost where view 1 shows nothing.
void add_census_costs(Tensor C, Tensor code_0, Tensor code_1, Tensor a, Tensor b, Tensor c, Tensor q, int64_t rows,
                      int64_t columns, int64_t margin, int64_t unseen, double min_depth_ratio, double behind_scale,
                      bool fresh) {
  typedef uint8_t Bytes __attribute__((vector_size(LANES)));
  const int64_t B = q.size(0), D = q.size(1), N = code_0.size(1), M = code_1.size(1), blocks = (D + LANES - 1) / LANES;
  const float inside = static_cast<float>(margin + 0.5), right = static_cast<float>(columns - 1),
              down = static_cast<float>(rows - 1);
  const float min_ratio = static_cast<float>(min_depth_ratio), behind = static_cast<float>(behind_scale);
  const Bits none = Bits{} + static_cast<int32_t>(unseen);
  std::vector<Lanes> scale(blocks), along(blocks), across(blocks);
  if (fresh) large_pages(data<uint8_t>(C), B * N * D);
  for (int64_t k = 0; k < B; ++k) {
    const float *bk = data<float>(b) + 2 * k, *qk = data<float>(q) + D * k, *ak = data<float>(a) + 2 * N * k;
    for (int64_t d = 0; d < D; ++d) {
      const float z = 1.0f + qk[d] * data<float>(c)[k];
      scale[d / LANES].of[d % LANES] = z > min_ratio ? 1.0f / z : behind;
      along[d / LANES].of[d % LANES] = qk[d] * bk[0];
      across[d / LANES].of[d % LANES] = qk[d] * bk[1];
    }
    const int32_t *here = data<int32_t>(code_0) + N * k, *there = data<int32_t>(code_1) + M * k;
    uint8_t* cost = data<uint8_t>(C) + N * D * k;
    for (int64_t n = 0; n < N; ++n, cost += D) {
      const float u0 = ak[n], v0 = ak[N + n];
      const Bits own = Bits{} + here[n];
      for (int64_t i = 0; i < blocks; ++i) {
        const Vector s = load(scale[i].of);
        const Bits column = __builtin_convertvector(within((u0 + load(along[i].of)) * s + inside, right), Bits),
                   row = __builtin_convertvector(within((v0 + load(across[i].of)) * s + inside, down), Bits);
        const Bits code = gather(there, row * static_cast<int32_t>(columns) + column);
        Bytes added = __builtin_convertvector(code < 0 ? none : set_bits(code ^ own), Bytes);
        const int64_t count = std::min(LANES, D - i * LANES);
        if (!fresh) {
          Bytes before = {};
          std::memcpy(&before, cost + i * LANES, count);
          added += before;
        }
        if (count == LANES) {
          std::memcpy(cost + i * LANES, &added, LANES);
        } else {
          std::memcpy(cost + i * LANES, &added, count);
        }
      }
    }
  }
}

// Semiglobal matching over costs C (h, w, D) uint8 along paths from four sides, and the best planes. Path, Two and Four
// are integer types for the cost of one path, two and four. Two passes over the image: from its first pixel on with the
// paths from the left and from above, and back with the other two.
template <typename Path, typename Two, typename Four>
struct Surface {
  const int64_t h, w, D, wide;  // paths are padded by one element before and behind their D planes
  const Path step, jump;
  std::vector<Path> above, under, left, right, low;  // of the previous row and pixel, and of the current ones
  std::unique_ptr<Two[]> half;
  std::vector<Four> all;

  Surface(int64_t h, int64_t w, int64_t D, int64_t step, int64_t jump)
      : h(h), w(w), D(D), wide(D + 2), step(static_cast<Path>(step)), jump(static_cast<Path>(jump)), above(w * wide),
        under(w * wide), left(wide), right(wide), low(w), half(new Two[h * w * D]), all(D) {
    large_pages(half.get(), h * w * D * sizeof(Two));
  }

  // A new path has cost 0; the padding costs more than any path.
  void begin(std::vector<Path>& paths) const {
    std::fill(paths.begin(), paths.end(), static_cast<Path>(0));
    for (size_t i = 0; i < paths.size(); i += wide) {
      paths[i] = paths[i + wide - 1] = static_cast<Path>(std::numeric_limits<Path>::max() - step);
    }
  }
  void begin() {
    for (auto* paths : {&above, &under, &left, &right}) begin(*paths);
    std::fill(low.begin(), low.end(), static_cast<Path>(0));
  }

  // Cost of the best path to this pixel at a plane, from the previous pixel's at that plane and its neighbours.
  Path extend(const Path* from, Path least, Path far, uint8_t cost) const {
    Path best = std::min(from[0], from[2]);
    best = static_cast<Path>(best + step);
    best = std::min(best, from[1]);
    best = std::min(best, far);
    return static_cast<Path>(static_cast<Path>(best - least) + cost);
  }

  // Extend both paths to pixel x; writes their sums, with those of the other two paths if given, and returns the least.
  template <typename Sum>
  Sum pass(int64_t x, const uint8_t* __restrict cost, Path& least, const Two* __restrict others, Sum* __restrict sum) {
    const Path *__restrict p = left.data(), *__restrict r = above.data() + x * wide;
    Path *__restrict p_to = right.data() + 1, *__restrict r_to = under.data() + x * wide + 1;
    const Path p_least = least, r_least = low[x];
    const Path p_far = static_cast<Path>(p_least + jump), r_far = static_cast<Path>(r_least + jump);
    Path p_found = std::numeric_limits<Path>::max(), r_found = p_found;
    Sum found = std::numeric_limits<Sum>::max();
#pragma GCC ivdep
    for (int64_t d = 0; d < D; ++d) {
      const Path here = extend(p + d, p_least, p_far, cost[d]), there = extend(r + d, r_least, r_far, cost[d]);
      p_to[d] = here;
      r_to[d] = there;
      p_found = std::min(p_found, here);
      r_found = std::min(r_found, there);
      Sum both = static_cast<Sum>(static_cast<Sum>(here) + static_cast<Sum>(there));
      if (others) both = static_cast<Sum>(both + static_cast<Sum>(others[d]));
      sum[d] = both;
      found = std::min(found, both);
    }
    std::swap(left, right);
    least = p_found;
    low[x] = r_found;
    return found;
  }

  // The first plane of least cost, and the minimum of the parabola through its neighbours' costs.
  void choose(Four least, int64_t* plane, float* shift, int16_t* cost) const {
    const Four* s = all.data();
    int64_t d = 0;
    if constexpr (sizeof(Four) == 1) {
      d = static_cast<const Four*>(std::memchr(s, least, D)) - s;
    } else {
      while (s[d] != least) ++d;
    }
    float between = 0.0f;
    if (d > 0 && d < D - 1) {
      const float before = s[d - 1], here = s[d], after = s[d + 1], bend = before + after - 2.0f * here;
      if (bend > 0.0f) between = std::clamp(0.5f * (before - after) / std::max(bend, 1e-6f), -0.5f, 0.5f);
    }
    *plane = d;
    *shift = between;
    *cost = static_cast<int16_t>(least);
  }

  void find(const uint8_t* C, int64_t* plane, float* shift, int16_t* cost, int16_t* some) {
    begin();
    for (int64_t y = 0, n = 0; y < h; ++y) {
      begin(left);
      Path least = 0;
      for (int64_t x = 0; x < w; ++x, ++n) pass<Two>(x, C + n * D, least, nullptr, half.get() + n * D);
      std::swap(above, under);
    }
    begin();
    for (int64_t y = h - 1, n = h * w - 1; y >= 0; --y) {
      begin(left);
      Path least = 0;
      for (int64_t x = w - 1; x >= 0; --x, --n) {
        const Four found = pass<Four>(x, C + n * D, least, half.get() + n * D, all.data());
        choose(found, plane + n, shift + n, cost + n);
        if (x % 2 == 0 && y % 2 == 0) {
          int16_t* __restrict kept = some + (y / 2 * ((w + 1) / 2) + x / 2) * D;
          for (int64_t d = 0; d < D; ++d) kept[d] = all[d];
        }
      }
      std::swap(above, under);
    }
  }
};

// Semiglobal matching over C (B, h, w, D) uint8 with step and jump (B) int16. Outputs: plane (B, h, w) int64 of least cost,
// shift float32 towards the minimum between planes, cost int16 of that plane; and the cost of all planes at every other
// row and column, `some` (B, (h + 1) / 2, (w + 1) / 2, D) int16. Computed in bytes wherever no sum exceeds one.
void aggregate_best_plane(Tensor C, Tensor step, Tensor jump, Tensor plane, Tensor shift, Tensor cost, Tensor some) {
  const int64_t B = C.size(0), h = C.size(1), w = C.size(2), D = C.size(3), N = h * w, quarter = some.size(1) * some.size(2);
  for (int64_t k = 0; k < B; ++k) {
    const uint8_t* costs = data<uint8_t>(C) + k * N * D;
    const int64_t one = data<int16_t>(step)[k], more = data<int16_t>(jump)[k];
    uint8_t worst = 0;
    for (int64_t i = 0; i < N * D; ++i) worst = std::max(worst, costs[i]);
    const int64_t most = worst + more;  // of a path, which exceeds its least by at most a jump
    const auto found = [&]<typename Path, typename Two, typename Four>() {
      Surface<Path, Two, Four>(h, w, D, one, more)
          .find(costs, data<int64_t>(plane) + k * N, data<float>(shift) + k * N, data<int16_t>(cost) + k * N,
                data<int16_t>(some) + k * quarter * D);
    };
    if (most + std::max(one, more) > 255) {
      found.template operator()<int16_t, int16_t, int16_t>();
    } else if (2 * most > 255) {
      found.template operator()<uint8_t, int16_t, int16_t>();
    } else if (4 * most > 255) {
      found.template operator()<uint8_t, uint8_t, int16_t>();
    } else {
      found.template operator()<uint8_t, uint8_t, uint8_t>();
    }
  }
}

// Least cost (N) of S (N, D) int16 further than `reach` planes from `plane` (N) int64; the largest int16 where there is
// none.
void second_best(Tensor S, Tensor plane, Tensor cost, int64_t reach) {
  const int64_t N = S.size(0), D = S.size(1);
  const int16_t* s = data<int16_t>(S);
  for (int64_t n = 0; n < N; ++n, s += D) {
    const int64_t at = data<int64_t>(plane)[n];
    const int64_t before = std::max<int64_t>(at - reach, 0), after = std::min<int64_t>(at + reach + 1, D);
    int16_t low = std::numeric_limits<int16_t>::max();
    for (int64_t d = 0; d < before; ++d) low = std::min(low, s[d]);
    for (int64_t d = after; d < D; ++d) low = std::min(low, s[d]);
    data<int16_t>(cost)[n] = low;
  }
}

// Codes (B, h, w) int32 of grey (B, h, w) float32: bit i is set where the neighbour at offset i of (n, 2) int64 (down,
// right) is darker than the pixel. The border is replicated.
void census_transform(Tensor grey, Tensor offsets, Tensor code) {
  const int64_t B = grey.size(0), h = grey.size(1), w = grey.size(2), n = offsets.size(0), margin = 8;
  const int64_t* step = data<int64_t>(offsets);
  const int64_t wide = w + 2 * margin;
  std::vector<float> padded((h + 2 * margin) * wide);
  for (int64_t k = 0; k < B; ++k) {
    const float* image = data<float>(grey) + k * h * w;
    for (int64_t y = 0; y < h + 2 * margin; ++y) {
      const float* row = image + std::clamp<int64_t>(y - margin, 0, h - 1) * w;
      float* to = padded.data() + y * wide;
      std::fill(to, to + margin, row[0]);
      std::copy(row, row + w, to + margin);
      std::fill(to + margin + w, to + wide, row[w - 1]);
    }
    for (int64_t y = 0; y < h; ++y) {
      int32_t* __restrict found = data<int32_t>(code) + (k * h + y) * w;
      std::fill(found, found + w, 0);
      const float* __restrict middle = padded.data() + (y + margin) * wide + margin;
      for (int64_t i = 0; i < n; ++i) {
        const float* __restrict beside = middle + step[2 * i] * wide + step[2 * i + 1];
        const int32_t bit = static_cast<int32_t>(1u << i);
        for (int64_t x = 0; x < w; ++x) found[x] |= beside[x] < middle[x] ? bit : 0;
      }
    }
  }
}

// Brown's rational model, in the order of operations of kornia's distort_points.
struct Lens {
  float k[8] = {};

  void distort(float& x, float& y) const {
    const float r2 = x * x + y * y, r4 = r2 * r2, r6 = r4 * r2;
    const float radial =
        (1.0f + k[0] * r2 + k[1] * r4 + k[4] * r6) / (1.0f + k[5] * r2 + k[6] * r4 + k[7] * r6);
    const float u = x * radial + 2.0f * k[2] * x * y + k[3] * (r2 + 2.0f * x * x);
    y = y * radial + k[2] * (r2 + 2.0f * y * y) + 2.0f * k[3] * x * y;
    x = u;
  }
};

// Motion and intrinsics of one source view.
struct View {
  const float *R, *t, *turn, *f, *c;
  Lens lens;
  float min_ratio;
};

// Pixels u, v of N points on rays (3, N) at inverse depths q, and whether they are in front.
template <bool bent>
void project(const View& to, const float* ray, const float* __restrict q, int64_t N, float* __restrict u, float* __restrict v,
             bool* __restrict front) {
  const float *__restrict ax = ray, *__restrict ay = ax + N, *__restrict az = ay + N, *m = to.R, *w = to.turn;
#pragma GCC ivdep
  for (int64_t n = 0; n < N; ++n) {
    const float a = ax[n], b = ay[n], d = az[n];
    float x = (a * m[0] + b * m[1] + d * m[2]) + q[n] * to.t[0];
    float y = (a * m[3] + b * m[4] + d * m[5]) + q[n] * to.t[1];
    float z = (a * m[6] + b * m[7] + d * m[8]) + q[n] * to.t[2];
    const float p = w[0] * b, o = w[1] * b, s = w[2] * b;
    const float dx = o * z - s * y, dy = s * x - p * z, dz = p * y - o * x;
    x = x + dx;
    y = y + dy;
    z = z + dz;
    const bool ahead = z > to.min_ratio;
    front[n] = ahead;
    z = ahead ? z : 1.0f;
    float across = (ahead ? x : 1.0f) / z, along = (ahead ? y : 1.0f) / z;
    if (bent) to.lens.distort(across, along);
    u[n] = across * to.f[0] + to.c[0];
    v[n] = along * to.f[1] + to.c[1];
  }
}

// Pixels uv (B, 2, N) at which a camera sees points on rays (B, 3, N) at inverse depths q (B, N), and whether they are in
// front of it (B, N) bool. R (B, 9), t, turn (B, 3), f, c (B, 2), distortion (B, k), or (0, 0) without a lens.
void project_inverse_depth(Tensor ray, Tensor q, Tensor R, Tensor t, Tensor turn, Tensor f, Tensor c, Tensor distortion,
                           Tensor uv, Tensor front, double min_depth_ratio) {
  const int64_t B = q.size(0), N = q.size(1), count = distortion.size(1);
  const bool bent = distortion.size(0) > 0;
  for (int64_t k = 0; k < B; ++k) {
    View to = {data<float>(R) + 9 * k, data<float>(t) + 3 * k, data<float>(turn) + 3 * k, data<float>(f) + 2 * k,
               data<float>(c) + 2 * k, {}, static_cast<float>(min_depth_ratio)};
    if (bent) std::copy_n(data<float>(distortion) + count * k, count, to.lens.k);
    const auto run = bent ? project<true> : project<false>;
    float* u = data<float>(uv) + 2 * N * k;
    run(to, data<float>(ray) + 3 * N * k, data<float>(q) + N * k, N, u, u + N, data<bool>(front) + N * k);
  }
}

void smooth_rows(const float* q, float* out, int64_t h, int64_t w, float near, int64_t radius) {  // along h
  std::vector<float> total(w), count(w);
  for (int64_t y = 0; y < h; ++y) {
    const float* __restrict middle = q + y * w;
    float *__restrict sum = total.data(), *__restrict n = count.data();
    std::copy(middle, middle + w, sum);
    std::fill(n, n + w, 1.0f);
    for (int64_t k = 1; k <= radius; ++k) {
      if (y < k || y + k >= h) continue;
      const float *__restrict before = middle - k * w, *__restrict after = middle + k * w;
      for (int64_t x = 0; x < w; ++x) {
        const bool fine = (std::abs(before[x] - middle[x]) <= near) & (std::abs(after[x] - middle[x]) <= near);
        sum[x] += fine ? before[x] + after[x] : 0.0f;
        n[x] += fine ? 2.0f : 0.0f;
      }
    }
    for (int64_t x = 0; x < w; ++x) out[y * w + x] = sum[x] / n[x];
  }
}

void smooth_columns(const float* q, float* out, int64_t h, int64_t w, float near, int64_t radius) {  // along w
  std::vector<float> total(w), count(w);
  for (int64_t y = 0; y < h; ++y) {
    const float* __restrict middle = q + y * w;
    float *__restrict sum = total.data(), *__restrict n = count.data();
    std::copy(middle, middle + w, sum);
    std::fill(n, n + w, 1.0f);
    for (int64_t k = 1; k <= radius; ++k) {
      for (int64_t x = k; x < w - k; ++x) {
        const float before = middle[x - k], after = middle[x + k];
        const bool fine = (std::abs(before - middle[x]) <= near) & (std::abs(after - middle[x]) <= near);
        sum[x] += fine ? before + after : 0.0f;
        n[x] += fine ? 2.0f : 0.0f;
      }
    }
    for (int64_t x = 0; x < w; ++x) out[y * w + x] = sum[x] / n[x];
  }
}

// out (B, h, w) float32: mean of the q within `tolerance` (B) along the column, then along the row.
void smooth_within_tolerance(Tensor q, Tensor tolerance, Tensor out, int64_t radius) {
  const int64_t B = q.size(0), h = q.size(1), w = q.size(2);
  std::vector<float> between(h * w);
  for (int64_t k = 0; k < B; ++k) {
    const float near = data<float>(tolerance)[k];
    smooth_rows(data<float>(q) + k * h * w, between.data(), h, w, near, radius);
    smooth_columns(between.data(), data<float>(out) + k * h * w, h, w, near, radius);
  }
}

}  // namespace

STABLE_TORCH_LIBRARY(dhtorch, m) {
  m.def(
      "add_census_costs(Tensor(a!) C, Tensor code_0, Tensor code_1, Tensor a, Tensor b, Tensor c, Tensor q, int rows, "
      "int columns, int margin, int unseen, float min_depth_ratio, float behind_scale, bool fresh) -> ()");
  m.def(
      "aggregate_best_plane(Tensor C, Tensor step, Tensor jump, Tensor(a!) plane, Tensor(b!) shift, Tensor(c!) cost, "
      "Tensor(d!) some) -> ()");
  m.def("census_transform(Tensor grey, Tensor offsets, Tensor(a!) code) -> ()");
  m.def(
      "project_inverse_depth(Tensor ray, Tensor q, Tensor R, Tensor t, Tensor turn, Tensor f, Tensor c, "
      "Tensor distortion, Tensor(a!) uv, Tensor(b!) front, float min_depth_ratio) -> ()");
  m.def("smooth_within_tolerance(Tensor q, Tensor tolerance, Tensor(a!) out, int radius) -> ()");
  m.def("second_best(Tensor S, Tensor plane, Tensor(a!) cost, int reach) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("add_census_costs", TORCH_BOX(&add_census_costs));
  m.impl("aggregate_best_plane", TORCH_BOX(&aggregate_best_plane));
  m.impl("census_transform", TORCH_BOX(&census_transform));
  m.impl("project_inverse_depth", TORCH_BOX(&project_inverse_depth));
  m.impl("smooth_within_tolerance", TORCH_BOX(&smooth_within_tolerance));
  m.impl("second_best", TORCH_BOX(&second_best));
}
