// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// y = exp(scale x) / sum(exp(scale x)) over the last axis, computed from scale (x - max(x)), so
// that no exponential overflows. The attention kernel has its own, which never stores a row; this
// one is for backward passes.
//   y, x: [N, C], rows may be strided   scale > 0   y may be x.
void softmax_forward(View<float, 2> y, View<const float, 2> x, float scale, Context& ctx);

// dx = scale y (dy - sum(y dy)), sum over the last axis; read off the output.
//   all: [N, C], rows may be strided   dx may be dy.
//
// Derivation: with z = scale x, dy_i/dz_j = y_i (delta_ij - y_j), so that
// dz_j = sum_i dy_i y_i (delta_ij - y_j) = y_j (dy_j - sum_i y_i dy_i), and dx = scale dz.
void softmax_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> y,
                      float scale, Context& ctx);

}  // namespace lvggt
