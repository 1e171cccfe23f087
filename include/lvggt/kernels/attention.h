// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

#include "lvggt/core/context.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt {

// Keys and values of one group of tokens (a frame, usually), packed for the attention kernel when they are
// made and never touched again:
//   keys    [heads, num_panels(P), D, 16]     panel = 16 tokens, zero beyond P
//   values  [heads, num_panels(D), P16, 16]   panel = 16 features, P16 = P rounded up to 16, zero beyond P
struct PackedKeysValues {
  float* keys = nullptr;
  float* values = nullptr;
  std::int64_t num_heads = 0;
  std::int64_t num_tokens = 0;  // P
  std::int64_t head_dim = 0;    // D
};

// Floats that the keys, or the values, of such a group take.
constexpr std::int64_t packed_keys_size(std::int64_t heads, std::int64_t tokens, std::int64_t head_dim) {
  return heads * num_panels(tokens) * kPanelWidth * head_dim;
}
constexpr std::int64_t packed_values_size(std::int64_t heads, std::int64_t tokens,
                                          std::int64_t head_dim) {
  return heads * num_panels(head_dim) * kPanelWidth * num_panels(tokens) * kPanelWidth;
}

// Packs k and v, both [P, heads, D] (token-strided slices of a qkv buffer are fine), into `packed`, whose
// buffers have the sizes above.
void pack_keys_values(PackedKeysValues packed, View<const float, 3> k, View<const float, 3> v,
                      Context& ctx);

// y = softmax(scale q k^T) v, head by head, over the keys of all groups in `past`. The maximum and the sum of
// a row's exponentials are updated key block by key block, so that no Nq x Nk matrix exists: the memory
// beside the operands does not depend on Nk.
//   y, q: [Nq, heads, D]   y may be q.
void scaled_dot_product_attention(View<float, 3> y, View<const float, 3> q,
                                  std::span<const PackedKeysValues> past, float scale, Context& ctx);

}  // namespace lvggt
