// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// LayerScale on a branch of a transformer block: y = residual + gamma x, one factor a channel. In
// inference it is the epilogue of the branch's last linear layer; training keeps x.
//   y, x, residual: [N, C], rows may be strided   gamma: [C]   y may be x or residual.
void layer_scale_forward(View<float, 2> y, View<const float, 2> x, View<const float, 1> gamma,
                         View<const float, 2> residual, Context& ctx);

// dx = gamma dy     dgamma += sum(dy x)     sum over N; the gradient of the residual is dy itself
//   dx, dy, x: [N, C], rows may be strided   dgamma, gamma: [C]
// An empty dx or dgamma is not wanted; dx may be dy.
void layer_scale_backward(View<float, 2> dx, View<float, 1> dgamma, View<const float, 2> dy,
                          View<const float, 2> x, View<const float, 1> gamma, Context& ctx);

}  // namespace lvggt
