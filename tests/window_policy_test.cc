// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/window_policy.h"

#include <doctest/doctest.h>

#include <cmath>
#include <vector>

#include "lvggt/model/kv_cache.h"
#include "tests/reference/attention.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

constexpr std::int64_t kFrames = 12, kTokens = 5, kHeads = 2, kHeadDim = 8;

// The frames cached after each of kFrames frames.
std::vector<std::vector<std::int64_t>> cached(const WindowPolicy& policy, std::int64_t window) {
  Context ctx(1);
  KvCache cache(1, kHeads, kHeadDim, kTokens, window, Storage::kF32, policy);
  const auto k = random_tensor(Shape{kTokens, kHeads, kHeadDim}, 1);
  std::vector<std::vector<std::int64_t>> result;
  for (std::int64_t frame = 0; frame < kFrames; ++frame) {
    cache.append(0, k, k, ctx);
    cache.end_frame();
    result.emplace_back(cache.cached_frames().begin(), cache.cached_frames().end());
  }
  return result;
}

}  // namespace

TEST_CASE("WindowPolicy: as published the oldest frame makes room") {
  const auto frames = cached({}, 3);
  CHECK(frames[1] == std::vector<std::int64_t>{0, 1});
  CHECK(frames[3] == std::vector<std::int64_t>{1, 2, 3});
  CHECK(frames[11] == std::vector<std::int64_t>{9, 10, 11});
}

TEST_CASE("WindowPolicy: keep_first keeps frame 0 and the newest others") {
  const auto frames = cached({.keep_first = true}, 3);
  CHECK(frames[3] == std::vector<std::int64_t>{0, 2, 3});
  CHECK(frames[11] == std::vector<std::int64_t>{0, 10, 11});
  CHECK(cached({.keep_first = true}, 1)[11] == std::vector<std::int64_t>{11});
}

TEST_CASE("WindowPolicy: keep_every keeps every k-th frame as long as there is room") {
  const auto frames = cached({.keep_every = 4}, 4);
  CHECK(frames[7] == std::vector<std::int64_t>{0, 4, 6, 7});
  CHECK(frames[9] == std::vector<std::int64_t>{0, 4, 8, 9});
  // 0, 4 and 8 are kept, and 11 is the newest: no room for 10.
  CHECK(frames[11] == std::vector<std::int64_t>{0, 4, 8, 11});
  // Only multiples of 2 and the newest are left: the oldest multiple goes, but not the first frame.
  CHECK(cached({.keep_first = true, .keep_every = 2}, 3)[11] ==
        std::vector<std::int64_t>{0, 10, 11});
  CHECK(cached({.keep_every = 2}, 3)[11] == std::vector<std::int64_t>{8, 10, 11});
}

TEST_CASE("WindowPolicy: streamed attention equals batch attention with the matching mask") {
  Context ctx(2);
  const auto k = random_tensor(Shape{kFrames * kTokens, kHeads, kHeadDim}, 1);
  const auto v = random_tensor(Shape{kFrames * kTokens, kHeads, kHeadDim}, 2);
  const auto q = random_tensor(Shape{kFrames * kTokens, kHeads, kHeadDim}, 3);
  const float scale = 1 / std::sqrt(static_cast<float>(kHeadDim));
  for (const WindowPolicy& policy :
       {WindowPolicy{}, WindowPolicy{.keep_first = true}, WindowPolicy{.keep_every = 3},
        WindowPolicy{.keep_first = true, .keep_every = 5}}) {
    for (const std::int64_t window : {1, 2, 4, 20}) {
      CAPTURE(window);
      const auto kept = cached(policy, window);
      KvCache cache(1, kHeads, kHeadDim, kTokens, window, Storage::kF32, policy);
      for (std::int64_t frame = 0; frame < kFrames; ++frame) {
        const auto tokens = [&](const Tensor<float, 3>& x, std::int64_t f) {
          return x.view().narrow(0, f * kTokens, (f + 1) * kTokens);
        };
        cache.append(0, tokens(k, frame), tokens(v, frame), ctx);
        Tensor<float, 3> y(Shape{kTokens, kHeads, kHeadDim});
        scaled_dot_product_attention(y, tokens(q, frame), cache.attended(0), scale, ctx);
        cache.end_frame();
        // The mask: the frames cached before this one, and itself.
        std::vector<std::int64_t> visible;
        if (frame > 0) visible = kept[static_cast<std::size_t>(frame - 1)];
        visible.push_back(frame);
        const auto count = static_cast<std::int64_t>(visible.size());
        Tensor<double, 3> seen_k(Shape{count * kTokens, kHeads, kHeadDim}), seen_v(seen_k.shape());
        for (std::int64_t i = 0; i < count * kTokens * kHeads * kHeadDim; ++i) {
          const std::int64_t per_frame = kTokens * kHeads * kHeadDim;
          const std::int64_t from =
              visible[static_cast<std::size_t>(i / per_frame)] * per_frame + i % per_frame;
          seen_k.data()[i] = k.data()[from];
          seen_v.data()[i] = v.data()[from];
        }
        const auto expected = reference::attention(converted<double>(tokens(q, frame)), seen_k,
                                                   seen_v, static_cast<double>(scale));
        CHECK_CLOSE(y, expected, 1e-5);
      }
    }
  }
}

TEST_CASE("WindowPolicy: a negative step is refused by name") {
  CHECK_THROWS_WITH_AS(KvCache(1, 1, 8, 1, 4, Storage::kF32, {.keep_every = -2}),
                       doctest::Contains("every -2-th"), Error);
}
