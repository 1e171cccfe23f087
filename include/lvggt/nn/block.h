// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/nn/mlp.h"
#include "lvggt/nn/self_attention.h"

namespace lvggt {

// A transformer block with LayerScale.
struct Block {
  LayerNorm norm1;  // [C]
  SelfAttention attn;
  Tensor<float, 1> ls1;  // gamma, [C]
  LayerNorm norm2;       // [C]
  Mlp mlp;
  Tensor<float, 1> ls2;  // gamma, [C]
};

// What a block needs beside its tokens. The observer sees the qkv projection before qk-norm and
// rotary embedding as "qkv" of block_idx.
struct BlockRun {
  Attend attend;
  const RopeTable* rope = nullptr;  // null: no rotary embedding
  Observer* observer = nullptr;
  std::int64_t block_idx = 0;
};

// x += ls1 * attn(norm1(x)); x += ls2 * mlp(norm2(x)).   x: [N, C], in place, rows may be strided.
inline void block_forward(View<float, 2> x, const Block& block, const BlockRun& run, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const View<float, 2> normed = ctx.arena().alloc(x.shape());
  layer_norm_forward(normed, x, block.norm1, ctx);
  self_attention_forward(x, normed, block.attn, block.ls1, x, run.rope, run.attend, run.observer,
                         run.block_idx, ctx);
  layer_norm_forward(normed, x, block.norm2, ctx);
  mlp_forward(x, normed, block.mlp, block.ls2, x, ctx);
}

}  // namespace lvggt
