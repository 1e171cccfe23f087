// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <random>

#include "lvggt/core/tensor.h"

namespace lvggt::test {

// Uniform in [low, high), the same on every machine.
template <int R>
Tensor<float, R> random_tensor(Shape<R> shape, std::uint32_t seed, float low = -1, float high = 1) {
  std::mt19937 generator(seed);
  Tensor<float, R> x(shape);
  for (std::int64_t i = 0; i < x.size(); ++i)
    x.data()[i] = low + (high - low) * (static_cast<float>(generator() >> 8) * 0x1p-24f);
  return x;
}

// A dense copy, as another type.
template <class U, class T, int R>
Tensor<U, R> converted(View<T, R> x) {
  Tensor<U, R> copy(x.shape());
  std::int64_t offset = 0;
  const auto visit = [&](auto&& self, auto view) -> void {
    for (std::int64_t i = 0; i < view.extent(0); ++i) {
      if constexpr (std::is_arithmetic_v<std::remove_cvref_t<decltype(view[i])>>) {
        copy.data()[offset++] = static_cast<U>(view[i]);
      } else {
        self(self, view[i]);
      }
    }
  };
  visit(visit, x);
  return copy;
}
template <class T, int R>
Tensor<double, R> in_double(const Tensor<T, R>& x) {
  return converted<double>(x.view());
}

}  // namespace lvggt::test
