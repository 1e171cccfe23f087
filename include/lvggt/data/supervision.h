// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include "lvggt/core/tensor.h"
#include "lvggt/io/preprocess.h"

namespace lvggt {

// What a decoder learns from: time-agnostic CLIP features on three levels of masks (small, middle,
// large), or features of sentences about what each object does in a frame, on one level.
enum class Supervision { kClip, kDynamic };

// "clip" or "dynamic"; anything else is a kUsage error.
Supervision parse_supervision(std::string_view name);
std::string_view supervision_name(Supervision kind);

// Which feature files of a scene are read: `dim` numbers a vector, as its autoencoder left them.
struct SupervisionSpec {
  Supervision kind = Supervision::kClip;
  std::int64_t dim = 3;  // as published 3 for CLIP, 6 for dynamic

  // Folder of the files in a scene, such as "clip_features-language_features_dim3".
  std::string folder() const;
  // Levels in a file: default, small, middle, large, or the only one.
  std::int64_t file_levels() const { return kind == Supervision::kClip ? 4 : 1; }
  // Levels to train on: without the default one.
  std::int64_t levels() const { return kind == Supervision::kClip ? 3 : 1; }

  friend bool operator==(const SupervisionSpec&, const SupervisionSpec&) = default;
};

// The labels of one frame as its files have them.
struct FrameLabels {
  Tensor<std::int32_t, 3> rows;  // [levels, H, W], row of `codes` or -1, in the original picture
  Tensor<float, 2> codes;        // [n, dim]
};

// Shapes of a frame's two files, from their headers.
struct LabelHeader {
  std::int64_t H = 0, W = 0;  // of the label map
  std::int64_t num_codes = 0;
};

// Checks the headers of the files NAME_s.npy and NAME_f.npy against `spec`. Errors: what NpyFile
// throws, and kMismatch for another number of levels or another width of the features.
LabelHeader check_labels(const std::string& rows_path, const std::string& codes_path,
                         const SupervisionSpec& spec);

// Reads both files. Errors: those of check_labels; kFormat for a label that is no whole number, is
// below -1 or at least the number of rows, naming level and pixel; kNumeric for a feature that is
// NaN or infinite, naming its row.
FrameLabels read_labels(const std::string& rows_path, const std::string& codes_path,
                        const SupervisionSpec& spec);

// Reads the features only: kNumeric as above.
void check_codes(const std::string& codes_path);

// How many of the labels of the trained levels stand for a vector. Dynamic vectors that are all
// zero belong to objects without a sentence and count as unlabelled.
std::int64_t num_labelled(const FrameLabels& labels, const SupervisionSpec& spec);

// The training targets of a frame: each pixel takes the label of the original pixel its centre
// falls into; what lies outside of the picture (padding) is unlabelled. With `original_size` the
// target has the pixels of the picture itself, turned if the transform turns it.
//   features: [levels, H, W, dim], 0 where unlabelled   mask: [levels, H, W], 1 labelled, 0 not
void paint_targets(View<float, 4> features, View<float, 3> mask, const FrameLabels& labels,
                   const SupervisionSpec& spec, const ImageTransform& transform,
                   bool original_size);

}  // namespace lvggt
