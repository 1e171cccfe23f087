// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/kernels/layer_scale.h"
#include "lvggt/train/self_attention.h"

namespace lvggt {

// A transformer block of the geometry encoder in training: for fine-tuning some of its blocks, or
// for probing how a result depends on them, with a training loop of one's own. lvggt's programs
// keep the encoder frozen.

// With T = const float the weights, with T = float their gradients. A gradient left empty is not
// computed: a frozen parameter.
template <class T>
struct BlockParameters {
  NormParameters<T> norm1;  // [C]
  SelfAttentionParameters<T> attn;
  View<T, 1> ls1;           // LayerScale, [C]
  NormParameters<T> norm2;  // [C]
  LinearParameters<T> fc1;  // of the MLP, [hidden, C]
  LinearParameters<T> fc2;  // [C, hidden]
  View<T, 1> ls2;           // [C]
};

// Calls visit(name, view) for every parameter with its name in the published checkpoint behind the
// block's own ("aggregator.frame_blocks.3."), to bind, zero or update it.
template <class Parameters, class Visit>
void for_each_param(Parameters& block, const Visit& visit) {
  const auto both = [&](const std::string& name, auto& weight, auto& bias) {
    visit(name + ".weight", weight);
    visit(name + ".bias", bias);
  };
  both("norm1", block.norm1.gamma, block.norm1.beta);
  both("attn.qkv", block.attn.qkv.weight, block.attn.qkv.bias);
  both("attn.q_norm", block.attn.q_norm.gamma, block.attn.q_norm.beta);
  both("attn.k_norm", block.attn.k_norm.gamma, block.attn.k_norm.beta);
  both("attn.proj", block.attn.proj.weight, block.attn.proj.bias);
  visit(std::string("ls1.gamma"), block.ls1);
  both("norm2", block.norm2.gamma, block.norm2.beta);
  both("mlp.fc1", block.fc1.weight, block.fc1.bias);
  both("mlp.fc2", block.fc2.weight, block.fc2.bias);
  visit(std::string("ls2.gamma"), block.ls2);
}

// What the backward pass needs: 9 C + 2 hidden floats a token, 2 C more with qk-norm or rotary
// embedding.
struct BlockActivations {
  View<const float, 2> x;  // [N, C], the caller's
  LayerNormStatistics<1> norm1, norm2;
  SelfAttentionActivations attn;
  View<float, 2> normed1, normed2;  // [N, C]
  View<float, 2> branch1, branch2;  // attn(norm1(x)) and mlp(norm2(middle)), before LayerScale
  View<float, 2> middle;            // x + ls1 branch1
  View<float, 2> sum, hidden;       // fc1's output and gelu of it, [N, hidden]
};

// y = layer norm of x into new memory, its statistics kept.
inline View<float, 2> block_norm_forward(LayerNormStatistics<1>& kept, View<const float, 2> x,
                                         const NormParameters<const float>& norm, float eps,
                                         Context& ctx) {
  const Shape rows{x.extent(0)};
  kept = {ctx.arena().alloc(rows), ctx.arena().alloc(rows)};
  const View<float, 2> y = ctx.arena().alloc(x.shape());
  layer_norm_forward(y, kept.mean, kept.rstd, x, norm.gamma, norm.beta, eps, ctx);
  return y;
}

// middle = x + ls1 attn(norm1(x)); y = middle + ls2 fc2(gelu(fc1(norm2(middle)))). What is kept
// lies in the arena's current scope.   y, x: [N, C]; y is not x
inline void block_forward(View<float, 2> y, BlockActivations& kept, View<const float, 2> x,
                          const BlockParameters<const float>& block, const BlockSettings& settings,
                          Context& ctx) {
  Arena& arena = ctx.arena();
  kept.x = x;
  kept.normed1 = block_norm_forward(kept.norm1, x, block.norm1, settings.norm_eps, ctx);
  kept.branch1 = arena.alloc(x.shape());
  self_attention_forward(kept.branch1, kept.attn, kept.normed1, block.attn, settings, ctx);
  kept.middle = arena.alloc(x.shape());
  layer_scale_forward(kept.middle, kept.branch1, block.ls1, x, ctx);

  kept.normed2 = block_norm_forward(kept.norm2, kept.middle, block.norm2, settings.norm_eps, ctx);
  kept.sum = arena.alloc(Shape{x.extent(0), block.fc1.weight.extent(0)});
  kept.hidden = arena.alloc(kept.sum.shape());
  kept.branch2 = arena.alloc(x.shape());
  linear_forward(kept.sum, kept.normed2, block.fc1.weight, {.bias = block.fc1.bias}, ctx);
  activation_forward(kept.hidden, kept.sum, Activation::kGelu, ctx);
  linear_forward(kept.branch2, kept.hidden, block.fc2.weight, {.bias = block.fc2.bias}, ctx);
  layer_scale_forward(y, kept.branch2, block.ls2, kept.middle, ctx);
}

// The layers in reverse. Each half is a residual connection z + branch(norm(z)), so the gradient of
// z is dy plus what comes back through the branch. An empty dx is not wanted.   dx, dy: [N, C]
inline void block_backward(View<float, 2> dx, const BlockParameters<float>& gradient,
                           View<const float, 2> dy, const BlockActivations& kept,
                           const BlockParameters<const float>& block, const BlockSettings& settings,
                           Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const View<float, 2> dbranch = ctx.arena().alloc(dy.shape());
  const View<float, 2> dmiddle = ctx.arena().alloc(dy.shape());
  const View<float, 2> dhidden = ctx.arena().alloc(kept.hidden.shape());
  layer_scale_backward(dbranch, gradient.ls2, dy, kept.branch2, block.ls2, ctx);
  linear_backward(dhidden, gradient.fc2.weight, gradient.fc2.bias, dbranch, kept.hidden,
                  block.fc2.weight, ctx);
  gelu_backward(dhidden, dhidden, kept.sum, ctx);
  linear_backward(dmiddle, gradient.fc1.weight, gradient.fc1.bias, dhidden, kept.normed2,
                  block.fc1.weight, ctx);
  layer_norm_backward(dmiddle, gradient.norm2.gamma, gradient.norm2.beta, dmiddle, kept.norm2.mean,
                      kept.norm2.rstd, kept.middle, block.norm2.gamma, ctx);
  accumulate(dmiddle, dy, ctx);

  layer_scale_backward(dbranch, gradient.ls1, dmiddle, kept.branch1, block.ls1, ctx);
  const View<float, 2> dnormed = ctx.arena().alloc(dy.shape());
  self_attention_backward(dnormed, gradient.attn, dbranch, kept.attn, block.attn, settings, ctx);
  layer_norm_backward(dnormed, gradient.norm1.gamma, gradient.norm1.beta, dnormed, kept.norm1.mean,
                      kept.norm1.rstd, kept.x, block.norm1.gamma, ctx);
  if (dx) add(dx, dnormed, dmiddle, ctx);
}

}  // namespace lvggt
