// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "lvggt/io/safetensors.h"

namespace lvggt {

// The tensors of a weights file of either kind the programs take: safetensors (one file, an index
// or a folder) or a PyTorch checkpoint.
class WeightSource {
 public:
  // Tells the two kinds apart by their first bytes.
  static std::unique_ptr<WeightSource> open(const std::string& path);
  virtual ~WeightSource() = default;

  // "safetensors" or "PyTorch checkpoint".
  virtual std::string format() const = 0;
  virtual std::vector<std::string> files() const = 0;
  // Only name, dtype, shape and num_bytes of an entry mean something here.
  virtual const std::vector<TensorEntry>& tensors() const = 0;
  virtual std::map<std::string, std::string> metadata() const { return {}; }
  // What was done or left out while opening, one sentence each.
  virtual std::vector<std::string> notes() const { return {}; }

  // The values of tensors()[i] row-major; out.size() must be its num_bytes.
  virtual void read(std::size_t i, std::span<std::byte> out) = 0;
};

}  // namespace lvggt
