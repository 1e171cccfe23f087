// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/time_series.h"

#include <algorithm>

#include "lvggt/core/error.h"

namespace lvggt {

std::vector<float> smooth_series(std::span<const float> values, std::span<const float> taps) {
  if (taps.size() % 2 == 0)
    fail(ErrorKind::kUsage, "time series: ", taps.size(),
         " weights have no centre; their number must be odd");
  const std::size_t m = taps.size() / 2;
  std::vector<float> smoothed(values.begin(), values.end());
  for (std::size_t i = m; i + m < values.size(); ++i) {
    // In float and in this order, as published.
    float sum = 0;
    for (std::size_t k = 0; k < taps.size(); ++k) sum += taps[k] * values[i - m + k];
    smoothed[i] = sum;
  }
  return smoothed;
}

TimeAnswer answer_over_time(std::span<const float> similarity, std::span<const float> taps) {
  TimeAnswer answer;
  answer.similarity.assign(similarity.begin(), similarity.end());
  answer.smoothed = smooth_series(similarity, taps);
  double sum = 0;
  for (const float value : similarity) sum += value;
  if (!similarity.empty())
    answer.threshold = static_cast<float>(sum / static_cast<double>(similarity.size()));
  // Smoothing rounds: a constant series must not fall below its own mean.
  const bool constant = !similarity.empty() && std::ranges::all_of(similarity, [&](float v) {
    return v == similarity[0];
  });
  for (const float value : answer.smoothed)
    answer.positive.push_back(constant || value >= answer.threshold ? 1 : 0);
  return answer;
}

std::vector<FrameInterval> positive_intervals(std::span<const std::uint8_t> positive,
                                              std::span<const std::int64_t> frames) {
  LVGGT_CHECK(positive.size() == frames.size(), "time series: ", positive.size(), " answers for ",
              frames.size(), " frames");
  std::vector<FrameInterval> intervals;
  bool open = false;
  for (std::size_t i = 0; i < frames.size(); ++i) {
    if (positive[i] != 0) {
      if (!open) intervals.emplace_back(frames[i], frames[i]);
      intervals.back().second = frames[i];
    }
    open = positive[i] != 0;
  }
  return intervals;
}

bool in_intervals(std::int64_t frame, std::span<const FrameInterval> intervals) {
  return std::ranges::any_of(intervals, [&](const FrameInterval& interval) {
    return interval.first <= frame && frame <= interval.second;
  });
}

}  // namespace lvggt
