// SPDX-License-Identifier: Apache-2.0
#include "kernels/pack.h"

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>

#include "lvggt/core/parallel.h"

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

PackedPanels pack_in_arena(const WeightLayout& weight, Context& ctx) {
  const std::int64_t taps = weight.taps.extent(0), K = weight.K;
  const std::int64_t panels = num_panels(weight.N);
  const View<float, 3> lines = ctx.arena().alloc(Shape{panels, taps * K, kPanelWidth});
  // Parts of a panel's channels too, so that few wide panels are shared out as well.
  constexpr std::int64_t kGrain = 64;
  const std::int64_t parts = (K + kGrain - 1) / kGrain;
  parallel_chunks(
      panels * parts,
      [&](std::int64_t chunk, int) {
        const std::int64_t panel = chunk / parts, first = chunk % parts * kGrain;
        const std::int64_t width = std::min(kPanelWidth, weight.N - panel * kPanelWidth);
        const float* from = weight.data + panel * kPanelWidth * weight.n_stride;
        float* to = lines[panel].data();
        const std::int64_t last = std::min(K, first + kGrain);
        const auto set = [&](std::int64_t n, std::int64_t k) {
          for (std::int64_t t = 0; t < taps; ++t)
            to[(t * K + k) * kPanelWidth + n] =
                from[n * weight.n_stride + k * weight.k_stride + weight.taps[t]];
        };
        // Neighbours in memory one after the other: rows a power of two apart share cache sets.
        if (weight.n_stride < weight.k_stride) {
          for (std::int64_t k = first; k < last; ++k)
            for (std::int64_t n = 0; n < width; ++n) set(n, k);
        } else {
          for (std::int64_t n = 0; n < width; ++n)
            for (std::int64_t k = first; k < last; ++k) set(n, k);
        }
        for (std::int64_t t = 0; t < taps && width < kPanelWidth; ++t)
          for (std::int64_t k = first; k < last; ++k)
            std::fill_n(to + (t * K + k) * kPanelWidth + width, kPanelWidth - width, 0.0f);
      },
      ctx);
  return PackedPanels(weight.N, lines.data());
}

}  // namespace kernels

namespace {

// An int8 matrix with its panels still zero.
PackedMatrix empty_int8(std::int64_t N, std::int64_t K) {
  const std::int64_t quads = (K + 3) / 4;
  const std::int64_t padded = num_panels(N) * kPanelWidth;
  return {N,
          1,
          K,
          Storage::kI8,
          Tensor<std::byte, 1>(Shape{padded * quads * 4}),
          Tensor<float, 1>(Shape{padded}),
          Tensor<std::int32_t, 1>(Shape{padded})};
}

void set_channel(PackedMatrix& packed, std::int64_t n, const std::int8_t* integers, float scale) {
  const std::int64_t quads = (packed.K + 3) / 4;
  auto* lines = reinterpret_cast<std::int8_t*>(packed.panels.data()) +
                (n / kPanelWidth * quads * kPanelWidth + n % kPanelWidth) * 4;
  std::int32_t sum = 0;
  for (std::int64_t k = 0; k < packed.K; ++k) {
    lines[k / 4 * kPanelWidth * 4 + k % 4] = integers[k];
    sum += integers[k];
  }
  packed.scales(n) = scale;
  packed.weight_sums(n) = sum;
}

PackedMatrix pack_int8(View<const float, 2> weight) {
  const auto [N, K] = weight.shape();
  PackedMatrix packed = empty_int8(N, K);
  Tensor<std::int8_t, 1> integers(Shape{K});
  for (std::int64_t n = 0; n < N; ++n) {
    const float scale = quantize_channel(integers.data(), weight.data() + n * weight.stride(0), K);
    set_channel(packed, n, integers.data(), scale);
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

PackedMatrix pack_linear(View<const std::int8_t, 2> integers, View<const float, 1> scales) {
  const auto [N, K] = integers.shape();
  LVGGT_CHECK(scales.extent(0) == N, "pack_linear: integers are ", integers.shape(),
              " but scales are ", scales.shape());
  PackedMatrix packed = empty_int8(N, K);
  for (std::int64_t n = 0; n < N; ++n)
    set_channel(packed, n, integers.data() + n * integers.stride(0), scales(n));
  return packed;
}

float quantize_channel(std::int8_t* integers, const float* weights, std::int64_t K) {
  float largest = 0, poison = 0;  // x - x: 0, or NaN for NaN and infinity
  for (std::int64_t k = 0; k < K; ++k) {
    largest = std::max(largest, std::abs(weights[k]));
    poison += weights[k] - weights[k];
  }
  const float scale = largest / kInt8WeightMax + poison;
  if (!(scale >= std::numeric_limits<float>::min())) {
    std::fill_n(integers, K, std::int8_t{0});
    return poison;
  }
  const float inverse = 1 / scale;
  // Adding 1.5 * 2^23 rounds to the nearest integer and leaves it in the low bits.
  constexpr float kRound = 12582912.0f;
  for (std::int64_t k = 0; k < K; ++k)
    integers[k] =
        static_cast<std::int8_t>(std::bit_cast<std::int32_t>(weights[k] * inverse + kRound) -
                                 std::bit_cast<std::int32_t>(kRound));
  return scale;
}

}  // namespace lvggt
