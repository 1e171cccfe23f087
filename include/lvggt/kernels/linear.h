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

}  // namespace lvggt
