// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <utility>
#include <vector>

namespace lvggt {

// First and last frame, both included; frames are counted from 0.
using FrameInterval = std::pair<std::int64_t, std::int64_t>;

// The published weights of one or two neighbours on either side.
inline constexpr float kThreeTaps[] = {0.1F, 0.8F, 0.1F};
inline constexpr float kFiveTaps[] = {0.1F, 0.2F, 0.4F, 0.2F, 0.1F};

// smoothed[i] = sum over k of taps[k] values[i - m + k], m = (number of taps - 1) / 2; the first
// and last m values stay as they are. Neighbours are neighbours in the list. Errors: kUsage for an
// even number of taps.
std::vector<float> smooth_series(std::span<const float> values,
                                 std::span<const float> taps = kThreeTaps);

// When a state holds.
struct TimeAnswer {
  std::vector<float> similarity;  // as it was given, one value a frame
  std::vector<float> smoothed;
  float threshold = 0;                 // mean of the unsmoothed similarities
  std::vector<std::uint8_t> positive;  // 1 where smoothed >= threshold
};

// Smooths the series and compares it with its mean. An empty series has the threshold 0; a constant
// one is positive everywhere.
TimeAnswer answer_over_time(std::span<const float> similarity,
                            std::span<const float> taps = kThreeTaps);

// Runs of positive frames as intervals of frame indices; a run ends where the list goes on to a
// negative frame, whatever the gap between the indices of its neighbours.
//   positive, frames: one an entry, frames ascending
std::vector<FrameInterval> positive_intervals(std::span<const std::uint8_t> positive,
                                              std::span<const std::int64_t> frames);

// Whether a frame lies in any of the intervals.
bool in_intervals(std::int64_t frame, std::span<const FrameInterval> intervals);

}  // namespace lvggt
