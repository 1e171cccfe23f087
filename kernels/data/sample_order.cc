// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/sample_order.h"

#include <algorithm>
#include <map>
#include <numeric>
#include <string>
#include <utility>

#include "lvggt/core/error.h"
#include "lvggt/model/deterministic_weights.h"

namespace lvggt {

namespace {

// The high half of bits * bound: a number in [0, bound), each with a probability off by less than
// bound / 2^64.
std::uint64_t below(std::uint64_t bits, std::uint64_t bound) {
  __extension__ using Wide = unsigned __int128;
  return static_cast<std::uint64_t>((static_cast<Wide>(bits) * bound) >> 64);
}

}  // namespace

std::vector<std::int64_t> shuffled(std::int64_t n, std::uint64_t seed, std::int64_t epoch) {
  std::vector<std::int64_t> order(static_cast<std::size_t>(n));
  std::iota(order.begin(), order.end(), 0);
  const std::string name = "sample order of epoch " + std::to_string(epoch);
  // Fisher-Yates, from the end.
  for (std::size_t i = order.size(); i > 1; --i)
    std::swap(order[i - 1], order[below(deterministic_bits(name, seed, i), i)]);
  return order;
}

std::vector<std::vector<std::int64_t>> epoch_batches(std::span<const std::int64_t> groups,
                                                     const OrderOptions& options,
                                                     std::int64_t epoch) {
  if (options.batch_size < 1)
    fail(ErrorKind::kUsage, "a batch of ", options.batch_size, " samples is not possible");
  const auto n = static_cast<std::int64_t>(groups.size());
  std::vector<std::int64_t> order(groups.size());
  if (options.shuffle)
    order = shuffled(n, options.seed, epoch);
  else
    std::iota(order.begin(), order.end(), 0);

  std::map<std::int64_t, std::int64_t> size_of;  // samples of each group
  for (const std::int64_t group : groups) ++size_of[group];
  std::map<std::int64_t, std::vector<std::int64_t>> open;
  std::vector<std::vector<std::int64_t>> batches;
  for (const std::int64_t sample : order) {
    std::vector<std::int64_t>& batch = open[groups[static_cast<std::size_t>(sample)]];
    batch.push_back(sample);
    if (static_cast<std::int64_t>(batch.size()) == options.batch_size)
      batches.push_back(std::exchange(batch, {}));
  }
  for (auto& [group, batch] : open)
    if (!batch.empty() && (options.last == LastBatch::kKeep || size_of[group] < options.batch_size))
      batches.push_back(std::move(batch));
  return batches;
}

}  // namespace lvggt
