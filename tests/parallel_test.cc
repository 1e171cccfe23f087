// SPDX-License-Identifier: Apache-2.0
#include "lvggt/core/parallel.h"

#include <doctest/doctest.h>

#include <atomic>
#include <vector>

#include "lvggt/core/error.h"

using namespace lvggt;

TEST_CASE("parallel_chunks: every chunk runs exactly once, on a valid worker") {
  for (const int threads : {1, 2, 7}) {
    Context ctx(threads);
    std::vector<std::atomic<int>> seen(1000);
    std::atomic<bool> valid = true;
    parallel_chunks(
        1000,
        [&](std::int64_t chunk, int worker) {
          ++seen[static_cast<std::size_t>(chunk)];
          if (worker < 0 || worker >= threads) valid = false;
        },
        ctx);
    CHECK(valid);
    for (const auto& count : seen) CHECK(count == 1);
  }
}

TEST_CASE("parallel_chunks: an exception in a worker reaches the caller") {
  Context ctx(4);
  CHECK_THROWS_AS(parallel_chunks(
                      64,
                      [](std::int64_t chunk, int) {
                        if (chunk == 63) fail(ErrorKind::kNumeric, "chunk 63");
                      },
                      ctx),
                  Error);
}

TEST_CASE("Context: a thread count below zero or above the limit is refused by name") {
  CHECK_THROWS_WITH_AS(Context(-1), doctest::Contains("threads: -1"), Error);
  CHECK_THROWS_WITH_AS(Context(1000000), doctest::Contains("threads: 1000000"), Error);
  CHECK(Context(0).num_threads() == available_threads());
}
