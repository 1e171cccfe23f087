// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "lvggt/core/storage.h"
#include "lvggt/model/window_policy.h"

namespace lvggt {

enum class CameraCache {
  kStream,  // the camera head's attention sees its own entries of earlier frames, one per iteration
  kPerFrame,  // each frame alone, as the released 4DLangVGGT demo does
};

struct StreamOptions {
  std::int64_t max_past_frames = 128;  // frames kept in the caches after each push; at least 1
  WindowPolicy window = {};            // which of them make room; as published, the oldest
  CameraCache camera_cache = CameraCache::kStream;
  Storage cache_storage = Storage::kF32;  // of the cached keys and values: f32, bf16 or int8
  // Give a camera whose pose encoding cannot be decoded (a field of view of 0, say) focal lengths
  // of NaN, instead of failing: for looking at a model, not for using what it says.
  bool allow_degenerate_camera = false;
  bool points = false;              // run the point head
  bool rgb = true;                  // run the RGB head, if the decoder has one
  bool decoder = true;              // run the decoder, if there is one
  std::int64_t decoder_height = 0;  // size of rgb and language; both 0: the frame's size
  std::int64_t decoder_width = 0;
};

// Largest side of a frame and of the decoder's outputs.
inline constexpr std::int64_t kMaxSide = 16384;

}  // namespace lvggt
