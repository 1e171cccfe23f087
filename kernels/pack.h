// SPDX-License-Identifier: Apache-2.0
// Private: weights into panels.
#pragma once

#include <span>

#include "lvggt/core/context.h"
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

// A float32 matrix from weights in any order, on the threads of ctx: for training, where they
// change with every step. Line t * K + k of output channel n is
//   weight[n * n_stride + k * k_stride + tap_offsets[t]]
PackedMatrix pack_strided(const float* weight, std::int64_t N, std::int64_t n_stride,
                          std::int64_t K, std::int64_t k_stride,
                          std::span<const std::int64_t> tap_offsets, Context& ctx);

}  // namespace lvggt::kernels
