// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "lvggt/core/parallel.h"
#include "lvggt/model/config.h"
#include "lvggt/model/stream_options.h"

namespace lvggt {

// Seconds of model time for one frame.
struct TimePlan {
  double first_frame = 0;  // alone
  double full_window = 0;  // with max_past_frames in the cache
};

// What a stream over frames of H x W will take on this machine, without loading a model: one
// transformer block, attention over one cached frame, a convolution and the reading of weights are
// timed on random numbers of the model's sizes, and multiplied. Takes the time of a few blocks and
// about their memory. Weights are kept as storage_of says, given their names in the checkpoint.
TimePlan plan_time(const ModelConfig& config, std::int64_t H, std::int64_t W,
                   const StreamOptions& options,
                   FunctionRef<Storage(const std::string& weight)> storage_of, Context& ctx);

}  // namespace lvggt
