// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>
#include <numbers>

#include "lvggt/core/error.h"

namespace lvggt {

enum class Decay { kConstant, kCosine };

// The learning rate as a function of the step: linear warm-up, then constant or half a cosine.
struct Schedule {
  double learning_rate = 4e-5;      // at the end of the warm-up
  double min_learning_rate = 1e-6;  // at the end of the cosine
  std::int64_t warmup_steps = 0;
  std::int64_t total_steps = 0;  // of the cosine, with the warm-up; 0 only for a constant rate
  Decay decay = Decay::kConstant;
};

// Throws kUsage when values do not fit together.
inline void validate_schedule(const Schedule& s) {
  if (!(s.learning_rate > 0) || !std::isfinite(s.learning_rate))
    fail(ErrorKind::kUsage, "schedule: the learning rate is ", s.learning_rate, ", not above 0");
  if (s.warmup_steps < 0)
    fail(ErrorKind::kUsage, "schedule: ", s.warmup_steps, " warm-up steps make no sense");
  if (s.decay == Decay::kConstant) return;
  if (!(s.min_learning_rate >= 0) || s.min_learning_rate > s.learning_rate)
    fail(ErrorKind::kUsage, "schedule: the least learning rate is ", s.min_learning_rate,
         ", not between 0 and the rate ", s.learning_rate);
  if (s.total_steps <= s.warmup_steps)
    fail(ErrorKind::kUsage, "schedule: a cosine over ", s.total_steps,
         " steps ends before its warm-up of ", s.warmup_steps);
}

// Rate of step `step` = 0, 1, ...: during the warm-up lr (step + 1) / warmup, so that it is never
// 0; with t = step - warmup and T = total - warmup afterwards
//   cosine: min + (lr - min) (1 + cos(pi t / T)) / 2, and min from step `total` on.
inline double learning_rate_at(const Schedule& s, std::int64_t step) {
  if (step < s.warmup_steps)
    return s.learning_rate * static_cast<double>(step + 1) / static_cast<double>(s.warmup_steps);
  if (s.decay == Decay::kConstant) return s.learning_rate;
  if (step >= s.total_steps) return s.min_learning_rate;
  const double part = static_cast<double>(step - s.warmup_steps) /
                      static_cast<double>(s.total_steps - s.warmup_steps);
  return s.min_learning_rate +
         (s.learning_rate - s.min_learning_rate) * 0.5 * (1 + std::cos(std::numbers::pi * part));
}

}  // namespace lvggt
