// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <complex>

#include "lvggt/kernels/epilogue.h"

namespace lvggt::reference {

template <class T>
T activation(T x, Activation kind) {
  switch (kind) {
    case Activation::kRelu:
      return x > 0 ? x : T(0);
    case Activation::kGelu:
      return x / 2 * std::erfc(-x / std::sqrt(T(2)));
    case Activation::kSilu:
      return x / (1 + std::exp(-x));
    case Activation::kSigmoid:
      return 1 / (1 + std::exp(-x));
    case Activation::kNone:
      break;
  }
  return x;
}

}  // namespace lvggt::reference
