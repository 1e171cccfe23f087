// SPDX-License-Identifier: Apache-2.0
// Private: weights into panels.
#pragma once

#include "kernels/product.h"
#include "lvggt/core/float16.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt::kernels {

// A matrix of N x (taps * K) with its panels still zero; f32, bf16 or f16.
PackedMatrix empty_matrix(std::int64_t N, std::int64_t taps, std::int64_t K, Storage storage);

// Writes line `line` of output channel n.
inline void set_weight(PackedMatrix& matrix, std::int64_t n, std::int64_t line, float value) {
  const std::int64_t i =
      (n / kPanelWidth * matrix.taps * matrix.K + line) * kPanelWidth + n % kPanelWidth;
  switch (matrix.storage) {
    case Storage::kF32:
      reinterpret_cast<float*>(matrix.panels.data())[i] = value;
      break;
    case Storage::kBf16:
      reinterpret_cast<bfloat16*>(matrix.panels.data())[i] = to_bfloat16(value);
      break;
    case Storage::kF16:
      reinterpret_cast<float16*>(matrix.panels.data())[i] = to_float16(value);
      break;
    case Storage::kI8:
      break;  // empty_matrix refuses it
  }
}

// Weights of which element (n, tap, k) lies at data + n * n_stride + k * k_stride + taps[tap].
struct WeightLayout {
  const float* data = nullptr;
  std::int64_t N = 0;
  std::int64_t n_stride = 0;
  std::int64_t K = 0;
  std::int64_t k_stride = 0;
  View<const std::int64_t, 1> taps;
};

// The same as f32 panels in the arena's current scope: for weights that change with every use.
PackedPanels pack_in_arena(const WeightLayout& weight, Context& ctx);

}  // namespace lvggt::kernels
