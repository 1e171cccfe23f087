// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/kernels/epilogue.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt {

// y = epilogue(x w^T).   y: [M, N]   x: [M, K]   w: [N, K], packed.   y may be epilogue.residual,
// not x.
void linear_forward(View<float, 2> y, View<const float, 2> x, const PackedMatrix& w,
                    const Epilogue<2>& epilogue, Context& ctx);

// The same with a weight [N, K] that is packed into scratch for this call: for training, which
// changes it every step.
void linear_forward(View<float, 2> y, View<const float, 2> x, View<const float, 2> weight,
                    const Epilogue<2>& epilogue, Context& ctx);

// Backward of y = x weight^T + bias:
//   dx = dy weight     dweight += dy^T x     dbias += sum over rows of dy
//   dx, x: [M, K]   dweight, weight: [N, K], unpacked   dbias: [N]   dy: [M, N]
// An empty dx, dweight or dbias is not wanted; rows may be strided.
void linear_backward(View<float, 2> dx, View<float, 2> dweight, View<float, 1> dbias,
                     View<const float, 2> dy, View<const float, 2> x, View<const float, 2> weight,
                     Context& ctx);

}  // namespace lvggt
