// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// y = silu(gate) * up.   y, gate, up: [N, C], rows may be strided.   y may be gate or up.
void swiglu_forward(View<float, 2> y, View<const float, 2> gate, View<const float, 2> up,
                    Context& ctx);

}  // namespace lvggt
