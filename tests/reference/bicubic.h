// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// Weight of input sample j in output sample i of an antialiased bicubic resize (a = -1/2); see
// resize().
template <class T>
T bicubic_weight(std::int64_t i, std::int64_t j, std::int64_t out, std::int64_t in) {
  const T scale = T(in) / T(out), stretch = std::max(scale, T(1));
  const auto cubic = [](T t) {
    return t < 1   ? 1.5 * t * t * t - 2.5 * t * t + 1
           : t < 2 ? -0.5 * t * t * t + 2.5 * t * t - 4 * t + 2
                   : 0;
  };
  const auto at = [&](std::int64_t k) {
    return cubic(std::abs(T(k) + T(0.5) - scale * (T(i) + T(0.5))) / stretch);
  };
  T total = 0;
  for (std::int64_t k = 0; k < in; ++k) total += at(k);
  return at(j) / total;
}

}  // namespace lvggt::reference
