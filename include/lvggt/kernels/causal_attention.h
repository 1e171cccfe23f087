// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// y = softmax(scale q k^T) v, head by head, where a token sees itself and those before it in its
// own sequence of P tokens. Query head h uses key head h / (heads / key_heads) (grouped-query
// attention; equal numbers are the ordinary kind). For text: rows are done one by one, which is
// enough for sequences of up to some thousand tokens.
//   y, q: [N, heads, D]   k, v: [N, key_heads, D]   N a multiple of P   y may be q.
void causal_attention(View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                      View<const float, 3> v, std::int64_t P, float scale, Context& ctx);

}  // namespace lvggt
