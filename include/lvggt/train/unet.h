// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lvggt/train/double_conv.h"

namespace lvggt {

// What a UNet encoder hands to its decoders, and what its backward pass needs. joined[i] is a map
// of twice down{i+1}'s channels: the second half holds its output, the first half is where each
// decoder in turn puts what it upsampled, so that the concatenation [up, skip] costs nothing.
// Decoders therefore run one after the other, each with its backward pass before the next.
template <class T>
struct UNetEncoderActivations {
  std::array<DoubleConvActivations<T>, 4> down;
  std::array<View<T, 4>, 3> joined;  // [B, H >> i, W >> i, 2 * hidden << i]
  View<T, 4> bottom;                 // [B, H >> 3, W >> 3, 8 * hidden]

  View<T, 4> skip(std::size_t i) const {
    return joined[i].narrow(3, joined[i].extent(3) / 2, joined[i].extent(3));
  }
};

// Gradients of an encoder's outputs, summed over its decoders.
template <class T>
struct UNetEncoderGradients {
  std::array<SummedGradient<T>, 3> skips;  // [B, H >> i, W >> i, hidden << i], dense
  SummedGradient<T> bottom;
};

template <class T>
UNetEncoderGradients<T> alloc_gradients(const UNetEncoderActivations<T>& encoded, Arena& arena) {
  UNetEncoderGradients<T> gradients;
  for (std::size_t i = 0; i < 3; ++i)
    gradients.skips[i].sum = arena.alloc<T>(encoded.skip(i).shape());
  gradients.bottom.sum = arena.alloc<T>(encoded.bottom.shape());
  return gradients;
}

// x: [B, H, W, F], at least 8 x 8
template <class T>
void unet_encoder_forward(UNetEncoderActivations<T>& kept, ConstView<T, 4> x,
                          const UNetEncoderParameters<const T>& encoder, TrainingPass& pass) {
  Arena& arena = pass.ctx.arena();
  for (std::size_t i = 0; i < 4; ++i) {
    Shape<4> shape = conv2d_shape(encoder.down[i].conv2, x.shape());
    View<T, 4> y;
    if (i < 3) {
      const std::int64_t C = shape[3];
      kept.joined[i] = arena.alloc<T>(Shape{shape[0], shape[1], shape[2], 2 * C});
      y = kept.skip(i);
    } else {
      y = kept.bottom = arena.alloc<T>(shape);
    }
    double_conv_forward(y, kept.down[i], x, encoder.down[i], pass);
    if (i == 3) break;
    const View<T, 4> pooled = arena.alloc<T>(conv2d_shape(encoder.pool[i], shape));
    conv2d_forward(pooled, y, encoder.pool[i], Activation::kNone, {}, pass.ctx);
    x = pooled;
  }
}

// dx: as x   dy: gradients of the skips and the bottom, all started; overwritten
template <class T>
void unet_encoder_backward(View<T, 4> dx, const UNetEncoderParameters<T>& gradient,
                           UNetEncoderGradients<T>& dy, const UNetEncoderActivations<T>& kept,
                           const UNetEncoderParameters<const T>& encoder, TrainingPass& pass) {
  View<const T, 4> dout = dy.bottom.sum;
  for (std::size_t i = 3; i > 0; --i) {
    Arena::Scope scope(pass.ctx.arena());
    const View<T, 4> dpooled = pass.ctx.arena().alloc<T>(kept.down[i].x.shape());
    double_conv_backward(dpooled, gradient.down[i], dout, kept.down[i], encoder.down[i], pass);
    add_gradient(
        dy.skips[i - 1],
        [&](View<T, 4> dskip) {
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

template <class T>
void unet_up_forward(View<T, 4> y, ConstView<T, 4> x, const ConvTranspose2dParameters<const T>& up,
                     Context& ctx) {
  const Shape<4> doubled = upsampled_shape(y.shape(), x.shape());
  if (y.shape() == doubled) return conv_transpose2d_forward(y, x, up, ctx);
  Arena::Scope scope(ctx.arena());
  const View<T, 4> upsampled = ctx.arena().alloc<T>(doubled);
  conv_transpose2d_forward(upsampled, x, up, ctx);
  bilinear_forward(y, upsampled, false, ctx);
}

template <class T>
void unet_up_backward(View<T, 4> dx, const ConvTranspose2dParameters<T>& gradient,
                      ConstView<T, 4> dy, ConstView<T, 4> x,
                      const ConvTranspose2dParameters<const T>& up, Context& ctx) {
  const Shape<4> doubled = upsampled_shape(dy.shape(), x.shape());
  if (dy.shape() == doubled) return conv_transpose2d_backward(dx, gradient, dy, x, up, ctx);
  Arena::Scope scope(ctx.arena());
  const View<T, 4> dupsampled = ctx.arena().alloc<T>(doubled);
  bilinear_backward(dupsampled, dy, false, ctx);
  conv_transpose2d_backward(dx, gradient, dupsampled, x, up, ctx);
}

template <class T>
struct UNetDecoderActivations {
  std::array<DoubleConvActivations<T>, 3> conv;
  std::array<View<const T, 4>, 4> x;  // what up{k+1} reads, and last what final_conv reads
};

// y = activation(final_conv(...)): [B, H, W, d]; overwrites the first halves of the joined maps.
template <class T>
void unet_decoder_forward(View<T, 4> y, UNetDecoderActivations<T>& kept,
                          const UNetEncoderActivations<T>& encoded,
                          const UNetDecoderParameters<const T>& decoder, Activation activation,
                          TrainingPass& pass) {
  kept.x[0] = encoded.bottom;
  for (std::size_t k = 0; k < 3; ++k) {
    const View<T, 4> joined = encoded.joined[2 - k];
    const auto [B, H, W, C2] = joined.shape();
    unet_up_forward(joined.narrow(3, 0, C2 / 2), kept.x[k], decoder.up[k], pass.ctx);
    const View<T, 4> refined = pass.ctx.arena().alloc<T>(Shape{B, H, W, C2 / 2});
    double_conv_forward(refined, kept.conv[k], joined, decoder.conv[k], pass);
    kept.x[k + 1] = refined;
  }
  conv2d_forward(y, kept.x[3], decoder.final_conv, activation, {}, pass.ctx);
}

// dencoded: one more consumer of the encoder's outputs   dy: of final_conv's sums, before the
// activation
template <class T>
void unet_decoder_backward(UNetEncoderGradients<T>& dencoded,
                           const UNetDecoderParameters<T>& gradient, ConstView<T, 4> dy,
                           const UNetDecoderActivations<T>& kept,
                           const UNetDecoderParameters<const T>& decoder, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  View<T, 4> dx = ctx.arena().alloc<T>(kept.x[3].shape());
  conv2d_backward(dx, gradient.final_conv, dy, kept.x[3], decoder.final_conv, ctx);
  for (std::size_t k = 3; k-- > 0;) {
    const DoubleConvActivations<T>& conv = kept.conv[k];
    View<T, 4> dnext;
    if (k > 0) dnext = ctx.arena().alloc<T>(kept.x[k].shape());
    Arena::Scope step(ctx.arena());  // dnext outlives it
    const View<T, 4> djoined = ctx.arena().alloc<T>(conv.x.shape());
    const std::int64_t C = djoined.extent(3) / 2;
    double_conv_backward(djoined, gradient.conv[k], dx, conv, decoder.conv[k], pass);
    add_gradient(dencoded.skips[2 - k], djoined.narrow(3, C, 2 * C), ctx);
    const auto up_backward = [&](View<T, 4> out) {
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
