// SPDX-License-Identifier: Apache-2.0
// Private: the gradients of a convolution's parameters; linear and transposed convolutions use them
// too.
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt::kernels {

// dweight[co, ci, t] += sum over output pixels o of dy[o, co] x[stride o + t - padding, ci]
// dbias[co]          += sum over output pixels o of dy[o, co]
//   dweight: [Cout, Cin, k, k]   dbias: [Cout] or empty   dy: [B, Ho, Wo, Cout]   x: [B, H, W, Cin]
// Rows and pixels of dy and x may be strided.
void weight_gradient(View<float, 4> dweight, View<float, 1> dbias, View<const float, 4> dy,
                     View<const float, 4> x, std::int64_t stride, std::int64_t padding,
                     Context& ctx);

// dbias[c] += sum over all pixels of dy.   dbias: [C]   dy: [B, H, W, C]
void bias_gradient(View<float, 1> dbias, View<const float, 4> dy, Context& ctx);

}  // namespace lvggt::kernels
