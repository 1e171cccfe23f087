// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/kernels/activation.h"
#include "lvggt/nn/params.h"

namespace lvggt {

struct ResidualConvUnit {
  Conv2d conv1;  // [F, F, 3, 3]
  Conv2d conv2;  // [F, F, 3, 3]
};

// x = conv2(relu(conv1(r))) + r with r = relu(x), in place.   x, scratch: [H, W, F], dense
// The skip is relu(x), not x: the reference activates in place before adding.
inline void residual_conv_unit_forward(View<float, 3> x, View<float, 3> scratch,
                                       const ResidualConvUnit& unit, Context& ctx) {
  activation_forward(pixel_rows(x), pixel_rows(x), Activation::kRelu, ctx);
  conv2d_forward(scratch, x, unit.conv1, {.activation = Activation::kRelu}, ctx);
  conv2d_forward(x, scratch, unit.conv2, {.residual = x}, ctx);
}

}  // namespace lvggt
