// SPDX-License-Identifier: Apache-2.0
// Private: the product behind linear, convolution and transposed convolution.
#pragma once

#include <cstddef>
#include <cstdint>

#include "kernels/chunks.h"
#include "lvggt/core/context.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/epilogue.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt::kernels {

// Lines of a panel summed before moving on: 256 lines of one panel are 16 KiB, half of a
// first-level cache.
inline constexpr std::int64_t kBlockK = 256;
// The same for several taps together: 9 taps of 32 channels are one block.
inline constexpr std::int64_t kMostLines = 320;
// Row pitch of sums: not a multiple of 4 KiB, so that rows do not compete for the same cache sets.
inline constexpr std::int64_t kSumPitch = kChunkPanels * kPanelWidth + 16;

// Rows [begin, begin + count) of a product, as addresses: a linear layer has one input row for each
// output row, a convolution one for every tap (a pixel, or a row of zeros beyond the border).
struct RowTable {
  std::int64_t begin = 0;
  std::int64_t count = 0;
  int worker = 0;                    // whose scratch gathered inputs may use
  std::int64_t capacity = 0;         // distance between the inputs of two taps
  const float** x = nullptr;         // [taps, capacity]
  float** y = nullptr;               // [capacity]
  const float** residual = nullptr;  // [capacity]; unused without a residual
};

// Packed weights, wherever they lie: in a PackedMatrix, or in scratch for one call.
struct PackedPanels {
  std::int64_t N = 0;  // output channels
  Storage storage = Storage::kF32;
  const std::byte* panels = nullptr;
  const float* scales = nullptr;              // int8 only
  const std::int32_t* weight_sums = nullptr;  // int8 only

  PackedPanels() = default;
  PackedPanels(const PackedMatrix& matrix)  // NOLINT: implicit by design
      : N(matrix.N),
        storage(matrix.storage),
        panels(matrix.panels.data()),
        scales(matrix.scales.data()),
        weight_sums(matrix.weight_sums.data()) {}
  PackedPanels(std::int64_t channels, const float* values)
      : N(channels), panels(reinterpret_cast<const std::byte*>(values)) {}
};

// y[m] = residual[m] + gamma * activation(sum over taps t of x[t][m] w_t^T + bias)
struct Product {
  std::int64_t M = 0;
  PackedPanels w;
  std::int64_t taps =
      0;  // taps * K lines a panel: the weight's own, or neighbouring taps read as one
  std::int64_t K = 0;
  const float* bias = nullptr;
  Activation activation = Activation::kNone;
  const float* gamma = nullptr;
  bool has_residual = false;
};

// Runs a product with f32, bf16 or f16 weights; gather(table) fills in the addresses of the rows it
// is asked for. It is called from worker threads and may run more than once for the same rows.
void run_product(const Product& product, FunctionRef<void(const RowTable&)> gather, Context& ctx);

// Runs a product with int8 weights: each row of x is rounded to multiples of its largest magnitude
// / 127, the integers are multiplied and summed exactly.
//   x: [M, K]
void run_product_int8(const Product& product, View<const float, 2> x,
                      FunctionRef<void(const RowTable&)> gather, Context& ctx);

}  // namespace lvggt::kernels
