// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>

namespace lvggt {

// Seconds spent in each stage.
struct StageTimes {
  double dino = 0;
  double frame_blocks = 0;
  double global_blocks = 0;
  double camera = 0;
  double depth = 0;
  double points = 0;
  double decoder = 0;
  double total = 0;
};

// Adds the seconds of its lifetime to one of them.
class StageTimer {
 public:
  explicit StageTimer(double& seconds) : seconds_(seconds) {}
  ~StageTimer() {
    seconds_ += std::chrono::duration<double>(std::chrono::steady_clock::now() - begin_).count();
  }
  StageTimer(const StageTimer&) = delete;
  StageTimer& operator=(const StageTimer&) = delete;

 private:
  double& seconds_;
  std::chrono::steady_clock::time_point begin_ = std::chrono::steady_clock::now();
};

}  // namespace lvggt
