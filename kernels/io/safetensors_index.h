// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <span>
#include <string>
#include <vector>

#include "lvggt/io/safetensors.h"

namespace lvggt {

// The index of a model in several files: {"weight_map": {"tensor name": "file name", ...}, ...}.
struct SafetensorsIndex {
  std::string path;
  std::vector<std::string> shards;                           // paths, in order of their names
  std::map<std::string, std::size_t, std::less<>> shard_of;  // tensor name -> index of shards
};

// Reads and checks an index: file names without any folder, and as many as their "-of-N" says.
SafetensorsIndex read_safetensors_index(const std::string& path, const Limits& limits);

// Checks that the shards hold exactly the tensors of the index, each where the index says, and that
// no two shards are one file. `files` and the file_idx of `entries` follow index.shards.
void check_safetensors_index(const SafetensorsIndex& index, std::span<const TensorEntry> entries,
                             std::span<const InputFile> files);

}  // namespace lvggt
