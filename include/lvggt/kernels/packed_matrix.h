// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

#include "lvggt/core/storage.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Output channels of one panel: one 64-byte line of floats, whatever the instruction set.
inline constexpr std::int64_t kPanelWidth = 16;

constexpr std::int64_t num_panels(std::int64_t n) { return (n + kPanelWidth - 1) / kPanelWidth; }

// The right-hand side of a product, packed once at load: panel p holds output channels 16p ..
// 16p+15, line by line along the summed axis. A product with several taps (a convolution) sums tap
// by tap.
//   f32, bf16, f16  [num_panels(N), taps * K, 16]
//   int8            [num_panels(N), ceil(K / 4), 16, 4]: four neighbours of K for each channel, as
//   the
//                   integer dot-product instructions read them; taps is 1
// Channels beyond N and neighbours beyond K are zero.
struct PackedMatrix {
  std::int64_t N = 0;     // output channels
  std::int64_t taps = 0;  // 1 for a linear layer
  std::int64_t K = 0;     // summed extent of one tap
  Storage storage = Storage::kF32;
  Tensor<std::byte, 1> panels;
  Tensor<float, 1> scales;              // int8: weight = scale * integer   [16 num_panels(N)]
  Tensor<std::int32_t, 1> weight_sums;  // int8: of a channel's integers    [16 num_panels(N)]

  bool empty() const { return panels.empty(); }
  std::size_t num_bytes() const {
    return panels.num_bytes() + scales.num_bytes() + weight_sums.num_bytes();
  }
};

// Largest magnitude of an int8 weight: 7 bits, so that the sum of two products with 8-bit
// activations fits 16 bits and nothing saturates.
inline constexpr int kInt8WeightMax = 63;

// weight: [N, K], as a linear layer stores it. int8 rounds each output channel to multiples of its
// largest magnitude / kInt8WeightMax.
PackedMatrix pack_linear(View<const float, 2> weight, Storage storage = Storage::kF32);

// The same from integers in [-kInt8WeightMax, kInt8WeightMax] and the scales of their channels,
// which are packed as they are.   integers: [N, K]   scales: [N]
PackedMatrix pack_linear(View<const std::int8_t, 2> integers, View<const float, 1> scales);

// The integers of one output channel and their scale, largest magnitude / kInt8WeightMax: what
// pack_linear makes of a row. A channel whose scale would be subnormal (all zeros, in practice)
// becomes zeros with scale 0, one that is not finite zeros with scale NaN.
float quantize_channel(std::int8_t* integers, const float* weights, std::int64_t K);

}  // namespace lvggt
