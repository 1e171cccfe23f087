// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <variant>
#include <vector>

#include "lvggt/model/dpt_head.h"
#include "lvggt/nn/unet.h"

namespace lvggt {

// The ablation of a UNet: 1x1 convolutions on the features.
struct MlpHead {
  Conv2d fc1;  // 1x1, followed by ReLU
  Conv2d fc2;  // 1x1
};

using PixelHead = std::variant<UNetDecoder, MlpHead>;

// Geometry tokens to semantics and colours of every pixel. The feature extractor is a DPT head, or,
// in the ablation, one projection of the last tap.
struct SemanticBridgingDecoder {
  std::variant<DptHead, Linear> feature_extractor;
  std::optional<UNetEncoder> lang_encoder;  // absent with MLP heads
  std::optional<UNetEncoder> rgb_encoder;
  std::vector<PixelHead> lang_decoders;  // one a level: small, middle, large
  std::optional<PixelHead> rgb_decoder;  // absent without the RGB head
  std::int64_t num_features = 0;         // channels of the features
  std::int64_t lang_dim = 0;
};

// y: [H, W, F]   taps: four times [h*w, 2C]
inline void extract_features(View<float, 3> y, const std::array<View<const float, 2>, 4>& taps,
                             std::int64_t h, std::int64_t w, const SemanticBridgingDecoder& decoder,
                             Context& ctx) {
  if (const auto* dpt = std::get_if<DptHead>(&decoder.feature_extractor)) {
    dpt_features_forward(y, taps, h, w, *dpt, std::nullopt, ctx);
    return;
  }
  Arena::Scope scope(ctx.arena());
  const View<float, 3> projected = ctx.arena().alloc(Shape{h, w, decoder.num_features});
  linear_forward(pixel_rows(projected), taps[3], std::get<Linear>(decoder.feature_extractor), {},
                 ctx);
  bilinear_forward(batch_of_one(y), batch_of_one(View<const float, 3>(projected)), true, ctx);
}

// One head's prediction at the features' size.   y: [H, W, d]   features: [H, W, F]
inline void pixel_head_forward(View<float, 3> y, View<const float, 3> features,
                               const UNetFeatures& encoded, const PixelHead& head,
                               Activation activation, Context& ctx) {
  if (const auto* unet = std::get_if<UNetDecoder>(&head)) {
    unet_decoder_forward(y, encoded, *unet, activation, ctx);
    return;
  }
  const auto& mlp = std::get<MlpHead>(head);
  Arena::Scope scope(ctx.arena());
  const View<float, 3> hidden =
      ctx.arena().alloc(conv2d_shape(mlp.fc1, features.extent(0), features.extent(1)));
  conv2d_forward(hidden, features, mlp.fc1, {.activation = Activation::kRelu}, ctx);
  conv2d_forward(y, hidden, mlp.fc2, {.activation = activation}, ctx);
}

// The same, resized to y's size if that is another.
inline void resized_head_forward(View<float, 3> y, View<const float, 3> features,
                                 const UNetFeatures& encoded, const PixelHead& head,
                                 Activation activation, Context& ctx) {
  const std::int64_t H = features.extent(0), W = features.extent(1);
  if (y.extent(0) == H && y.extent(1) == W) {
    pixel_head_forward(y, features, encoded, head, activation, ctx);
    return;
  }
  Arena::Scope scope(ctx.arena());
  const View<float, 3> predicted = ctx.arena().alloc(Shape{H, W, y.extent(2)});
  pixel_head_forward(predicted, features, encoded, head, activation, ctx);
  bilinear_forward(batch_of_one(y), batch_of_one(View<const float, 3>(predicted)), false, ctx);
}

// language: [levels, Ho, Wo, lang_dim], linear   rgb: [Ho, Wo, 3], in (0, 1); empty: not computed
// taps: four times [h*w, 2C]   H, W: size of the features, that of the frame
// The observer sees "sbd.dpt_features" and the stages of "sbd.lang_encoder.down" and
// "sbd.rgb_encoder.down".
inline void semantic_bridging_decoder_forward(View<float, 4> language, View<float, 3> rgb,
                                              const std::array<View<const float, 2>, 4>& taps,
                                              std::int64_t h, std::int64_t w, std::int64_t H,
                                              std::int64_t W,
                                              const SemanticBridgingDecoder& decoder,
                                              Observer* observer, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const View<float, 3> features = ctx.arena().alloc(Shape{H, W, decoder.num_features});
  extract_features(features, taps, h, w, decoder, ctx);
  if (observer) observer->observe("sbd.dpt_features", 0, pixel_rows(features));
  {
    Arena::Scope branch(ctx.arena());
    UNetFeatures encoded;
    if (decoder.lang_encoder)
      encoded = unet_encoder_forward(features, *decoder.lang_encoder, "sbd.lang_encoder.down",
                                     observer, ctx);
    for (std::size_t level = 0; level < decoder.lang_decoders.size(); ++level)
      resized_head_forward(language[static_cast<std::int64_t>(level)], features, encoded,
                           decoder.lang_decoders[level], Activation::kNone, ctx);
  }
  if (rgb.empty() || !decoder.rgb_decoder) return;
  UNetFeatures encoded;
  if (decoder.rgb_encoder)
    encoded =
        unet_encoder_forward(features, *decoder.rgb_encoder, "sbd.rgb_encoder.down", observer, ctx);
  resized_head_forward(rgb, features, encoded, *decoder.rgb_decoder, Activation::kSigmoid, ctx);
}

}  // namespace lvggt
