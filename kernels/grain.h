// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>

namespace lvggt::kernels {

// Elements of one chunk of an operator that reads and writes each element once: 64 KiB of floats
// take about 5 us at memory speed, an order above the cost of handing a chunk to a thread, and stay
// in a core's L2.
inline constexpr std::int64_t kElementsPerChunk = 16384;

// Rows of C elements that make up one such chunk.
constexpr std::int64_t rows_per_chunk(std::int64_t C) {
  return std::max<std::int64_t>(1, kElementsPerChunk / std::max<std::int64_t>(C, 1));
}

}  // namespace lvggt::kernels
