// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

template <class T>
struct Conv2dGradients {
  Tensor<T, 4> dx, dweight;
  Tensor<T, 1> dbias;
};

// Every product x w of the forward pass, times its dy, handed back to x and to w.
//   dy: [B, Ho, Wo, Cout]   x: [B, H, W, Cin]   w: [Cout, Cin, k, k]
template <class T>
Conv2dGradients<T> conv2d_backward(const Tensor<T, 4>& dy, const Tensor<T, 4>& x,
                                   const Tensor<T, 4>& w, std::int64_t stride,
                                   std::int64_t padding) {
  const auto [B, Ho, Wo, Cout] = dy.shape();
  const std::int64_t k = w.extent(2);
  Conv2dGradients<T> g{Tensor<T, 4>(x.shape()), Tensor<T, 4>(w.shape()), Tensor<T, 1>(Shape{Cout})};
  for (std::int64_t n = 0; n < dy.size(); ++n) {
    const std::int64_t o = n % Cout, j = n / Cout % Wo, i = n / (Cout * Wo) % Ho;
    const std::int64_t b = n / (Cout * Wo * Ho);
    const T d = dy.data()[n];
    g.dbias[o] += d;
    for (std::int64_t t = 0; t < k * k; ++t) {
      const std::int64_t h = i * stride + t / k - padding, v = j * stride + t % k - padding;
      if (h < 0 || h >= x.extent(1) || v < 0 || v >= x.extent(2)) continue;
      for (std::int64_t c = 0; c < x.extent(3); ++c) {
        g.dx(b, h, v, c) += d * w(o, c, t / k, t % k);
        g.dweight(o, c, t / k, t % k) += d * x(b, h, v, c);
      }
    }
  }
  return g;
}

}  // namespace lvggt::reference
