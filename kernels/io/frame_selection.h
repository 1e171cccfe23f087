// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "lvggt/io/frame_source.h"

namespace lvggt::detail {

// kUsage when an option is out of range.
void check_options(const FrameSourceOptions& options);

// kUsage when an input of num_frames `what` ("images", "frames") ends before the first selected
// one.
void check_start(const FrameSourceOptions& options, std::int64_t num_frames, const char* what);

// How many of num_frames frames the options select.
std::int64_t num_selected(const FrameSourceOptions& options, std::int64_t num_frames);

// Whether the frame is one of start, start + stride, ...; max_frames is for the caller to count.
bool is_selected(const FrameSourceOptions& options, std::int64_t index);

}  // namespace lvggt::detail
