// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// One output sample of a resize of `in` to `out` samples: the sum over j of weight(i, j) times
// input j.
template <class T>
T bilinear_weight(std::int64_t i, std::int64_t j, std::int64_t out, std::int64_t in,
                  bool align_corners) {
  const T source = !align_corners ? (T(i) + T(0.5)) * T(in) / T(out) - T(0.5)
                   : out > 1      ? T(i) * T(in - 1) / T(out - 1)
                                  : T(0);
  return std::max(T(0), 1 - std::abs(std::clamp(source, T(0), T(in - 1)) - T(j)));
}
// x: [H, W, C] to [Ho, Wo, C]; weight(i, j, out, in) as above.
template <class T, class Weight>
Tensor<T, 3> resize(const Tensor<T, 3>& x, std::int64_t Ho, std::int64_t Wo, const Weight& weight) {
  const auto [H, W, C] = x.shape();
  Tensor<T, 3> y(Shape{Ho, Wo, C});
  for (std::int64_t n = 0; n < Ho * Wo * C * H * W; ++n) {
    const std::int64_t w = n % W, h = n / W % H, c = n / (W * H) % C;
    const std::int64_t j = n / (W * H * C) % Wo, i = n / (W * H * C * Wo);
    y(i, j, c) += weight(i, h, Ho, H) * weight(j, w, Wo, W) * x(h, w, c);
  }
  return y;
}

}  // namespace lvggt::reference
