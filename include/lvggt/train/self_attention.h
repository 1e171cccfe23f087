// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lvggt/kernels/layer_norm.h"
#include "lvggt/kernels/rope_backward.h"
#include "lvggt/train/attention.h"
#include "lvggt/train/layer_parameters.h"

namespace lvggt {

// What a block of the encoder needs beside its tokens and parameters.
struct BlockSettings {
  std::int64_t num_heads = 0;
  float norm_eps = 0;               // of every layer norm: 1e-6 in DINOv2, 1e-5 in the aggregator
  FrameMask mask{};                 // which tokens see each other
  const RopeTable* rope = nullptr;  // null: no rotary embedding
};

template <class T>
struct SelfAttentionParameters {
  LinearParameters<T> qkv;   // [3C, C]: q, k, v, each [num_heads, D]
  NormParameters<T> q_norm;  // [D]; empty without qk-norm
  NormParameters<T> k_norm;  // [D]
  LinearParameters<T> proj;  // [C, C]
};

// Row statistics of a layer norm, kept for its backward pass; of a q- or k-norm head by head.
template <int R>
struct LayerNormStatistics {
  View<float, R> mean, rstd;  // [N], or [num_heads, N]
};

struct SelfAttentionActivations {
  View<const float, 2> x;                            // [N, C], the caller's
  View<float, 2> qkv;                                // [N, 3C], as projected
  std::array<View<float, 3>, 2> qk;                  // [N, num_heads, D], normed and turned
  std::array<LayerNormStatistics<2>, 2> statistics;  // of q-norm and k-norm
  View<float, 2> attended;                           // [N, C], what proj reads
};

// q, k or v (part 0, 1, 2) of rows [q | k | v], as heads.
template <class T>
View<T, 3> qkv_part(View<T, 2> qkv, std::int64_t part, std::int64_t num_heads) {
  const std::int64_t C = qkv.extent(1) / 3;
  return View<T, 3>(qkv.data() + part * C, Shape{qkv.extent(0), num_heads, C / num_heads},
                    {qkv.stride(0), C / num_heads, 1});
}

// q or k as attention takes it: normed over each head and turned by the rotary embedding, in new
// memory unless neither is wanted.   raw: [N, heads, D]
inline View<float, 3> norm_and_turn(LayerNormStatistics<2>& kept, View<float, 3> raw,
                                    const NormParameters<const float>& norm,
                                    const BlockSettings& settings, Context& ctx) {
  if (norm.gamma.empty() && settings.rope == nullptr) return raw;
  const std::int64_t N = raw.extent(0), heads = raw.extent(1);
  const View<float, 3> y = ctx.arena().alloc(raw.shape());
  if (norm.gamma) {
    kept = {ctx.arena().alloc(Shape{heads, N}), ctx.arena().alloc(Shape{heads, N})};
    for (std::int64_t head = 0; head < heads; ++head)
      layer_norm_forward(head_rows(y, head), kept.mean[head], kept.rstd[head], head_rows(raw, head),
                         norm.gamma, norm.beta, settings.norm_eps, ctx);
  }
  if (settings.rope) rope_2d_forward(y, norm.gamma ? y : raw, *settings.rope, ctx);
  return y;
}

// dx: [N, heads, D], comes in as the gradient of what norm_and_turn returned
inline void norm_and_turn_backward(View<float, 3> dx, const NormParameters<float>& gradient,
                                   const LayerNormStatistics<2>& kept, View<const float, 3> raw,
                                   const NormParameters<const float>& norm,
                                   const BlockSettings& settings, Context& ctx) {
  if (settings.rope) rope_2d_backward(dx, dx, *settings.rope, ctx);
  if (norm.gamma.empty()) return;
  for (std::int64_t head = 0; head < raw.extent(1); ++head)
    layer_norm_backward(head_rows(dx, head), gradient.gamma, gradient.beta, head_rows(dx, head),
                        kept.mean[head], kept.rstd[head], head_rows(raw, head), norm.gamma, ctx);
}

// y = proj(attention(qkv(x))), with qk-norm and rotary embedding on q and k. What is kept lies in
// the arena's current scope.   y, x: [N, C]
inline void self_attention_forward(View<float, 2> y, SelfAttentionActivations& kept,
                                   View<const float, 2> x,
                                   const SelfAttentionParameters<const float>& layer,
                                   const BlockSettings& settings, Context& ctx) {
  const auto [N, C] = x.shape();
  const std::int64_t heads = settings.num_heads;
  LVGGT_CHECK(heads > 0 && C % heads == 0, "self_attention: x is ", x.shape(), " but there are ",
              heads, " heads");
  kept.x = x;
  kept.qkv = ctx.arena().alloc(Shape{N, 3 * C});
  linear_forward(kept.qkv, x, layer.qkv.weight, {.bias = layer.qkv.bias}, ctx);
  for (std::size_t i : {0, 1})
    kept.qk[i] =
        norm_and_turn(kept.statistics[i], qkv_part(kept.qkv, static_cast<std::int64_t>(i), heads),
                      i == 0 ? layer.q_norm : layer.k_norm, settings, ctx);
  kept.attended = ctx.arena().alloc(x.shape());
  attention_forward(View<float, 3>(kept.attended.data(), Shape{N, heads, C / heads}), kept.qk[0],
                    kept.qk[1], qkv_part(kept.qkv, 2, heads), settings.mask, ctx);
  linear_forward(y, kept.attended, layer.proj.weight, {.bias = layer.proj.bias}, ctx);
}

// The layers of the forward pass in reverse, each by its own backward pass. An empty gradient, of x
// or of a parameter, is not wanted.   dx, dy: [N, C]
inline void self_attention_backward(View<float, 2> dx,
                                    const SelfAttentionParameters<float>& gradient,
                                    View<const float, 2> dy, const SelfAttentionActivations& kept,
                                    const SelfAttentionParameters<const float>& layer,
                                    const BlockSettings& settings, Context& ctx) {
  const auto [N, C] = dy.shape();
  const std::int64_t heads = settings.num_heads;
  Arena::Scope scope(ctx.arena());
  const View<float, 2> dattended = ctx.arena().alloc(dy.shape());
  const View<float, 2> dqkv = ctx.arena().alloc(kept.qkv.shape());
  linear_backward(dattended, gradient.proj.weight, gradient.proj.bias, dy, kept.attended,
                  layer.proj.weight, ctx);
  const View<float, 3> dq = qkv_part(dqkv, 0, heads), dk = qkv_part(dqkv, 1, heads);
  attention_backward(dq, dk, qkv_part(dqkv, 2, heads),
                     View<const float, 3>(dattended.data(), Shape{N, heads, C / heads}), kept.qk[0],
                     kept.qk[1], qkv_part(kept.qkv, 2, heads), settings.mask, ctx);
  norm_and_turn_backward(dq, gradient.q_norm, kept.statistics[0], qkv_part(kept.qkv, 0, heads),
                         layer.q_norm, settings, ctx);
  norm_and_turn_backward(dk, gradient.k_norm, kept.statistics[1], qkv_part(kept.qkv, 1, heads),
                         layer.k_norm, settings, ctx);
  linear_backward(dx, gradient.qkv.weight, gradient.qkv.bias, dqkv, kept.x, layer.qkv.weight, ctx);
}

}  // namespace lvggt
