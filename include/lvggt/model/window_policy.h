// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>

#include "lvggt/core/error.h"

namespace lvggt {

// Which cached frame makes room when the window is full. As published, the oldest; beside that,
// frames worth more than their age can be kept: the first frame of the stream, which fixes the
// world frame, and every k-th frame, which keeps a long video in sight at a coarser step. The
// newest frame always stays.
struct WindowPolicy {
  bool keep_first = false;
  std::int64_t keep_every = 0;  // k; 0 keeps none. Frames are counted from 0 at the stream's start

  bool keeps(std::int64_t frame) const {
    return (keep_first && frame == 0) || (keep_every > 0 && frame % keep_every == 0);
  }

  // Index of the frame to evict from the numbers of the cached ones, oldest first: the oldest that
  // is not kept; when all but the newest are, the oldest that is not the kept first frame.
  std::int64_t evicted(std::span<const std::int64_t> frames) const {
    const std::int64_t older = static_cast<std::int64_t>(frames.size()) - 1;
    for (std::int64_t i = 0; i < older; ++i) {
      if (!keeps(frames[static_cast<std::size_t>(i)])) return i;
    }
    return keep_first && frames[0] == 0 && older > 1 ? 1 : 0;
  }

  void check() const {
    if (keep_every < 0)
      fail(ErrorKind::kUsage, "window: every ", keep_every,
           "-th frame cannot be kept; 0 keeps none");
  }
  friend bool operator==(const WindowPolicy&, const WindowPolicy&) = default;
};

}  // namespace lvggt
