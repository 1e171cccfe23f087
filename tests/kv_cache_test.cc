// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/kv_cache.h"

#include <doctest/doctest.h>

#include "lvggt/core/error.h"

using namespace lvggt;

namespace {

// Appends a frame whose keys are all `value`, in every layer, and returns what its last layer
// attends to.
std::span<const PackedKeysValues> append(KvCache& cache, float value, Context& ctx) {
  Tensor<float, 3> k(Shape<3>{5, 2, 4}), v(Shape<3>{5, 2, 4});
  std::fill_n(k.data(), k.size(), value);
  std::fill_n(v.data(), v.size(), -value);
  for (std::int64_t layer = 0; layer < 2; ++layer) cache.append(layer, k, v, ctx);
  return cache.attended(1);
}

float key_of(const PackedKeysValues& group) { return *reinterpret_cast<const float*>(group.data); }

}  // namespace

TEST_CASE("KvCache: a frame sees the cached ones, oldest first, and itself last") {
  Context ctx(1);
  KvCache cache(2, 2, 4, 5, 3);
  const std::vector<std::vector<float>> seen = {
      {0}, {0, 1}, {0, 1, 2}, {0, 1, 2, 3}, {1, 2, 3, 4}, {2, 3, 4, 5}, {3, 4, 5, 6}};
  for (std::size_t f = 0; f < seen.size(); ++f) {
    const auto groups = append(cache, static_cast<float>(f), ctx);
    REQUIRE(groups.size() == seen[f].size());
    for (std::size_t i = 0; i < groups.size(); ++i) CHECK(key_of(groups[i]) == seen[f][i]);
    cache.end_frame();
  }
  CHECK(cache.num_frames() == 3);
}

TEST_CASE("KvCache: a frame that is not ended is overwritten by the next") {
  Context ctx(1);
  KvCache cache(2, 2, 4, 5, 3);
  append(cache, 1, ctx);
  cache.end_frame();
  append(cache, 2, ctx);
  const auto groups = append(cache, 3, ctx);
  REQUIRE(groups.size() == 2);
  CHECK(key_of(groups[0]) == 1);
  CHECK(key_of(groups[1]) == 3);
}

TEST_CASE("KvCache: windows that no address space holds and empty ones are refused") {
  CHECK_THROWS_AS(KvCache(24, 16, 64, 782, kMaxPastFrames), Error);
  CHECK_THROWS_AS(KvCache(2, 2, 4, 5, 0), Error);
  CHECK_THROWS_AS(KvCache(2, 2, 4, 5, -1), Error);
}

TEST_CASE("KvCache: more tokens than a frame has are refused") {
  Context ctx(1);
  KvCache cache(1, 2, 4, 5, 3);
  const Tensor<float, 3> k(Shape<3>{6, 2, 4});
  CHECK_THROWS_AS(cache.append(0, k, k, ctx), Error);
}
