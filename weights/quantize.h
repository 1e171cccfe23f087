// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "lvggt/model/storage_policy.h"
#include "weights/weight_source.h"

namespace lvggt {

struct QuantizeOptions {
  StoragePolicy policy = StoragePolicy::of(Storage::kI8);
  std::vector<std::string> drop;  // tensors whose names begin so are left out
  // Called before each tensor is written; may throw to stop.
  std::function<void(std::size_t done, std::size_t total)> before_each;
};

// What becomes of the tensors of one kind: a name of kLayerKinds, or "others", which stay as they
// are.
struct QuantizedKind {
  std::string kind;
  std::string dtypes;  // of the tensors in the output, "I8"
  std::int64_t num_tensors = 0;
  std::int64_t bytes_before = 0;
  std::int64_t bytes_after = 0;  // with the scales
  // Of rounding: sqrt(sum (rounded - value)^2 / sum value^2); 0 in a plan.
  double relative_error = 0;
};

struct QuantizeResult {
  std::vector<QuantizedKind> kinds;  // those that the source has
  std::int64_t bytes_before = 0;
  std::int64_t bytes_after = 0;
};

// The same without reading a value or writing anything. Throws kMismatch for a source that is
// quantised already and kUnsupported, with tensor, type and shape, for a weight that cannot take
// its storage.
QuantizeResult plan_quantization(const WeightSource& source, const QuantizeOptions& options);

// Writes the tensors of `source` under their own names to one safetensors file, one at a time:
// weights of layers in the storages of the policy (see quantized_linear.h for int8; a type that is
// narrow enough already is left), everything else as it is. A value that is NaN or infinite, or
// becomes so in its storage, is a kFormat Error that names the tensor.
QuantizeResult quantize_weights(WeightSource& source, const std::string& output,
                                const QuantizeOptions& options);

}  // namespace lvggt
