// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <functional>
#include <string_view>

#include "lvggt/core/context.h"
#include "lvggt/train/communicator.h"

namespace lvggt {

// What the layers of one forward and backward pass share; everything is borrowed. Activations that
// a layer keeps for its backward pass live in the arena's scope that its forward pass was called
// in.
struct TrainingPass {
  Context& ctx;
  Communicator* ranks = nullptr;   // batch statistics over all ranks; null: this process alone
  bool frozen_statistics = false;  // batch norms use and keep the running statistics
  bool recompute = false;          // keep the stages' inputs only, compute the rest again
  double bn_eps = 0;
  double bn_momentum = 0;

  // Called with the prefix of parameters whose gradients are complete, in the order of the backward
  // pass; may be empty.
  std::function<void(std::string_view prefix)> gradients_ready{};

  double forward_seconds = 0, backward_seconds = 0;
};

// Adds the time until it goes out of scope.
class TimeInto {
 public:
  explicit TimeInto(double& seconds) : seconds_(seconds) {}
  ~TimeInto() {
    seconds_ += std::chrono::duration<double>(std::chrono::steady_clock::now() - start_).count();
  }
  TimeInto(const TimeInto&) = delete;
  TimeInto& operator=(const TimeInto&) = delete;

 private:
  double& seconds_;
  std::chrono::steady_clock::time_point start_ = std::chrono::steady_clock::now();
};

}  // namespace lvggt
