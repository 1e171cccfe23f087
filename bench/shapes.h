// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "lvggt/core/tensor.h"

// Sizes of the published configuration: a frame of 294 x 518 pixels is 21 x 37 patches and 5
// special tokens, a square one of 518 x 518 is 37 x 37 and 5.
namespace lvggt::bench {

inline constexpr std::int64_t kTokens = 782;
inline constexpr std::int64_t kTokensSquare = 1374;
inline constexpr std::int64_t kDim = 1024;
inline constexpr std::int64_t kHeads = 16;
inline constexpr std::int64_t kHeadDim = 64;

// Values in [-1, 1), the same at every run.
template <int R>
Tensor<float, R> random_tensor(Shape<R> shape, std::uint32_t seed) {
  Tensor<float, R> tensor(shape);
  std::uint32_t state = seed * 2654435761u + 1;
  for (std::int64_t i = 0; i < tensor.size(); ++i) {
    state = state * 1664525u + 1013904223u;
    tensor.data()[i] = static_cast<float>(static_cast<std::int32_t>(state)) * 0x1p-31f;
  }
  return tensor;
}

}  // namespace lvggt::bench
