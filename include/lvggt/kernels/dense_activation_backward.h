// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Backward of depth_activation (kernels/activation.h): depth = exp(x[:,0]) and
// confidence = 1 + exp(x[:,1]) are their own slopes, less the 1, so
//   dx[:,0] = exp(x[:,0]) ddepth     dx[:,1] = exp(x[:,1]) dconfidence
// An exponential that overflows gives an infinite gradient.
//   dx, x: [N, 2]   ddepth, dconfidence: [N]
void depth_activation_backward(View<float, 2> dx, View<const float, 1> ddepth,
                               View<const float, 1> dconfidence, View<const float, 2> x,
                               Context& ctx);

// Backward of point_activation: point = sign(v) expm1(|v|) is odd, so its slope is even: exp(|v|),
// which at 0 is the 1 that both sides tend to.
//   dx[:,:3] = exp(|x[:,:3]|) dpoints     dx[:,3] = exp(x[:,3]) dconfidence
//   dx, x: [N, 4]   dpoints: [N, 3]   dconfidence: [N]
void point_activation_backward(View<float, 2> dx, View<const float, 2> dpoints,
                               View<const float, 1> dconfidence, View<const float, 2> x,
                               Context& ctx);

}  // namespace lvggt
