// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <string>

#include "lvggt/cli/memory.h"

namespace lvggt::cli {

// One way to need less memory: an option, its largest and smallest value, and what a run with it
// would need.
struct MemoryKnob {
  std::string option;
  std::int64_t low = 1, high = 1, step = 1;
  std::function<std::size_t(std::int64_t)> bytes;  // grows with its argument
};

// The largest value below `high` that fits, in steps from `low`; below `low` when none does.
inline std::int64_t largest_that_fits(const MemoryKnob& knob, std::size_t limit) {
  std::int64_t fits = -1, too_large = (knob.high - knob.low) / knob.step;
  while (too_large - fits > 1) {
    const std::int64_t middle = fits + (too_large - fits) / 2;
    (knob.bytes(knob.low + middle * knob.step) <= limit ? fits : too_large) = middle;
  }
  return knob.low + fits * knob.step;
}

// Options of another kind that need less memory, and what a run with them would need.
struct MemoryChoice {
  std::string options;
  std::size_t bytes = 0;
};

// Throws kMemory, with what would fit, when a run needs more than it may have: of the choices, the
// first that does, so they begin with the mildest.
inline void check_memory(std::size_t needed, const MemoryLimit& limit, const std::string& breakdown,
                         const std::vector<MemoryKnob>& knobs,
                         const std::vector<MemoryChoice>& choices = {}) {
  if (needed <= limit.bytes) return;
  std::string advice;
  for (const MemoryChoice& choice : choices) {
    if (choice.bytes > limit.bytes) continue;
    advice = "; " + choice.options;
    break;
  }
  for (const MemoryKnob& knob : knobs) {
    const std::int64_t value = largest_that_fits(knob, limit.bytes);
    if (value < knob.low) continue;
    advice += (advice.empty() ? "; " : " or ") + knob.option + " " + std::to_string(value);
  }
  fail(ErrorKind::kMemory, "the run needs about ", bytes_text(needed), " of memory (", breakdown,
       "), but it may have ", bytes_text(limit.bytes), " (", limit.reason, ")",
       advice.empty() ? "; no smaller setting fits" : advice + " would fit");
}

}  // namespace lvggt::cli
