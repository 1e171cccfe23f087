// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/model/config.h"
#include "weights/weight_source.h"

namespace lvggt {

// Everything that can be said about a weights file without running it.
struct WeightsDescription {
  struct Part {  // tensors whose names begin with the same component
    std::int64_t num_tensors = 0;
    std::int64_t num_values = 0;
  };

  std::string format;
  std::vector<std::string> files;
  std::vector<std::string> notes;  // from opening
  std::string contents;            // which model it looks like
  std::string licence;
  std::int64_t num_tensors = 0;
  std::int64_t num_values = 0;
  std::int64_t num_bytes = 0;
  std::map<std::string, std::int64_t> dtypes;  // number of tensors of each element type
  std::map<std::string, Part> parts;
  std::map<std::string, std::string> metadata;  // without the configuration

  std::optional<ModelConfig> config;
  bool config_from_metadata = false;  // otherwise from the shapes
  // How the tensors compare with what the configuration needs; one entry a tensor.
  std::vector<std::string> missing;
  std::vector<std::string> misshapen;  // with both shapes
  std::vector<std::string> extra;      // besides those known to be unused

  // Filled by check_values: tensors with NaN or infinity, all zero, or mostly subnormal.
  bool checked = false;
  std::vector<std::string> suspicious;
};

// Describes the file, the index or the folder at `path`.
WeightsDescription describe_weights(const std::string& path);

// Reads every value of `path` and fills `suspicious`.
void check_values(const std::string& path, WeightsDescription& description);

// For people, and as one JSON object. `sha256` is the file's sum, or empty.
std::string description_text(const WeightsDescription& description, const std::string& sha256);
std::string description_json(const WeightsDescription& description, const std::string& sha256);

}  // namespace lvggt
