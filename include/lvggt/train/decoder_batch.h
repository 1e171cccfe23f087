// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>

#include "lvggt/core/tensor.h"

namespace lvggt {

// What one optimisation step of the decoder reads: B frames, all of one size.
template <class T>
struct BasicDecoderBatch {
  std::int64_t h = 0, w = 0;             // patch grid
  std::array<View<const T, 3>, 4> taps;  // [B, h*w, 2C], patch tokens only
  View<const T, 4> images;               // [B, H, W, 3] in [0, 1]; may be empty without RGB head
  View<const T, 5> features;             // [B, levels, H, W, d], targets
  View<const T, 4> mask;                 // [B, levels, H, W], 1: labelled, 0: hole

  std::int64_t num_frames() const { return taps[3].extent(0); }
  std::int64_t height() const { return features.extent(2); }
  std::int64_t width() const { return features.extent(3); }
};

// Frames [begin, end) of a batch.
template <class T>
BasicDecoderBatch<T> frames_of(const BasicDecoderBatch<T>& batch, std::int64_t begin,
                               std::int64_t end) {
  BasicDecoderBatch<T> part = batch;
  for (auto& tap : part.taps) tap = tap.narrow(0, begin, end);
  if (part.images) part.images = part.images.narrow(0, begin, end);
  part.features = part.features.narrow(0, begin, end);
  part.mask = part.mask.narrow(0, begin, end);
  return part;
}

// What the decoder makes of a batch; an empty view is not wanted.
template <class T>
struct BasicDecoderOutputs {
  View<T, 5> language;  // [B, levels, H, W, d]
  View<T, 4> rgb;       // [B, H, W, 3]
};

using DecoderBatch = BasicDecoderBatch<float>;
using DecoderOutputs = BasicDecoderOutputs<float>;

}  // namespace lvggt
