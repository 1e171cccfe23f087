// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/kernels/rope.h"

namespace lvggt {

// Backward of rope_2d_forward: dx = dy turned by the opposite angles.
//   dx, dy: [N, heads, D]   dx may be dy.
//
// Derivation: a pair (a, b) becomes R (a, b) with the rotation R = [c -s; s c], so its gradient is
// R^T (da, db) = (c da + s db, c db - s da), and R^T is the rotation by minus the angle.
void rope_2d_backward(View<float, 3> dx, View<const float, 3> dy, const RopeTable& table,
                      Context& ctx);

}  // namespace lvggt
