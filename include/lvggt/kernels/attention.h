// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>

#include "lvggt/core/context.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt {

// Keys and values of one group of tokens (a frame, usually), packed for the attention kernel when
// they are made and never touched again. One buffer, in this order:
//   keys    [heads, num_panels(P), D, 16]     panel = 16 tokens, zero beyond P
//   values  [heads, num_panels(D), P16, 16]   panel = 16 features, P16 = P rounded up to 16, zero
//   beyond P int8 only: scales of the keys, then of the values, [heads, P16] floats each
struct PackedKeysValues {
  std::byte* data = nullptr;
  Storage storage = Storage::kF32;  // f32, bf16 or int8
  std::int64_t num_heads = 0;
  std::int64_t num_tokens = 0;  // P
  std::int64_t head_dim = 0;    // D
};

// Where the parts of such a buffer begin, in bytes, and how long it is: a multiple of 64.
struct KeysValuesLayout {
  std::int64_t values = 0, key_scales = 0, value_scales = 0, size = 0;
};
constexpr KeysValuesLayout keys_values_layout(Storage storage, std::int64_t heads,
                                              std::int64_t tokens, std::int64_t head_dim) {
  const std::int64_t padded_tokens = num_panels(tokens) * kPanelWidth;
  const std::int64_t padded_dim = num_panels(head_dim) * kPanelWidth;
  const auto bytes = static_cast<std::int64_t>(storage_bytes(storage));
  const std::int64_t scales = storage == Storage::kI8 ? heads * padded_tokens * 4 : 0;
  KeysValuesLayout layout;
  layout.values = heads * padded_tokens * head_dim * bytes;
  layout.key_scales = layout.values + heads * padded_tokens * padded_dim * bytes;
  layout.value_scales = layout.key_scales + scales;
  layout.size = (layout.value_scales + scales + 63) / 64 * 64;
  return layout;
}

// Packs k and v, both [P, heads, D] (token-strided slices of a qkv buffer are fine), into `packed`,
// whose buffer has the size above. int8 rounds a token's head to multiples of its largest magnitude
// / 127.
void pack_keys_values(PackedKeysValues packed, View<const float, 3> k, View<const float, 3> v,
                      Context& ctx);

// y = softmax(scale q k^T) v, head by head, over the keys of all groups in `past`. The maximum and
// the sum of a row's exponentials are updated key block by key block, so that no Nq x Nk matrix
// exists: the memory beside the operands does not depend on Nk.
//   y, q: [Nq, heads, D]   y may be q.
void scaled_dot_product_attention(View<float, 3> y, View<const float, 3> q,
                                  std::span<const PackedKeysValues> past, float scale,
                                  Context& ctx);

}  // namespace lvggt
