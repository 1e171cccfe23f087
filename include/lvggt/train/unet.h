// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lvggt/train/double_conv.h"

namespace lvggt {

// What a UNet encoder hands to its decoders, and what its backward pass needs. joined[i] is a map
// of twice down{i+1}'s channels: the second half holds its output, the first half is where each
// decoder in turn puts what it upsampled, so that the concatenation [up, skip] costs nothing.
// Decoders therefore run one after the other, each with its backward pass before the next.
struct UNetEncoderActivations {
  std::array<DoubleConvActivations, 4> down;
  std::array<View<float, 4>, 3> joined;  // [B, H >> i, W >> i, 2 * hidden << i]
  View<float, 4> bottom;                 // [B, H >> 3, W >> 3, 8 * hidden]

  View<float, 4> skip(std::size_t i) const {
    return joined[i].narrow(3, joined[i].extent(3) / 2, joined[i].extent(3));
  }
};

// Gradients of an encoder's outputs, summed over its decoders.
struct UNetEncoderGradients {
  std::array<SummedGradient, 3> skips;  // [B, H >> i, W >> i, hidden << i], dense
  SummedGradient bottom;
};

inline UNetEncoderGradients alloc_gradients(const UNetEncoderActivations& encoded, Arena& arena) {
  UNetEncoderGradients gradients;
  for (std::size_t i = 0; i < 3; ++i) gradients.skips[i].sum = arena.alloc(encoded.skip(i).shape());
  gradients.bottom.sum = arena.alloc(encoded.bottom.shape());
  return gradients;
}

// x: [B, H, W, F], at least 8 x 8
inline void unet_encoder_forward(UNetEncoderActivations& kept, View<const float, 4> x,
                                 const UNetEncoderParameters<const float>& encoder,
                                 TrainingPass& pass) {
  Arena& arena = pass.ctx.arena();
  for (std::size_t i = 0; i < 4; ++i) {
    Shape<4> shape = conv2d_shape(encoder.down[i].conv2, x.shape());
    View<float, 4> y;
    if (i < 3) {
      const std::int64_t C = shape[3];
      kept.joined[i] = arena.alloc(Shape{shape[0], shape[1], shape[2], 2 * C});
      y = kept.skip(i);
    } else {
      y = kept.bottom = arena.alloc(shape);
    }
    double_conv_forward(y, kept.down[i], x, encoder.down[i], pass);
    if (i == 3) break;
    const View<float, 4> pooled = arena.alloc(conv2d_shape(encoder.pool[i], shape));
    conv2d_forward(pooled, y, encoder.pool[i], Activation::kNone, {}, pass.ctx);
    x = pooled;
  }
}

// dx: as x   dy: gradients of the skips and the bottom, all started; overwritten
inline void unet_encoder_backward(View<float, 4> dx, const UNetEncoderParameters<float>& gradient,
                                  UNetEncoderGradients& dy, const UNetEncoderActivations& kept,
                                  const UNetEncoderParameters<const float>& encoder,
                                  TrainingPass& pass) {
  View<const float, 4> dout = dy.bottom.sum;
  for (std::size_t i = 3; i > 0; --i) {
    Arena::Scope scope(pass.ctx.arena());
    const View<float, 4> dpooled = pass.ctx.arena().alloc(kept.down[i].x.shape());
    double_conv_backward(dpooled, gradient.down[i], dout, kept.down[i], encoder.down[i], pass);
    add_gradient(
        dy.skips[i - 1],
        [&](View<float, 4> dskip) {
          conv2d_backward(dskip, gradient.pool[i - 1], dpooled, kept.skip(i - 1),
                          encoder.pool[i - 1], pass.ctx);
        },
        pass.ctx);
    dout = dy.skips[i - 1].sum;
  }
  double_conv_backward(dx, gradient.down[0], dout, kept.down[0], encoder.down[0], pass);
}

// y = up(x), resized to y's size when the skip's side is odd.
//   y: [B, H, W, C], pixels may be strided   x: [B, h, w, 2C]
inline Shape<4> upsampled_shape(const Shape<4>& y, const Shape<4>& x) {
  return Shape{x[0], 2 * x[1], 2 * x[2], y[3]};
}

inline void unet_up_forward(View<float, 4> y, View<const float, 4> x,
                            const ConvTranspose2dParameters<const float>& up, Context& ctx) {
  const Shape<4> doubled = upsampled_shape(y.shape(), x.shape());
  if (y.shape() == doubled) return conv_transpose2d_forward(y, x, up, ctx);
  Arena::Scope scope(ctx.arena());
  const View<float, 4> upsampled = ctx.arena().alloc(doubled);
  conv_transpose2d_forward(upsampled, x, up, ctx);
  bilinear_forward(y, upsampled, false, ctx);
}

inline void unet_up_backward(View<float, 4> dx, const ConvTranspose2dParameters<float>& gradient,
                             View<const float, 4> dy, View<const float, 4> x,
                             const ConvTranspose2dParameters<const float>& up, Context& ctx) {
  const Shape<4> doubled = upsampled_shape(dy.shape(), x.shape());
  if (dy.shape() == doubled) return conv_transpose2d_backward(dx, gradient, dy, x, up, ctx);
  Arena::Scope scope(ctx.arena());
  const View<float, 4> dupsampled = ctx.arena().alloc(doubled);
  bilinear_backward(dupsampled, dy, false, ctx);
  conv_transpose2d_backward(dx, gradient, dupsampled, x, up, ctx);
}

struct UNetDecoderActivations {
  std::array<DoubleConvActivations, 3> conv;
  std::array<View<const float, 4>, 4> x;  // what up{k+1} reads, and last what final_conv reads
};

// y = activation(final_conv(...)): [B, H, W, d]; overwrites the first halves of the joined maps.
inline void unet_decoder_forward(View<float, 4> y, UNetDecoderActivations& kept,
                                 const UNetEncoderActivations& encoded,
                                 const UNetDecoderParameters<const float>& decoder,
                                 Activation activation, TrainingPass& pass) {
  kept.x[0] = encoded.bottom;
  for (std::size_t k = 0; k < 3; ++k) {
    const View<float, 4> joined = encoded.joined[2 - k];
    const auto [B, H, W, C2] = joined.shape();
    unet_up_forward(joined.narrow(3, 0, C2 / 2), kept.x[k], decoder.up[k], pass.ctx);
    const View<float, 4> refined = pass.ctx.arena().alloc(Shape{B, H, W, C2 / 2});
    double_conv_forward(refined, kept.conv[k], joined, decoder.conv[k], pass);
    kept.x[k + 1] = refined;
  }
  conv2d_forward(y, kept.x[3], decoder.final_conv, activation, {}, pass.ctx);
}

// dencoded: one more consumer of the encoder's outputs   dy: of final_conv's sums, before the
// activation
inline void unet_decoder_backward(UNetEncoderGradients& dencoded,
                                  const UNetDecoderParameters<float>& gradient,
                                  View<const float, 4> dy, const UNetDecoderActivations& kept,
                                  const UNetDecoderParameters<const float>& decoder,
                                  TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  View<float, 4> dx = ctx.arena().alloc(kept.x[3].shape());
  conv2d_backward(dx, gradient.final_conv, dy, kept.x[3], decoder.final_conv, ctx);
  for (std::size_t k = 3; k-- > 0;) {
    const DoubleConvActivations& conv = kept.conv[k];
    View<float, 4> dnext;
    if (k > 0) dnext = ctx.arena().alloc(kept.x[k].shape());
    Arena::Scope step(ctx.arena());  // dnext outlives it
    const View<float, 4> djoined = ctx.arena().alloc(conv.x.shape());
    const std::int64_t C = djoined.extent(3) / 2;
    double_conv_backward(djoined, gradient.conv[k], dx, conv, decoder.conv[k], pass);
    add_gradient(dencoded.skips[2 - k], djoined.narrow(3, C, 2 * C), ctx);
    const auto up_backward = [&](View<float, 4> out) {
      unet_up_backward(out, gradient.up[k], djoined.narrow(3, 0, C), kept.x[k], decoder.up[k], ctx);
    };
    if (k > 0) {
      up_backward(dnext);
      dx = dnext;
    } else {
      add_gradient(dencoded.bottom, up_backward, ctx);
    }
  }
}

}  // namespace lvggt
