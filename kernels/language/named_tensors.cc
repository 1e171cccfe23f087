// SPDX-License-Identifier: Apache-2.0
#include "kernels/language/named_tensors.h"

#include <algorithm>

#include "lvggt/kernels/elementwise.h"

namespace lvggt {

void NamedTensors::require(const std::vector<std::string>& names) const {
  std::string missing;
  std::size_t count = 0;
  for (const std::string& name : names) {
    if (has(name)) continue;
    missing += (count++ == 0 ? "" : ", ") + name;
  }
  if (count > 0)
    fail(ErrorKind::kMismatch, file_.path(), ": ", count, " tensors of ", what_,
         " are missing: ", missing);
}

Storage NamedTensors::storage_of(const std::string& name) const {
  switch (file_.at(name).dtype) {
    case Dtype::kBF16:
      return Storage::kBf16;
    case Dtype::kF16:
      return Storage::kF16;
    default:
      return Storage::kF32;
  }
}

std::int64_t NamedTensors::extent(const std::string& name, std::size_t rank,
                                  std::size_t axis) const {
  const TensorEntry& entry = file_.at(name);
  if (entry.shape.size() != rank)
    fail(ErrorKind::kMismatch, file_.path(), ": ", name, " of ", what_, " is ",
         shape_text(entry.shape), ", expected ", rank, " dimensions");
  if (entry.shape[axis] < 1)
    fail(ErrorKind::kMismatch, file_.path(), ": ", name, " of ", what_, " is ",
         shape_text(entry.shape), ", which holds nothing");
  return entry.shape[axis];
}

void NamedTensors::check_shape(const std::string& name,
                               std::span<const std::int64_t> expected) const {
  const TensorEntry& entry = file_.at(name);
  const auto& found = entry.shape;
  bool fits = found.size() == expected.size();
  for (std::size_t i = 0; fits && i < found.size(); ++i)
    fits = expected[i] == kAnyExtent || found[i] == expected[i];
  if (fits) return;
  const bool transposed = found.size() == 2 && expected.size() == 2 && found[0] == expected[1] &&
                          found[1] == expected[0];
  fail(ErrorKind::kMismatch, file_.path(), ": ", name, " of ", what_, " is ", shape_text(found),
       ", expected ", shape_text(expected), transposed ? "; it looks transposed" : "");
}

void NamedTensors::check_finite(const std::string& name, std::span<const float> values) const {
  const std::int64_t at = find_nonfinite(
      View<const float, 1>(values.data(), Shape{static_cast<std::int64_t>(values.size())}));
  if (at >= 0)
    fail(ErrorKind::kFormat, file_.path(), ": ", name, " of ", what_, " holds ",
         values[static_cast<std::size_t>(at)], " at element ", at);
}

Linear NamedTensors::linear(const std::string& weight, const std::string& bias, std::int64_t N,
                            std::int64_t K) const {
  Linear layer;
  layer.weight = pack_linear(read<2>(weight, Shape{N, K}), storage_of(weight));
  if (!bias.empty()) layer.bias = read<1>(bias, Shape{N});
  return layer;
}

LayerNorm NamedTensors::layer_norm(const std::string& prefix, std::int64_t C, float eps) const {
  return {read<1>(prefix + ".weight", Shape{C}), read<1>(prefix + ".bias", Shape{C}), eps};
}

}  // namespace lvggt
