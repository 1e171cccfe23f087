// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/tensor.h"

namespace lvggt {

enum class Activation { kNone, kRelu, kGelu, kSilu, kSigmoid };

// What a product does to its sums before they are stored, at no extra pass over memory:
//   y = residual + gamma * activation(sum + bias)
// Every part is optional (an empty view is left out). gamma is the LayerScale, one factor an output
// channel.
template <int R>
struct Epilogue {
  View<const float, 1> bias{};  // [N]
  Activation activation = Activation::kNone;
  View<const float, 1> gamma{};     // [N]
  View<const float, R> residual{};  // shape of y; may be y itself
};

}  // namespace lvggt
