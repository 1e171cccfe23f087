// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <vector>

#include "lvggt/data/supervision.h"
#include "lvggt/language/autoencoder.h"
#include "lvggt/language/clip.h"

namespace lvggt {

// A frame's language features as 4DLangSplat stores them: which vector belongs to a pixel.
struct FrameFeatures {
  Tensor<float, 3> rows;      // s: [levels, H, W], row of `features` or -1
  Tensor<float, 2> features;  // f: [n, D]
};

// CLIP supervision: each object of each level is cut out (language/crops.h), encoded and given to
// its pixels; rows count through default, small, middle, large. Objects whose box is empty get
// none. One level of labels stands for all four, which then share their rows. Values are rounded to
// half precision, as published.
//   rgb: [H, W, 3]   labels: [4 or 1, H, W]
FrameFeatures make_clip_features(View<const std::uint8_t, 3> rgb,
                                 View<const std::int32_t, 3> labels, const ClipImage& clip,
                                 Context& ctx);

// Dynamic supervision: each object's sentence as a vector, a row for every object by ascending
// label; without a sentence it is all zeros. The first level counts.
//   labels: [4 or 1, H, W]   sentence_of: vectors [width] by label
FrameFeatures make_sentence_features(
    View<const std::int32_t, 3> labels,
    const std::map<std::int32_t, View<const float, 1>>& sentence_of, std::int64_t width);

// The same features as codes of the autoencoder; rows of zeros stay zero.
Tensor<float, 2> encode_features(View<const float, 2> features, const Autoencoder& autoencoder,
                                 Context& ctx);

// Writes STEM_f.npy, then STEM_s.npy, so that the second says that both are there. s is float32; f
// is float32 for CLIP and codes, float64 for raw sentence features, as published.
void write_features(const std::string& stem, View<const float, 3> rows,
                    View<const float, 2> features, bool in_double);

}  // namespace lvggt
