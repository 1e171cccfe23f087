// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <fstream>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/io/json.h"

namespace lvggt {

// One line of a training's log, a JSON object. Numbers are written so that they read back as the
// same bits; NaN and infinity, which JSON lacks, become null.
class LogLine {
 public:
  explicit LogLine(std::int64_t step) { add("step", step); }

  void add(std::string_view key, double value);
  void add(std::string_view key, std::int64_t value);
  void add(std::string_view key, std::string_view value);

  std::string text() const { return "{" + members_ + "}"; }

 private:
  void add_key(std::string_view key);
  std::string members_;
};

// The log of a training, a line for each step and each evaluation: JSON lines, appended and flushed
// one by one, so that it can be followed while training runs. Errors: kWrite, kRead.
class TrainingLog {
 public:
  // Starts a new log, in place of an older one.
  static TrainingLog start(const std::string& path);

  // Goes on after `step`: later lines, which belong to steps that are done again, and a last line
  // that was cut are dropped. A missing log starts anew.
  static TrainingLog resume(const std::string& path, std::int64_t step);

  void append(const LogLine& line);

 private:
  TrainingLog(const std::string& path, bool append);

  std::string path_;
  std::ofstream file_;
};

// The lines of a log that are whole; nothing for a missing file.
std::vector<Json> read_log(const std::string& path);

// Numbers of one member of the lines that have it, over their steps: the points of a curve.
std::vector<std::array<double, 2>> log_curve(const std::vector<Json>& lines, std::string_view key);

// The log as a table with a column for every member any line has, in the order they first appear.
std::string log_csv(const std::vector<Json>& lines);

// Draws losses, scores and learning rate of a log over the steps.
//   -> [H, W, 3]
Tensor<std::uint8_t, 3> draw_loss_curve(const std::vector<Json>& lines, const std::string& title);

}  // namespace lvggt
