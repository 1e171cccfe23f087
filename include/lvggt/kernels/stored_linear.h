// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>

#include "lvggt/core/context.h"
#include "lvggt/core/storage.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// A weight [N, K] as a file has it, row by row, and used from there: for models so large that
// packing them would need their memory once more. f32, bf16 or f16, aligned to its element.
struct StoredMatrix {
  const std::byte* data = nullptr;
  Storage storage = Storage::kF32;
  std::int64_t N = 0;
  std::int64_t K = 0;
};

// y = residual + x w^T, computed in float32; the weights are widened a few rows at a time. Meant
// for tens of rows of x, where reading the weights is what takes time.
//   y, residual: [M, N], the residual may be empty   x: [M, K]   y may be residual, not x.
void stored_linear_forward(View<float, 2> y, View<const float, 2> x, const StoredMatrix& w,
                           View<const float, 2> residual, Context& ctx);

// y = row `row` of w, widened.   y: [K]
void stored_row(View<float, 1> y, const StoredMatrix& w, std::int64_t row);

}  // namespace lvggt
