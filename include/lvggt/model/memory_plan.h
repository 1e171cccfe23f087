// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

#include "lvggt/core/parallel.h"
#include "lvggt/model/config.h"
#include "lvggt/model/storage_policy.h"
#include "lvggt/model/stream_options.h"

namespace lvggt {

// Bytes that a stream over frames of H x W needs; `total` is the sum.
struct MemoryPlan {
  std::size_t weights = 0;  // packed model, with the decoder
  std::size_t cache = 0;    // keys and values when max_past_frames + 1 frames have been seen
  std::size_t arenas = 0;   // scratch, tables and outputs
  std::size_t total = 0;
};

// What is needed without loading anything; within about a tenth of the measured memory. Weights are
// kept as the policy says, or as storage_of, given their names in the checkpoint.
MemoryPlan plan_memory(const ModelConfig& config, std::int64_t H, std::int64_t W,
                       const StreamOptions& options = {}, const StoragePolicy& storage = {});
MemoryPlan plan_memory(const ModelConfig& config, std::int64_t H, std::int64_t W,
                       const StreamOptions& options,
                       FunctionRef<Storage(const std::string& weight)> storage_of);

// The same for a TokenStream, which is the encoder without heads and decoder.
MemoryPlan plan_token_memory(const ModelConfig& config, std::int64_t H, std::int64_t W,
                             const StreamOptions& options,
                             FunctionRef<Storage(const std::string& weight)> storage_of);

}  // namespace lvggt
