// SPDX-License-Identifier: Apache-2.0
#include "kernels/pack.h"

#include <algorithm>
#include <cmath>

namespace lvggt {

namespace kernels {

PackedMatrix empty_matrix(std::int64_t N, std::int64_t taps, std::int64_t K, Storage storage) {
  if (storage == Storage::kI8)
    fail(ErrorKind::kUnsupported, "pack: int8 is a storage for linear layers only, not for ", taps,
         " taps");
  const std::int64_t values = num_panels(N) * taps * K * kPanelWidth;
  PackedMatrix matrix{N, taps, K, storage, {}, {}, {}};
  matrix.panels =
      Tensor<std::byte, 1>(Shape{values * static_cast<std::int64_t>(storage_bytes(storage))});
  return matrix;
}

}  // namespace kernels

namespace {

PackedMatrix pack_int8(View<const float, 2> weight) {
  const auto [N, K] = weight.shape();
  const std::int64_t quads = (K + 3) / 4;
  const std::int64_t padded = num_panels(N) * kPanelWidth;
  PackedMatrix packed{N,
                      1,
                      K,
                      Storage::kI8,
                      Tensor<std::byte, 1>(Shape{padded * quads * 4}),
                      Tensor<float, 1>(Shape{padded}),
                      Tensor<std::int32_t, 1>(Shape{padded})};
  for (std::int64_t n = 0; n < N; ++n) {
    const float* row = weight.data() + n * weight.stride(0);
    float largest = 0;
    for (std::int64_t k = 0; k < K; ++k) largest = std::max(largest, std::abs(row[k]));
    const float scale = largest / kInt8WeightMax;
    packed.scales(n) = scale;
    const float inverse = scale > 0 ? 1 / scale : 0;
    auto* lines = reinterpret_cast<std::int8_t*>(packed.panels.data()) +
                  (n / kPanelWidth * quads * kPanelWidth + n % kPanelWidth) * 4;
    for (std::int64_t k = 0; k < K; ++k) {
      const auto q = static_cast<std::int8_t>(std::clamp(
          std::nearbyint(row[k] * inverse), -1.0f * kInt8WeightMax, 1.0f * kInt8WeightMax));
      lines[k / 4 * kPanelWidth * 4 + k % 4] = q;
      packed.weight_sums(n) += q;
    }
  }
  return packed;
}

}  // namespace

PackedMatrix pack_linear(View<const float, 2> weight, Storage storage) {
  if (storage == Storage::kI8) return pack_int8(weight);
  const auto [N, K] = weight.shape();
  PackedMatrix packed = kernels::empty_matrix(N, 1, K, storage);
  for (std::int64_t n = 0; n < N; ++n) {
    const float* row = weight.data() + n * weight.stride(0);
    for (std::int64_t k = 0; k < K; ++k) kernels::set_weight(packed, n, k, row[k]);
  }
  return packed;
}

}  // namespace lvggt
