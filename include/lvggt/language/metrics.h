// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"

namespace lvggt {

// Intersection over union of two masks: 1 when both are empty, 0 when one is.
//   a, b: [H, W], 0 or 1
double mask_iou(View<const std::uint8_t, 2> a, View<const std::uint8_t, 2> b);

// Share of pixels whose label is right.   a, b: [H, W], 0 or 1, at least one pixel
double pixel_accuracy(View<const std::uint8_t, 2> a, View<const std::uint8_t, 2> b);

// Time-agnostic scores of one frame and phrase.
struct MaskScore {
  std::int64_t frame = 0;  // frame index from 0
  double iou = 0, accuracy = 0;
};

// Of one phrase: means over the frames that annotate it.
struct PhraseScore {
  std::string phrase;
  std::vector<MaskScore> frames;
  double iou() const;
  double accuracy() const;
};

// mIoU and mAcc: means over the phrases of their means. No phrases: 0.
struct MeanScore {
  double iou = 0, accuracy = 0;
};
MeanScore mean_score(std::span<const PhraseScore> phrases);

// Time-sensitive scores of one sentence over the annotated frames.
struct StateScore {
  double accuracy = 0;   // Acc: share of frames whose call is right; no frames: 0
  double viou = 0;       // mean over frames positive in truth or prediction; 0 without any
  double precision = 0;  // 0 when no frame is called positive
  double recall = 0;     // 0 when no frame is positive
};

//   truth, prediction: 1 where positive   iou: of the frame's mask with the object's true one
// vIoU counts iou where both are positive and 0 where only one is.
StateScore score_state(std::span<const std::uint8_t> truth,
                       std::span<const std::uint8_t> prediction, std::span<const float> iou);

}  // namespace lvggt
