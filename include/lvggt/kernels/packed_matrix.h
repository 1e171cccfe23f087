// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "lvggt/core/tensor.h"

namespace lvggt {

// Output channels of one panel: one 64-byte line of floats, whatever the instruction set.
inline constexpr std::int64_t kPanelWidth = 16;

constexpr std::int64_t num_panels(std::int64_t n) { return (n + kPanelWidth - 1) / kPanelWidth; }

// The right-hand side of a product, packed once at load: panel p holds output channels 16p .. 16p+15, line
// by line along the summed axis. A product with several taps (a convolution) sums tap by tap.
struct PackedMatrix {
  std::int64_t N = 0;     // output channels
  std::int64_t taps = 0;  // 1 for a linear layer
  std::int64_t K = 0;     // summed extent of one tap
  Tensor<float, 3> panels;  // [num_panels(N), taps * K, 16], zero beyond N

  bool empty() const { return panels.empty(); }
};

// weight: [N, K], as a linear layer stores it.
PackedMatrix pack_linear(View<const float, 2> weight);

}  // namespace lvggt
