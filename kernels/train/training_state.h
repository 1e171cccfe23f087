// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <span>
#include <string>

#include "lvggt/io/safetensors.h"
#include "lvggt/train/checkpoint.h"

namespace lvggt::training {

// The metadata of a training checkpoint. "config" is what every weights file of ours has.
inline constexpr const char* kConfigKey = "config";
inline constexpr const char* kStateKey = "training";
inline constexpr const char* kTensorSumsKey = "tensor_sha256";
inline constexpr const char* kHeaderSumKey = "header_sha256";

// The format of the state's JSON document; grows when an older reader would misread it.
inline constexpr std::int64_t kStateVersion = 1;

// The state as JSON text, without its configuration.
std::string state_json(const TrainingState& state, const std::string& tool_version);

struct ParsedState {
  TrainingState state;
  std::string tool_version;
};

// Reads the metadata of a checkpoint. `path` opens every message. Errors: kFormat, and kUnsupported
// for a later format.
ParsedState parse_state(const std::map<std::string, std::string>& metadata,
                        const std::string& path);

// SHA-256 of each tensor by name, as a JSON object and back.
std::string sums_json(const std::map<std::string, std::string>& sums);
std::map<std::string, std::string> parse_sums(const std::string& text, const std::string& path);

// SHA-256 over names, types and shapes of all tensors and over the metadata but this sum itself: a
// flipped bit anywhere in the header changes it or breaks the format.
std::string header_sum(std::span<const TensorEntry> entries,
                       const std::map<std::string, std::string>& metadata);

// SHA-256 of a text.
std::string text_sum(const std::string& text);

}  // namespace lvggt::training
