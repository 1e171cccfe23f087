// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lvggt/nn/params.h"
#include "lvggt/nn/position_embedding.h"

namespace lvggt {

// Tokens of the four taps to four feature maps of 4, 2, 1 and 1/2 times the patch grid.
struct Reassemble {
  LayerNorm norm;                    // [2C], shared by the taps
  std::array<Linear, 4> projects;    // 1x1 convolutions: [out_i, 2C]
  ConvTranspose2d resize0, resize1;  // 4x4 s4, 2x2 s2
  Conv2d resize3;                    // 3x3 s2 p1; tap 2 is not resized
  std::array<Conv2d, 4> layer_rn;    // 3x3 without bias, to F channels
};

// Size of map i for a grid of h x w patches.
inline Shape<3> reassembled_shape(const Reassemble& layer, std::size_t i, std::int64_t h,
                                  std::int64_t w) {
  const std::int64_t F = layer.layer_rn[i].weight.matrix.N;
  if (i < 2) return Shape{h << (2 - i), w << (2 - i), F};
  if (i == 2) return Shape{h, w, F};
  const Shape<3> halved = conv2d_shape(layer.resize3, h, w);
  return Shape{halved[0], halved[1], F};
}

// y = layer{i+1}_rn(resize_i(project_i(norm(tokens)) + embedding)).
//   y: reassembled_shape   tokens: [h*w, 2C], patch tokens of tap i
//   embedding: of the patch grid in out_i channels, or null
inline void reassemble_forward(View<float, 3> y, View<const float, 2> tokens,
                               const Reassemble& layer, std::size_t i, std::int64_t h,
                               std::int64_t w, const PositionEmbedding* embedding, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const View<float, 2> normed = ctx.arena().alloc(tokens.shape());
  layer_norm_forward(normed, tokens, layer.norm, ctx);
  const std::int64_t channels = layer.projects[i].weight.N;
  const View<float, 3> projected = ctx.arena().alloc(Shape{h, w, channels});
  linear_forward(pixel_rows(projected), normed, layer.projects[i], {}, ctx);
  if (embedding != nullptr) add_position_embedding(projected, *embedding, ctx);

  View<float, 3> resized = projected;
  if (i != 2) resized = ctx.arena().alloc(Shape{y.extent(0), y.extent(1), channels});
  if (i == 0) conv_transpose2d_forward(resized, projected, layer.resize0, ctx);
  if (i == 1) conv_transpose2d_forward(resized, projected, layer.resize1, ctx);
  if (i == 3) conv2d_forward(resized, projected, layer.resize3, {}, ctx);
  conv2d_forward(y, resized, layer.layer_rn[i], {}, ctx);
}

}  // namespace lvggt
