// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lvggt/kernels/interpolate.h"
#include "lvggt/nn/double_conv.h"
#include "lvggt/nn/observer.h"

namespace lvggt {

struct UNetEncoder {
  std::array<DoubleConv, 4> down;  // to hidden, 2, 4 and 8 times hidden channels
  std::array<Conv2d, 3> pool;      // 2x2, stride 2
};

struct UNetDecoder {
  std::array<ConvTranspose2d, 3> up;  // 2x2, stride 2, halving the channels
  std::array<DoubleConv, 3> conv;     // of [up, skip]
  Conv2d final_conv;                  // 3x3
};

// The encoder's maps for its decoders. skips[i] is a map of twice its channels: the second half
// holds down{i+1}'s output, the first half is where each decoder in turn puts what it upsampled, so
// that the concatenation [up, skip] costs nothing.
struct UNetFeatures {
  std::array<View<float, 3>, 3> skips;  // [H >> i, W >> i, 2 * hidden << i]
  View<float, 3> bottom;                // [H >> 3, W >> 3, 8 * hidden]
};

// x: [H, W, F], at least 8 x 8. The result lives in the arena's current scope; the observer sees
// the output of down1..4 as `name`.
inline UNetFeatures unet_encoder_forward(View<const float, 3> x, const UNetEncoder& encoder,
                                         std::string_view name, Observer* observer, Context& ctx) {
  UNetFeatures features;
  for (std::size_t i = 0; i < 4; ++i) {
    const Shape<3> shape = conv2d_shape(encoder.down[i].conv2, x.extent(0), x.extent(1));
    View<float, 3> y;
    if (i < 3) {
      features.skips[i] = ctx.arena().alloc(Shape{shape[0], shape[1], 2 * shape[2]});
      y = features.skips[i].narrow(2, shape[2], 2 * shape[2]);
    } else {
      y = features.bottom = ctx.arena().alloc(shape);
    }
    double_conv_forward(y, x, encoder.down[i], ctx);
    if (observer) observer->observe(name, static_cast<std::int64_t>(i) + 1, pixel_rows(y));
    if (i == 3) break;
    const View<float, 3> pooled =
        ctx.arena().alloc(conv2d_shape(encoder.pool[i], shape[0], shape[1]));
    conv2d_forward(pooled, y, encoder.pool[i], {}, ctx);
    x = pooled;
  }
  return features;
}

// up(x), resized to y's size when the skip's side is odd.   y: [H, W, C], pixels strided   x: [h,
// w, 2C]
inline void unet_up_forward(View<float, 3> y, View<const float, 3> x, const ConvTranspose2d& up,
                            Context& ctx) {
  const Shape doubled{2 * x.extent(0), 2 * x.extent(1), y.extent(2)};
  if (y.shape() == doubled) {
    conv_transpose2d_forward(y, x, up, ctx);
    return;
  }
  Arena::Scope scope(ctx.arena());
  const View<float, 3> upsampled = ctx.arena().alloc(doubled);
  conv_transpose2d_forward(upsampled, x, up, ctx);
  bilinear_forward(batch_of_one(y), batch_of_one(View<const float, 3>(upsampled)), false, ctx);
}

// y: [H, W, d]; overwrites the first halves of the skips.
inline void unet_decoder_forward(View<float, 3> y, const UNetFeatures& features,
                                 const UNetDecoder& decoder, Activation activation, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  View<const float, 3> x = features.bottom;
  for (std::size_t k = 0; k < 3; ++k) {
    const View<float, 3> joined = features.skips[2 - k];
    const auto [H, W, C2] = joined.shape();
    unet_up_forward(joined.narrow(2, 0, C2 / 2), x, decoder.up[k], ctx);
    const View<float, 3> refined = ctx.arena().alloc(Shape{H, W, C2 / 2});
    double_conv_forward(refined, joined, decoder.conv[k], ctx);
    x = refined;
  }
  conv2d_forward(y, x, decoder.final_conv, {.activation = activation}, ctx);
}

}  // namespace lvggt
