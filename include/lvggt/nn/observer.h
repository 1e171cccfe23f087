// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string_view>

#include "lvggt/core/tensor.h"

namespace lvggt {

// Sees intermediate values while a model runs, for checking and debugging. Passed as a pointer,
// null when nobody looks: then it costs nothing.
class Observer {
 public:
  virtual ~Observer() = default;

  // `name` is the value's name in the reference dumps or the nearest to it, `idx` the layer, stage
  // or iteration it belongs to (0 when there is one only). The rows may be strided and are valid
  // during the call.
  virtual void observe(std::string_view name, std::int64_t idx, View<const float, 2> rows) = 0;
};

}  // namespace lvggt
