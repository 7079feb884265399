// Filters of maps by their neighbours. References: small_components of dhtorch/geometry/components.py and _torn of
// dhtorch/pipeline/map_filters.py; the same results bit for bit. One thread, no gradient. The dispatch checks dtypes and
// strides, Python the shapes.

#include "vectors.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <vector>

namespace {

// mask (B, h, w), right (B, h, w - 1) and down (B, h - 1, w): whether a pixel is connected to its right and its lower
// neighbour, bool. Output: small (B, h, w) bool, pixels of the mask whose component has fewer than n_pixels.
void small_components(Tensor mask, Tensor right, Tensor down, Tensor small, int64_t n_pixels) {
  const int64_t B = mask.size(0), h = mask.size(1), w = mask.size(2), N = h * w;
  std::vector<int64_t> component;
  std::vector<char> seen(N);
  for (int64_t k = 0; k < B; ++k) {
    const bool *in = data<bool>(mask) + N * k, *across = data<bool>(right) + h * (w - 1) * k,
               *along = data<bool>(down) + (h - 1) * w * k;
    bool* to = data<bool>(small) + N * k;
    std::fill_n(to, N, false);
    std::fill(seen.begin(), seen.end(), 0);
    for (int64_t first = 0; first < N; ++first) {
      if (!in[first] || seen[first]) continue;
      component.assign(1, first);
      seen[first] = 1;
      const auto visit = [&](bool connected, int64_t pixel) {
        if (!connected || seen[pixel]) return;
        seen[pixel] = 1;
        component.push_back(pixel);
      };
      for (size_t i = 0; i < component.size(); ++i) {
        const int64_t pixel = component[i], y = pixel / w, x = pixel % w;
        if (x + 1 < w) visit(across[y * (w - 1) + x], pixel + 1);
        if (x > 0) visit(across[y * (w - 1) + x - 1], pixel - 1);
        if (y + 1 < h) visit(along[pixel], pixel + w);
        if (y > 0) visit(along[pixel - w], pixel - w);
      }
      if (static_cast<int64_t>(component.size()) >= n_pixels) continue;
      for (const int64_t pixel : component) to[pixel] = true;
    }
  }
}

// q, sigma (1/m), grey (B, h, w) float32, usable and swept (B, h, w) bool. Output: torn (B, h, w) bool.
void torn_pixels(Tensor q, Tensor sigma, Tensor usable, Tensor swept, Tensor grey, Tensor torn, double seam_sigmas,
                 double seam_ratio, double grey_similarity) {
  const int64_t B = q.size(0), h = q.size(1), w = q.size(2);
  const float square = static_cast<float>(seam_sigmas * seam_sigmas), ratio = static_cast<float>(seam_ratio),
              similar = static_cast<float>(grey_similarity);
  for (int64_t k = 0; k < B; ++k) {
    const int64_t start = k * h * w;
    const float *own = data<float>(q) + start, *noise = data<float>(sigma) + start, *shade = data<float>(grey) + start;
    const bool *returned = data<bool>(usable) + start, *in = data<bool>(swept) + start;
    const auto differs = [&](int64_t n, int64_t m) {
      const float apart = std::fabs(own[n] - own[m]);
      return returned[m] && apart * apart > square * (noise[n] * noise[n] + noise[m] * noise[m]) &&
             std::max(own[n], own[m]) < ratio * std::min(own[n], own[m]) && std::fabs(shade[n] - shade[m]) < similar;
    };
    for (int64_t y = 0; y < h; ++y) {
      for (int64_t x = 0; x < w; ++x) {
        const int64_t n = y * w + x;
        bool found = false;
        for (int64_t step = 1; step <= 2 && in[n] && !found; ++step) {
          found = (x + step < w && differs(n, n + step)) || (x >= step && differs(n, n - step)) ||
                  (y + step < h && differs(n, n + step * w)) || (y >= step && differs(n, n - step * w));
        }
        data<bool>(torn)[start + n] = found;
      }
    }
  }
}

}  // namespace

STABLE_TORCH_LIBRARY_FRAGMENT(dhtorch, m) {
  m.def("small_components(Tensor mask, Tensor right, Tensor down, Tensor(a!) small, int n_pixels) -> ()");
  m.def(
      "torn_pixels(Tensor q, Tensor sigma, Tensor usable, Tensor swept, Tensor grey, Tensor(a!) torn, float seam_sigmas, "
      "float seam_ratio, float grey_similarity) -> ()");
}

STABLE_TORCH_LIBRARY_IMPL(dhtorch, CPU, m) {
  m.impl("small_components", TORCH_BOX(&small_components));
  m.impl("torn_pixels", TORCH_BOX(&torn_pixels));
}
