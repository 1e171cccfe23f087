// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Cosines and sines of the 2D rotary embedding, one row a token. A head of D values is two halves
// of D/2: the first turns by the token's row, the second by its column. In a half, angle j =
// position * base^(-2j/(D/2)), j = 0 .. D/4-1, and element k pairs with k + D/4 ("rotate half").
struct RopeTable {
  Tensor<float, 2> cos;  // [P, D/2]: D/4 angles by row, then D/4 by column
  Tensor<float, 2> sin;  // [P, D/2]
};

// positions: [P, 2] (row, column); special tokens are at (0, 0), patches at (y+1, x+1). head_dim
// must be a multiple of 4.
RopeTable make_rope_table(View<const std::int64_t, 2> positions, std::int64_t head_dim, float base);

// y = x turned by its token's angles; token n uses row n % P of the table, N is a multiple of P.
//   y, x: [N, heads, D]   y may be x.
void rope_2d_forward(View<float, 3> y, View<const float, 3> x, const RopeTable& table,
                     Context& ctx);

}  // namespace lvggt
