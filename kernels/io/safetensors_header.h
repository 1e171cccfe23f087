// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/io/safetensors.h"

namespace lvggt {

struct SafetensorsHeader {
  std::vector<TensorEntry> entries;  // offsets count from the first byte after the header
  std::map<std::string, std::string> metadata;
};

// Parses the JSON header of `path` and checks every field, the names, and that the tensors fill the
// `data_bytes` after the header without gap or overlap.
SafetensorsHeader parse_safetensors_header(std::string_view json, std::int64_t data_bytes,
                                           const std::string& path, const Limits& limits);

// Rules for the name of a tensor, of reader and writer alike: a reason to refuse it, or empty.
std::string tensor_name_fault(std::string_view name, const Limits& limits);

}  // namespace lvggt
