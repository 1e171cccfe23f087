// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <bit>
#include <cmath>

#include "lvggt/core/float16.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/attention.h"

namespace lvggt {

namespace {

struct KeepFloat {
  using Stored = float;
  static Stored store(float x, float) { return x; }
};
struct RoundToBfloat16 {
  using Stored = bfloat16;
  static Stored store(float x, float) { return to_bfloat16(x); }
};
struct RoundToInt8 {
  using Stored = std::int8_t;
  // Adding 1.5 * 2^23 rounds to the nearest integer and leaves it in the low bits.
  static Stored store(float x, float inverse) {
    return static_cast<std::int8_t>(std::bit_cast<std::uint32_t>(x * inverse + 12582912.0f));
  }
};

// Scale of a token's head, and what to multiply by to get integers; NaN and infinity make the scale
// NaN, so that they are not lost.
struct Int8Scale {
  float scale = 0, inverse = 0;
};
Int8Scale int8_scale(const float* x, std::int64_t D) {
  float largest = 0, poison = 0;
  for (std::int64_t i = 0; i < D; ++i) {
    largest = std::max(largest, std::abs(x[i]));
    poison += x[i] - x[i];
  }
  return {largest / 127 + poison, largest > 0 && poison == 0 ? 127 / largest : 0.0f};
}

// All tokens of one head.
template <class Rounding>
void pack_head(const PackedKeysValues& packed, View<const float, 3> k, View<const float, 3> v,
               std::int64_t head) {
  using Stored = typename Rounding::Stored;
  const std::int64_t P = packed.num_tokens, D = packed.head_dim;
  const KeysValuesLayout layout = keys_values_layout(packed.storage, packed.num_heads, P, D);
  const std::int64_t padded = num_panels(P) * kPanelWidth, feature_panels = num_panels(D);
  auto* keys = reinterpret_cast<Stored*>(packed.data) + head * padded * D;
  auto* values = reinterpret_cast<Stored*>(packed.data + layout.values) +
                 head * feature_panels * kPanelWidth * padded;
  auto* key_scales = reinterpret_cast<float*>(packed.data + layout.key_scales) + head * padded;
  auto* value_scales = reinterpret_cast<float*>(packed.data + layout.value_scales) + head * padded;
  for (std::int64_t t = 0; t < padded; ++t) {
    Stored* to_k = keys + t / kPanelWidth * D * kPanelWidth + t % kPanelWidth;
    Stored* to_v = values + t * kPanelWidth;
    Int8Scale k_scale, v_scale;
    if (t >= P) {  // tokens that fill up the last panel
      for (std::int64_t i = 0; i < D; ++i) to_k[i * kPanelWidth] = Stored{};
      for (std::int64_t f = 0; f < feature_panels; ++f)
        std::fill_n(to_v + f * padded * kPanelWidth, kPanelWidth, Stored{});
    } else {
      const float* from_k = k.data() + t * k.stride(0) + head * k.stride(1);
      const float* from_v = v.data() + t * v.stride(0) + head * v.stride(1);
      if constexpr (std::is_same_v<Rounding, RoundToInt8>) {
        k_scale = int8_scale(from_k, D);
        v_scale = int8_scale(from_v, D);
      }
      for (std::int64_t i = 0; i < D; ++i)
        to_k[i * kPanelWidth] = Rounding::store(from_k[i], k_scale.inverse);
      for (std::int64_t f = 0; f < feature_panels; ++f) {
        Stored* line = to_v + f * padded * kPanelWidth;
        const std::int64_t n = std::min(kPanelWidth, D - f * kPanelWidth);
        for (std::int64_t i = 0; i < n; ++i)
          line[i] = Rounding::store(from_v[f * kPanelWidth + i], v_scale.inverse);
        std::fill(line + n, line + kPanelWidth, Stored{});
      }
    }
    if constexpr (std::is_same_v<Rounding, RoundToInt8>) {
      key_scales[t] = k_scale.scale;
      value_scales[t] = v_scale.scale;
    }
  }
}

}  // namespace

void pack_keys_values(PackedKeysValues packed, View<const float, 3> k, View<const float, 3> v,
                      Context& ctx) {
  const Shape expected{packed.num_tokens, packed.num_heads, packed.head_dim};
  LVGGT_CHECK(k.shape() == expected && v.shape() == expected, "pack_keys_values: k is ", k.shape(),
              " and v is ", v.shape(), " but the packed group is ", expected);
  if (packed.storage == Storage::kF16)
    fail(ErrorKind::kUnsupported,
         "pack_keys_values: keys and values are stored as f32, bf16 or int8, not as f16");
  parallel_chunks(
      packed.num_heads,
      [&](std::int64_t head, int) {
        switch (packed.storage) {
          case Storage::kBf16:
            return pack_head<RoundToBfloat16>(packed, k, v, head);
          case Storage::kI8:
            return pack_head<RoundToInt8>(packed, k, v, head);
          default:
            return pack_head<KeepFloat>(packed, k, v, head);
        }
      },
      ctx);
}

}  // namespace lvggt
