// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/nn/params.h"

namespace lvggt {

// [conv3x3, batch norm, ReLU] x 2, the batch norms folded into the convolutions.
struct DoubleConv {
  Conv2d conv1;  // [Cout, Cin, 3, 3]
  Conv2d conv2;  // [Cout, Cout, 3, 3]
};

// y: [H, W, Cout], pixels may be strided   x: [H, W, Cin]
inline void double_conv_forward(View<float, 3> y, View<const float, 3> x, const DoubleConv& layer,
                                Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const View<float, 3> middle =
      ctx.arena().alloc(conv2d_shape(layer.conv1, x.extent(0), x.extent(1)));
  conv2d_forward(middle, x, layer.conv1, {.activation = Activation::kRelu}, ctx);
  conv2d_forward(y, middle, layer.conv2, {.activation = Activation::kRelu}, ctx);
}

}  // namespace lvggt
