// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "lvggt/nn/block.h"
#include "lvggt/nn/patch_embed.h"

namespace lvggt {

// The DINOv2 encoder with register tokens.
struct VisionTransformer {
  PatchEmbed patch_embed;
  Tensor<float, 2> cls_token;        // [1, C]
  Tensor<float, 2> register_tokens;  // [R, C]
  Tensor<float, 2> pos_embed;        // [1 + side*side, C]
  std::int64_t pos_embed_side = 0;
  std::vector<Block> blocks;
  LayerNorm norm;  // [C]
};

// Patch tokens of one frame; class and register tokens take part and are dropped.
//   patch_tokens: [h*w, C]   pixels: [H, W, 3], RGB in [0, 1]
//   pos_embed: [1 + h*w, C], resized to the frame's patches (resize_pos_embed)
// The observer sees "dino.tokens_in", every "dino.block" and "dino.patch_tokens".
inline void vision_transformer_forward(View<float, 2> patch_tokens, View<const float, 3> pixels,
                                       const VisionTransformer& vit, View<const float, 2> pos_embed,
                                       Observer* observer, Context& ctx) {
  const auto [hw, C] = patch_tokens.shape();
  const std::int64_t R = vit.register_tokens.extent(0);
  Arena::Scope scope(ctx.arena());
  const View<float, 2> tokens = ctx.arena().alloc(Shape{1 + R + hw, C});
  // The class token has a position, the registers, inserted after it, have none.
  for (std::int64_t c = 0; c < C; ++c) tokens(0, c) = vit.cls_token(0, c) + pos_embed(0, c);
  std::copy_n(vit.register_tokens.data(), R * C, tokens.data() + C);
  patch_embed_forward(tokens.narrow(0, 1 + R, 1 + R + hw), pixels, vit.patch_embed,
                      pos_embed.narrow(0, 1, 1 + hw), ctx);
  if (observer) observer->observe("dino.tokens_in", 0, tokens);

  const std::int64_t N = tokens.extent(0);
  const auto attend = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                          View<const float, 3> v) { attend_within_groups(y, q, k, v, N, ctx); };
  for (std::size_t i = 0; i < vit.blocks.size(); ++i) {
    block_forward(tokens, vit.blocks[i], {.attend = attend}, ctx);
    if (observer) observer->observe("dino.block", static_cast<std::int64_t>(i), tokens);
  }
  layer_norm_forward(patch_tokens, tokens.narrow(0, 1 + R, N), vit.norm, ctx);
  if (observer) observer->observe("dino.patch_tokens", 0, patch_tokens);
}

}  // namespace lvggt
