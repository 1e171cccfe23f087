// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <string>

#include "examples/query_video/options.h"
#include "lvggt/core/context.h"

namespace query_video {

// Where a video that is asked directly is lifted to, inside of the output folder.
inline constexpr const char* kLiftedFolder = "field";

// Runs the model over the video in o.field and leaves in `folder` what a question needs: codes,
// frames, depth, confidence and cameras. prepare() is called before anything is written, once the
// input, the model and the memory have been checked. Errors: those of lift_video; kInterrupted when
// the user asks to stop, after which the folder holds the frames that are complete.
void lift_first(const Options& o, const std::string& folder, const std::function<void()>& prepare,
                lvggt::Context& ctx);

}  // namespace query_video
