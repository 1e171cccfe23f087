// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/field/line_plot.h"

namespace lvggt {

// A value over time, the threshold it is compared with, and where it passes.
struct TimeLine {
  std::string title;
  std::string value_name, smoothed_name;  // for the legend
  std::vector<double> seconds;            // of each frame, ascending
  std::vector<float> values, smoothed;    // one a frame; smoothed may be empty
  float threshold = 0;
  std::vector<std::uint8_t> positive;  // one a frame: shaded
};

// Stretches of time around runs of positive frames: half-way to the neighbours on either side, so
// that a single frame has a width too.
inline std::vector<std::array<double, 2>> positive_bands(
    const std::vector<double>& seconds, const std::vector<std::uint8_t>& positive) {
  LVGGT_CHECK(seconds.size() == positive.size(), "time line: there are ", seconds.size(),
              " times but ", positive.size(), " answers");
  std::vector<std::array<double, 2>> bands;
  for (std::size_t i = 0; i < seconds.size(); ++i) {
    if (positive[i] == 0) continue;
    const double low = i > 0 ? (seconds[i - 1] + seconds[i]) / 2 : seconds[i];
    const double high = i + 1 < seconds.size() ? (seconds[i] + seconds[i + 1]) / 2 : seconds[i];
    if (!bands.empty() && i > 0 && positive[i - 1] != 0)
      bands.back()[1] = high;
    else
      bands.push_back({low, high});
  }
  return bands;
}

// One panel for each: the values grey where they are smoothed, their smoothed line, the threshold,
// the intervals shaded.
//   -> [H, W, 3]
inline Tensor<std::uint8_t, 3> draw_time_lines(const std::vector<TimeLine>& lines) {
  constexpr std::int64_t kWidth = 960, kPanelHeight = 220;
  constexpr Rgb8 kValueColor{40, 90, 170}, kRawColor{150, 150, 150}, kThresholdColor{200, 60, 40};
  std::vector<PlotPanel> panels;
  for (const TimeLine& line : lines) {
    LVGGT_CHECK(line.values.size() == line.seconds.size() && !line.values.empty() &&
                    (line.smoothed.empty() || line.smoothed.size() == line.values.size()),
                "time line: there are ", line.seconds.size(), " times, ", line.values.size(),
                " values and ", line.smoothed.size(), " smoothed ones");
    const auto curve = [&](const std::string& name, const std::vector<float>& values, bool raw) {
      Curve made{name, raw ? kRawColor : kValueColor, {}, false};
      for (std::size_t i = 0; i < values.size(); ++i)
        made.points.push_back({line.seconds[i], values[i]});
      return made;
    };
    PlotPanel panel;
    panel.title = line.title;
    panel.x_label = "seconds";
    panel.bands = positive_bands(line.seconds, line.positive);
    panel.curves.push_back(curve(line.value_name, line.values, !line.smoothed.empty()));
    if (!line.smoothed.empty())
      panel.curves.push_back(curve(line.smoothed_name, line.smoothed, false));
    // Drawn through every frame, so that a plot of one frame shows it as well.
    panel.curves.push_back({"threshold", kThresholdColor, {}, false});
    for (const double second : line.seconds)
      panel.curves.back().points.push_back({second, line.threshold});
    panels.push_back(std::move(panel));
  }
  return LinePlot(kWidth, kPanelHeight).draw(panels);
}

}  // namespace lvggt
