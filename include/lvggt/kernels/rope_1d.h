// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Cosines and sines of the rotary embedding of a sequence: angle j of position p is
// p * base^(-2j / D), j = 0 .. D/2-1.
struct Rope1dTable {
  Tensor<float, 2> cos;  // [P, D/2]
  Tensor<float, 2> sin;  // [P, D/2]
};

// Positions 0 .. P-1. head_dim must be even.
Rope1dTable make_rope_1d_table(std::int64_t P, std::int64_t head_dim, double base);

// y = x turned by its token's angles; element j pairs with j + D/2 ("rotate half"). Token n has
// position n % P.
//   y, x: [N, heads, D]   y may be x.
void rope_1d_forward(View<float, 3> y, View<const float, 3> x, const Rope1dTable& table,
                     Context& ctx);

}  // namespace lvggt
