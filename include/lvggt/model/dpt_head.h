// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <optional>

#include "lvggt/nn/fusion_block.h"
#include "lvggt/nn/observer.h"
#include "lvggt/nn/reassemble.h"

namespace lvggt {

// The dense prediction transformer head: depth and point heads, and the decoder's feature
// extractor.
struct DptHead {
  Reassemble reassemble;
  std::array<FusionBlock, 4> refinenet;  // [0] is refinenet1, the finest
  Conv2d output_conv1;                   // 3x3
  std::optional<Conv2d> output_conv2_0;  // 3x3, followed by ReLU; depth and point heads only
  std::optional<Conv2d> output_conv2_2;  // 1x1 to 2 (depth) or 4 (points) channels
  double pos_embed_ratio = 0;            // 0: no position embedding
};

// Position embeddings of a head for one size of frame, made once.
struct DptEmbeddings {
  std::array<PositionEmbedding, 4> projects;  // of the patch grid
  PositionEmbedding output;                   // of the frame
};

inline std::optional<DptEmbeddings> make_dpt_embeddings(const DptHead& head, std::int64_t h,
                                                        std::int64_t w, std::int64_t H,
                                                        std::int64_t W) {
  if (head.pos_embed_ratio == 0) return std::nullopt;
  const double aspect = static_cast<double>(W) / static_cast<double>(H);
  DptEmbeddings embeddings;
  for (std::size_t i = 0; i < 4; ++i)
    embeddings.projects[i] = make_position_embedding(h, w, head.reassemble.projects[i].weight.N,
                                                     aspect, head.pos_embed_ratio);
  embeddings.output = make_position_embedding(H, W, head.output_conv1.weight.matrix.N, aspect,
                                              head.pos_embed_ratio);
  return embeddings;
}

// Features at the resolution of the frame: everything up to output_conv1 and its resize.
//   y: [H, W, channels of output_conv1]   taps: four times [h*w, 2C], patch tokens only
inline void dpt_features_forward(View<float, 3> y, const std::array<View<const float, 2>, 4>& taps,
                                 std::int64_t h, std::int64_t w, const DptHead& head,
                                 const std::optional<DptEmbeddings>& embeddings, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  std::array<View<float, 3>, 4> layers;
  for (std::size_t i = 0; i < 4; ++i) {
    layers[i] = ctx.arena().alloc(reassembled_shape(head.reassemble, i, h, w));
    reassemble_forward(layers[i], taps[i], head.reassemble, i, h, w,
                       embeddings ? &embeddings->projects[i] : nullptr, ctx);
  }
  // From the coarsest map to the finest, each fused map resized to the size of the next layer, the
  // last to twice its own.
  View<float, 3> fused = layers[3], skip;
  for (std::size_t i = 4; i-- > 0;) {
    const Shape<3>& size = layers[i == 0 ? 0 : i - 1].shape();
    const std::int64_t scale = i == 0 ? 2 : 1;
    const View<float, 3> resized =
        ctx.arena().alloc(Shape{scale * size[0], scale * size[1], size[2]});
    fusion_block_forward(resized, fused, skip, head.refinenet[i], ctx);
    fused = resized;
    if (i > 0) skip = layers[i - 1];
  }
  const View<float, 3> output =
      ctx.arena().alloc(conv2d_shape(head.output_conv1, fused.extent(0), fused.extent(1)));
  conv2d_forward(output, fused, head.output_conv1, {}, ctx);
  bilinear_forward(batch_of_one(y), batch_of_one(View<const float, 3>(output)), true, ctx);
  if (embeddings) add_position_embedding(y, embeddings->output, ctx);
}

// Predictions before their activation, for the depth and point heads.   y: [H, W, 2 or 4]
inline void dpt_head_forward(View<float, 3> y, const std::array<View<const float, 2>, 4>& taps,
                             std::int64_t h, std::int64_t w, const DptHead& head,
                             const std::optional<DptEmbeddings>& embeddings, Context& ctx) {
  const std::int64_t H = y.extent(0), W = y.extent(1);
  Arena::Scope scope(ctx.arena());
  const View<float, 3> features = ctx.arena().alloc(Shape{H, W, head.output_conv1.weight.matrix.N});
  dpt_features_forward(features, taps, h, w, head, embeddings, ctx);
  const View<float, 3> hidden = ctx.arena().alloc(conv2d_shape(*head.output_conv2_0, H, W));
  conv2d_forward(hidden, features, *head.output_conv2_0, {.activation = Activation::kRelu}, ctx);
  conv2d_forward(y, hidden, *head.output_conv2_2, {}, ctx);
}

}  // namespace lvggt
