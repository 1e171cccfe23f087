// SPDX-License-Identifier: Apache-2.0
// Private: tensors of a published checkpoint, read by name with their faults reported in one
// sentence.
#pragma once

#include <string>
#include <vector>

#include "lvggt/io/safetensors.h"
#include "lvggt/nn/params.h"

namespace lvggt {

// Any extent will do.
inline constexpr std::int64_t kAnyExtent = -1;

class NamedTensors {
 public:
  // `what` names the model in messages: "CLIP's text tower".
  NamedTensors(const Safetensors& file, std::string what) : file_(file), what_(std::move(what)) {}

  bool has(const std::string& name) const { return file_.find(name) != nullptr; }

  // kMismatch naming all that are missing.
  void require(const std::vector<std::string>& names) const;

  // Checks rank and extents (kAnyExtent matches all), reads as float32 and refuses NaN and
  // infinity.
  template <int R>
  Tensor<float, R> read(const std::string& name, Shape<R> expected) const {
    check_shape(name, expected.extents);
    Tensor<float, R> values = file_.read<R>(name);
    check_finite(name, {values.data(), static_cast<std::size_t>(values.size())});
    return values;
  }

  // Packed as narrow as the file has it; `bias` may be empty.   weight: [N, K]
  Linear linear(const std::string& weight, const std::string& bias, std::int64_t N,
                std::int64_t K) const;
  LayerNorm layer_norm(const std::string& prefix, std::int64_t C, float eps) const;

  Storage storage_of(const std::string& name) const;
  const std::string& path() const { return file_.path(); }

  // Extent `axis` of a tensor of that rank.
  std::int64_t extent(const std::string& name, std::size_t rank, std::size_t axis) const;

  void check_shape(const std::string& name, std::span<const std::int64_t> expected) const;

 private:
  void check_finite(const std::string& name, std::span<const float> values) const;

  const Safetensors& file_;
  std::string what_;
};

}  // namespace lvggt
