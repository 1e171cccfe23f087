// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <complex>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// Means over all elements, holes included.   a, b: [B, H, W, C]   mask: [B, H, W]
template <class T>
T l1_loss(const Tensor<T, 4>& a, const Tensor<T, 4>& b, const Tensor<T, 3>& mask) {
  T sum = 0;
  for (std::int64_t i = 0; i < a.size(); ++i) {
    const T error = mask.data()[i / a.extent(3)] * (a.data()[i] - b.data()[i]);
    sum += std::real(error) < 0 ? -error : error;
  }
  return sum / T(static_cast<double>(a.size()));
}
template <class T>
T mse_loss(const Tensor<T, 4>& a, const Tensor<T, 4>& b, const Tensor<T, 3>& mask) {
  T sum = 0;
  for (std::int64_t i = 0; i < a.size(); ++i) {
    const T error = mask.data()[i / a.extent(3)] * (a.data()[i] - b.data()[i]);
    sum += error * error;
  }
  return sum / T(static_cast<double>(a.size()));
}

// 1 - the mean cosine of vectors along `axis` (3: channels, 2: width); zero vectors have cosine 0.
template <class T>
T cosine_loss(const Tensor<T, 4>& a, const Tensor<T, 4>& b, const Tensor<T, 3>& mask, int axis) {
  Shape<4> outer = a.shape();
  outer[axis] = 1;
  T sum = 0;
  for (std::int64_t n = 0; n < outer.volume(); ++n) {
    std::int64_t i[4] = {n / (outer[1] * outer[2] * outer[3]), n / (outer[2] * outer[3]) % outer[1],
                         n / outer[3] % outer[2], n % outer[3]};
    T uv = 0, uu = 0, vv = 0;
    for (i[axis] = 0; i[axis] < a.extent(axis); ++i[axis]) {
      const T m = mask(i[0], i[1], i[2]);
      const T u = m * a(i[0], i[1], i[2], i[3]), v = m * b(i[0], i[1], i[2], i[3]);
      uv += u * v;
      uu += u * u;
      vv += v * v;
    }
    if (std::real(uu) > 0 && std::real(vv) > 0) sum += uv / (std::sqrt(uu) * std::sqrt(vv));
  }
  return T(1) - sum / T(static_cast<double>(outer.volume()));
}

}  // namespace lvggt::reference
