// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <vector>

namespace lvggt {

// What becomes of the samples that do not fill a batch at the end of an epoch. A data set smaller
// than a batch always gives one batch of all its samples.
enum class LastBatch { kDrop, kKeep };

struct OrderOptions {
  std::int64_t batch_size = 8;  // over all ranks
  bool shuffle = true;
  std::uint64_t seed = 0;
  LastBatch last = LastBatch::kDrop;
};

// A permutation of 0 .. n-1 that depends on seed and epoch only, the same on every machine.
std::vector<std::int64_t> shuffled(std::int64_t n, std::uint64_t seed, std::int64_t epoch);

// The batches of an epoch, as sample numbers. `groups` gives each sample's group: samples of
// different groups (sizes of frames) never share a batch. In shuffled order a batch of a group is
// complete when its last sample comes up, so that groups mix. The number of batches is the same in
// every epoch.
std::vector<std::vector<std::int64_t>> epoch_batches(std::span<const std::int64_t> groups,
                                                     const OrderOptions& options,
                                                     std::int64_t epoch);

}  // namespace lvggt
