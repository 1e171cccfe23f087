// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <variant>

#include "lvggt/train/unet.h"

namespace lvggt {

// The ablation of a UNet: y = activation(fc2(relu(fc1(features)))), pixel by pixel.
struct MlpHeadActivations {
  View<const float, 4> features;  // [B, H, W, F], the caller's
  View<float, 4> hidden;          // [B, H, W, 4 hidden]
};

inline void mlp_head_forward(View<float, 4> y, MlpHeadActivations& kept,
                             View<const float, 4> features,
                             const MlpHeadParameters<const float>& head, Activation activation,
                             TrainingPass& pass) {
  const auto [B, H, W, F] = features.shape();
  kept.features = features;
  kept.hidden = pass.ctx.arena().alloc(Shape{B, H, W, head.fc1.weight.extent(0)});
  linear_forward(batch_rows(kept.hidden), batch_rows(features), head.fc1, Activation::kRelu,
                 pass.ctx);
  linear_forward(batch_rows(y), batch_rows(View<const float, 4>(kept.hidden)), head.fc2, activation,
                 pass.ctx);
}

// dy: of fc2's sums, before the activation
inline void mlp_head_backward(View<float, 4> dfeatures, const MlpHeadParameters<float>& gradient,
                              View<const float, 4> dy, const MlpHeadActivations& kept,
                              const MlpHeadParameters<const float>& head, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const View<float, 2> dhidden = batch_rows(ctx.arena().alloc(kept.hidden.shape()));
  const View<float, 2> hidden = batch_rows(kept.hidden);
  linear_backward(dhidden, gradient.fc2, batch_rows(dy), hidden, head.fc2, ctx);
  relu_backward(dhidden, dhidden, hidden, ctx);
  linear_backward(batch_rows(dfeatures), gradient.fc1, dhidden, batch_rows(kept.features), head.fc1,
                  ctx);
}

// A head's prediction at the features' size and, if that is another, at the targets' size.
struct PixelHeadActivations {
  std::variant<UNetDecoderActivations, MlpHeadActivations> head;
  View<float, 4> predicted;  // [B, H, W, d]
  View<float, 4> resized;    // [B, Ho, Wo, d]; predicted itself when the sizes agree
};

// What the heads of a branch read.
struct BranchActivations {
  View<const float, 4> features;   // [B, H, W, F], the caller's
  UNetEncoderActivations encoded;  // without maps for MLP heads
};

// Gradients of what the heads read.
struct BranchGradients {
  SummedGradient& features;  // MLP heads add to it; an encoder's backward pass does it once
  UNetEncoderGradients encoded;
};

// kept.resized: [B, Ho, Wo, d], semantics linear, colours through a sigmoid
inline void pixel_head_forward(PixelHeadActivations& kept, const BranchActivations& branch,
                               const PixelHeadParameters<const float>& head, Activation activation,
                               std::int64_t channels, std::int64_t Ho, std::int64_t Wo,
                               TrainingPass& pass) {
  Arena& arena = pass.ctx.arena();
  const auto [B, H, W, F] = branch.features.shape();
  kept.resized = kept.predicted = arena.alloc(Shape{B, H, W, channels});
  if (const auto* unet = std::get_if<UNetDecoderParameters<const float>>(&head)) {
    unet_decoder_forward(kept.predicted, kept.head.emplace<UNetDecoderActivations>(),
                         branch.encoded, *unet, activation, pass);
  } else {
    mlp_head_forward(kept.predicted, kept.head.emplace<MlpHeadActivations>(), branch.features,
                     std::get<MlpHeadParameters<const float>>(head), activation, pass);
  }
  if (Ho == H && Wo == W) return;
  kept.resized = arena.alloc(Shape{B, Ho, Wo, channels});
  bilinear_forward(kept.resized, kept.predicted, false, pass.ctx);
}

// dy: [B, Ho, Wo, d], overwritten
inline void pixel_head_backward(BranchGradients& dbranch,
                                const PixelHeadParameters<float>& gradient, View<float, 4> dy,
                                const PixelHeadActivations& kept,
                                const PixelHeadParameters<const float>& head, Activation activation,
                                TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  View<float, 4> dsum = dy;
  if (kept.resized.data() != kept.predicted.data()) {
    dsum = ctx.arena().alloc(kept.predicted.shape());
    bilinear_backward(dsum, dy, false, ctx);
  }
  if (activation == Activation::kSigmoid)
    sigmoid_backward(batch_rows(dsum), batch_rows(dsum), batch_rows(kept.predicted), ctx);
  if (const auto* unet = std::get_if<UNetDecoderParameters<const float>>(&head)) {
    unet_decoder_backward(dbranch.encoded, std::get<UNetDecoderParameters<float>>(gradient), dsum,
                          std::get<UNetDecoderActivations>(kept.head), *unet, pass);
    return;
  }
  add_gradient(
      dbranch.features,
      [&](View<float, 4> dfeatures) {
        mlp_head_backward(dfeatures, std::get<MlpHeadParameters<float>>(gradient), dsum,
                          std::get<MlpHeadActivations>(kept.head),
                          std::get<MlpHeadParameters<const float>>(head), pass);
      },
      ctx);
}

}  // namespace lvggt
