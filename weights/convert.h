// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/io/dtype.h"
#include "weights/weight_source.h"

namespace lvggt {

struct ConvertOptions {
  std::optional<Dtype> dtype;  // of floating-point tensors in the output; otherwise as they are
  std::string config;          // JSON text to keep in the metadata; otherwise the input's, if any
  std::vector<std::string> drop;      // tensors whose names begin so are left out
  std::function<void()> before_each;  // called before each tensor is written; may throw to stop
  bool allow_nonfinite = false;       // accept NaN and infinity
};

struct ConvertResult {
  std::size_t num_tensors = 0;
  std::size_t num_dropped = 0;
  std::int64_t num_values = 0;
  std::int64_t num_bytes = 0;
  std::vector<std::string> warnings;  // tensors of zeros and the like, one sentence each
};

// Writes the tensors of `source` under their own names to one safetensors file, one at a time, with
// every value checked on the way. A value that is NaN or infinite, or becomes so in the output's
// type, is a kFormat Error that names the tensor.
ConvertResult convert_weights(WeightSource& source, const std::string& output,
                              const ConvertOptions& options);

}  // namespace lvggt
