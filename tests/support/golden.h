// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <string>

#include "lvggt/io/safetensors.h"
#include "tests/support/compare.h"
#include "tests/support/paths.h"

namespace lvggt::test {

// The file of that name in tests/golden.
inline Safetensors open_golden(const std::string& name) {
  return Safetensors::open(test_data("golden/") + name);
}

// A dense copy with the axes in another order: axis i of the copy is axis order[i] of x. The order
// is (0, 2, 3, 1) to turn planes into channels last.
template <int R>
Tensor<float, R> permuted(const Tensor<float, R>& x, const std::array<int, R>& order) {
  Shape<R> shape;
  for (int axis = 0; axis < R; ++axis)
    shape[axis] = x.extent(order[static_cast<std::size_t>(axis)]);
  Tensor<float, R> y(shape);
  for (std::int64_t n = 0; n < y.size(); ++n) {
    const Shape<R> index = unflatten(n, shape);
    Shape<R> source;
    for (int axis = 0; axis < R; ++axis)
      source[order[static_cast<std::size_t>(axis)]] = index[axis];
    y.data()[n] = element(x.view(), source);
  }
  return y;
}

// [B, C, H, W] as [B, H, W, C]
inline Tensor<float, 4> channels_last(const Tensor<float, 4>& x) {
  return permuted<4>(x, {0, 2, 3, 1});
}

// [1, heads, N, D] as [N, heads, D]
inline Tensor<float, 3> tokens_first(const Tensor<float, 4>& x) {
  const Tensor<float, 4> y = permuted<4>(x, {2, 1, 3, 0});
  Tensor<float, 3> tokens(Shape{y.extent(0), y.extent(1), y.extent(2)});
  std::copy_n(y.data(), y.size(), tokens.data());
  return tokens;
}

template <int R>
double largest_magnitude(const Tensor<float, R>& x) {
  double largest = 0;
  for (std::int64_t i = 0; i < x.size(); ++i)
    largest = std::max(largest, std::abs(static_cast<double>(x.data()[i])));
  return largest;
}

}  // namespace lvggt::test
