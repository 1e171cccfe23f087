// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/sample_order.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <numeric>
#include <set>

#include "lvggt/core/error.h"

using namespace lvggt;

namespace {

std::vector<std::int64_t> flat(const std::vector<std::vector<std::int64_t>>& batches) {
  std::vector<std::int64_t> all;
  for (const auto& batch : batches) all.insert(all.end(), batch.begin(), batch.end());
  return all;
}

std::vector<std::int64_t> one_group(std::size_t n) { return std::vector<std::int64_t>(n, 0); }

}  // namespace

TEST_CASE("sample_order: an epoch is a permutation that depends on seed and epoch only") {
  const auto order = shuffled(100, 7, 3);
  auto sorted = order;
  std::sort(sorted.begin(), sorted.end());
  for (std::int64_t i = 0; i < 100; ++i) CHECK(sorted[static_cast<std::size_t>(i)] == i);
  CHECK(order == shuffled(100, 7, 3));
  CHECK(order != shuffled(100, 7, 4));
  CHECK(order != shuffled(100, 8, 3));
  CHECK(shuffled(0, 1, 0).empty());
  // Fixed forever: checkpoints store a position in it.
  CHECK(shuffled(8, 1, 0) == std::vector<std::int64_t>{7, 0, 4, 3, 5, 6, 1, 2});
}

TEST_CASE("sample_order: every place is equally likely") {
  std::vector<int> count(5 * 5);
  for (std::int64_t epoch = 0; epoch < 2000; ++epoch) {
    const auto order = shuffled(5, 11, epoch);
    for (std::size_t i = 0; i < 5; ++i) ++count[i * 5 + static_cast<std::size_t>(order[i])];
  }
  // 400 expected, standard deviation 18.
  for (const int n : count) CHECK(std::abs(n - 400) < 90);
}

TEST_CASE("D24: the last incomplete batch is dropped or kept; a small data set is one batch") {
  OrderOptions options;
  options.batch_size = 4;
  CHECK(epoch_batches(one_group(10), options, 0).size() == 2);
  options.last = LastBatch::kKeep;
  const auto kept = epoch_batches(one_group(10), options, 0);
  REQUIRE(kept.size() == 3);
  CHECK(kept[2].size() == 2);
  auto all = flat(kept);
  std::sort(all.begin(), all.end());
  for (std::int64_t i = 0; i < 10; ++i) CHECK(all[static_cast<std::size_t>(i)] == i);
  for (const LastBatch last : {LastBatch::kDrop, LastBatch::kKeep}) {
    options.last = last;
    const auto small = epoch_batches(one_group(3), options, 5);
    REQUIRE(small.size() == 1);
    CHECK(small[0].size() == 3);
  }
  CHECK(epoch_batches(one_group(0), options, 0).empty());
  options.batch_size = 0;
  CHECK_THROWS_AS(epoch_batches(one_group(3), options, 0), Error);
}

TEST_CASE("sample_order: samples of different sizes never share a batch") {
  std::vector<std::int64_t> groups;
  for (int i = 0; i < 30; ++i) groups.push_back(i % 3 == 0 ? 1 : 0);
  OrderOptions options;
  options.batch_size = 4;
  std::set<std::size_t> num_batches;
  for (std::int64_t epoch = 0; epoch < 20; ++epoch) {
    const auto batches = epoch_batches(groups, options, epoch);
    num_batches.insert(batches.size());
    for (const auto& batch : batches) {
      CHECK(batch.size() == 4);
      for (const std::int64_t sample : batch)
        CHECK(groups[static_cast<std::size_t>(sample)] ==
              groups[static_cast<std::size_t>(batch[0])]);
    }
  }
  CHECK(num_batches == std::set<std::size_t>{5 + 2});
}

TEST_CASE("sample_order: without shuffling samples come in order") {
  OrderOptions options;
  options.batch_size = 4;
  options.shuffle = false;
  options.last = LastBatch::kKeep;
  const auto all = flat(epoch_batches(one_group(10), options, 3));
  for (std::int64_t i = 0; i < 10; ++i) CHECK(all[static_cast<std::size_t>(i)] == i);
}
