// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "lvggt/core/parallel.h"
#include "lvggt/kernels/attention.h"
#include "lvggt/kernels/rope.h"
#include "lvggt/nn/observer.h"
#include "lvggt/nn/params.h"

namespace lvggt {

struct SelfAttention {
  Linear qkv;        // [3C, C]: q, k, v, each [num_heads, D]
  LayerNorm q_norm;  // [D]; empty without qk-norm
  LayerNorm k_norm;  // [D]
  Linear proj;       // [C, C]
  std::int64_t num_heads = 0;
};

// Computes y = attention(q) over the keys and values that the caller's mode lets it see; k and v
// are those of the tokens of q.   y, q, k, v: [N, heads, D], tokens strided; y is not q.
using Attend = FunctionRef<void(View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                                View<const float, 3> v)>;

// Buffers for the packed keys and values of `tokens` tokens, valid until the arena's scope ends.
inline PackedKeysValues alloc_keys_values(std::int64_t heads, std::int64_t tokens,
                                          std::int64_t head_dim, Context& ctx) {
  const std::int64_t bytes = keys_values_layout(Storage::kF32, heads, tokens, head_dim).size;
  return {ctx.arena().alloc<std::byte>(Shape{bytes}).data(), Storage::kF32, heads, tokens,
          head_dim};
}

inline void scaled_dot_product_attention(View<float, 3> y, View<const float, 3> q,
                                         std::span<const PackedKeysValues> past, Context& ctx) {
  const float scale = 1.0f / std::sqrt(static_cast<float>(q.extent(2)));
  scaled_dot_product_attention(y, q, past, scale, ctx);
}

// Attention inside of each group of P tokens: of a frame, or of all tokens when P = N.
//   y, q, k, v: [N, heads, D], N a multiple of P
inline void attend_within_groups(View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                                 View<const float, 3> v, std::int64_t P, Context& ctx) {
  const auto [N, heads, D] = q.shape();
  Arena::Scope scope(ctx.arena());
  const PackedKeysValues own = alloc_keys_values(heads, P, D, ctx);
  for (std::int64_t begin = 0; begin < N; begin += P) {
    pack_keys_values(own, k.narrow(0, begin, begin + P), v.narrow(0, begin, begin + P), ctx);
    scaled_dot_product_attention(y.narrow(0, begin, begin + P), q.narrow(0, begin, begin + P),
                                 std::span(&own, 1), ctx);
  }
}

// q- or k-norm: LayerNorm over the D values of every head, in place.   x: [N, heads, D]
inline void head_norm(View<float, 3> x, const LayerNorm& norm, Context& ctx) {
  if (norm.weight.empty()) return;
  layer_norm_forward(x, x, norm.weight, norm.bias, norm.eps, ctx);
}

// y = residual + gamma * proj(attention(qkv(x))), with qk-norm and rotary embedding on q and k.
//   y, residual: [N, C]   x: [N, C]   gamma: [C]   rope: null without   y may be residual; x is
//   overwritten.
inline void self_attention_forward(View<float, 2> y, View<float, 2> x, const SelfAttention& layer,
                                   View<const float, 1> gamma, View<const float, 2> residual,
                                   const RopeTable* rope, Attend attend, Observer* observer,
                                   std::int64_t layer_idx, Context& ctx) {
  const auto [N, C] = x.shape();
  const std::int64_t D = C / layer.num_heads;
  Arena::Scope scope(ctx.arena());
  const View<float, 2> qkv = ctx.arena().alloc(Shape{N, 3 * C});
  linear_forward(qkv, x, layer.qkv, {}, ctx);
  if (observer) observer->observe("qkv", layer_idx, qkv);
  const auto heads_of = [&](View<float, 2> rows, std::int64_t offset) {
    return View<float, 3>(rows.data() + offset, Shape{rows.extent(0), layer.num_heads, D},
                          {rows.stride(0), D, 1});
  };
  const View<float, 3> q = heads_of(qkv, 0), k = heads_of(qkv, C), v = heads_of(qkv, 2 * C);
  head_norm(q, layer.q_norm, ctx);
  head_norm(k, layer.k_norm, ctx);
  if (rope != nullptr) {
    rope_2d_forward(q, q, *rope, ctx);
    rope_2d_forward(k, k, *rope, ctx);
  }
  attend(heads_of(x, 0), q, k, v);
  linear_forward(y, x, layer.proj, {.gamma = gamma, .residual = residual}, ctx);
}

}  // namespace lvggt
