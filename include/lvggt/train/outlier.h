// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <charconv>
#include <cmath>
#include <cstddef>
#include <deque>
#include <optional>
#include <string>
#include <string_view>

#include "lvggt/core/error.h"
#include "lvggt/io/json_writer.h"

namespace lvggt {

// How far a number lies from the last ones of its kind, in their standard deviations.
class OutlierDetector {
 public:
  static constexpr std::size_t kWindow = 128;
  static constexpr std::size_t kFewest = 32;  // before that, nothing is called an outlier

  // The z-score of `value` against those added before, which it then joins; nothing while they are
  // too few or all equal, and for values that are not finite, which never join.
  std::optional<double> add(double value) {
    if (!std::isfinite(value)) return std::nullopt;
    std::optional<double> z;
    if (values_.size() >= kFewest) {
      const auto n = static_cast<double>(values_.size());
      double mean = 0, variance = 0;
      for (const double x : values_) mean += x;
      mean /= n;
      for (const double x : values_) variance += (x - mean) * (x - mean) / n;
      // What rounding alone makes of equal values is no deviation.
      if (std::sqrt(variance) > 1e-9 * std::abs(mean)) z = (value - mean) / std::sqrt(variance);
    }
    values_.push_back(value);
    if (values_.size() > kWindow) values_.pop_front();
    return z;
  }

  // The window as text, for a checkpoint, and back to the same bits.
  std::string text() const {
    std::string text;
    for (const double value : values_) {
      if (!text.empty()) text += ' ';
      append_number(text, value);
    }
    return text;
  }
  static OutlierDetector parse(std::string_view text) {
    OutlierDetector detector;
    while (!text.empty()) {
      double value = 0;
      const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
      if (error != std::errc())
        fail(ErrorKind::kFormat, "outliers: '", text.substr(0, 20), "' is no number");
      detector.values_.push_back(value);
      text.remove_prefix(static_cast<std::size_t>(end - text.data()));
      if (text.starts_with(' ')) text.remove_prefix(1);
    }
    return detector;
  }

 private:
  std::deque<double> values_;
};

}  // namespace lvggt
