// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/model/stream.h"

namespace lvggt {

// What narrow storage changes: |narrow - f32| / |f32|, Euclidean norms over all frames, of each
// output.
inline constexpr std::array<std::string_view, 4> kSensitivityOutputs{"pose", "depth", "semantics",
                                                                     "rgb"};

struct Sensitivity {
  std::string what;  // the kinds that are narrow, or a policy for all
  Storage weights = Storage::kF32;
  Storage cache = Storage::kF32;
  std::size_t bytes = 0;  // of these weights in this storage
  // Of kSensitivityOutputs; negative where the model has no such output.
  std::array<double, kSensitivityOutputs.size()> relative_l2{};
};

struct SensitivityOptions {
  std::int64_t frames = 2, H = 56, W = 84;
  std::uint64_t seed = 1;          // of the deterministic images
  std::vector<std::string> kinds;  // of kLayerKinds; empty: all that the model has
  std::vector<Storage> storages{Storage::kBf16, Storage::kI8};
  std::function<void(std::size_t done, std::size_t total)> before_each;
};

// Runs the model of `load` over deterministic frames in float32, then with one kind of layers after
// the other in each of the storages it can take, and then with caches and whole policies. One model
// is in memory at a time: only the layers of the kind are read again.
std::vector<Sensitivity> measure_sensitivity(const LoadOptions& load,
                                             const SensitivityOptions& options, Context& ctx);

}  // namespace lvggt
