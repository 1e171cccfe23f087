// SPDX-License-Identifier: Apache-2.0
#include "lvggt/core/parallel.h"

#include <doctest/doctest.h>
#include <sched.h>

#include <atomic>
#include <filesystem>
#include <thread>
#include <vector>

#include "kernels/core/thread_limits.h"
#include "lvggt/core/error.h"
#include "tests/support/files.h"
#include "tests/support/temp_dir.h"

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

TEST_CASE("D43: CPU quotas of 0.5, 1, 1.5 and 4 on a bigger host give 1, 1, 1 and 4 threads") {
  const test::TempDir root;
  std::filesystem::create_directories(root / "a/b");
  const auto threads = [&](int affinity) {
    return threads_within(affinity, cgroup_quota(root.path(), "/a/b"));
  };
  CHECK(threads(8) == 8);
  for (const auto& [limit, expected] : {std::pair{"50000 100000", 1},
                                        {"100000 100000", 1},
                                        {"150000 100000", 1},
                                        {"400000 100000", 4},
                                        {"max 100000", 8},
                                        {"1600000 100000", 8},
                                        {"", 8},
                                        {"100000 0", 8},
                                        {"-1 100000", 8},
                                        {"many 100000", 8}}) {
    CAPTURE(limit);
    test::write_bytes(root / "a/b/cpu.max", limit);
    CHECK(threads(8) == expected);
  }
}

TEST_CASE(
    "D43: the tightest quota of a control group and those above it counts, in both versions") {
  const test::TempDir root;
  std::filesystem::create_directories(root / "a/b");
  test::write_bytes(root / "a/cpu.max", "200000 100000");
  test::write_bytes(root / "a/b/cpu.max", "600000 100000");
  CHECK(cgroup_quota(root.path(), "/a/b") == 2);
  test::write_bytes(root / "cpu.max", "150000 100000");
  CHECK(cgroup_quota(root.path(), "/a/b") == 1.5);
  const test::TempDir old;
  std::filesystem::create_directories(old / "a");
  test::write_bytes(old / "a/cpu.cfs_quota_us", "-1");
  test::write_bytes(old / "a/cpu.cfs_period_us", "100000");
  CHECK(cgroup_quota(old.path(), "/a") == 0);
  test::write_bytes(old / "a/cpu.cfs_quota_us", "350000");
  CHECK(cgroup_quota(old.path(), "/a") == 3.5);
  CHECK(threads_within(2, 3.5) == 2);
}

TEST_CASE("D43: an affinity mask of one CPU gives one thread") {
  int threads = 0;
  std::string reason;
  std::thread([&] {
    cpu_set_t mask, one;
    CPU_ZERO(&mask);
    CPU_ZERO(&one);
    REQUIRE(sched_getaffinity(0, sizeof mask, &mask) == 0);
    for (int cpu = 0; cpu < CPU_SETSIZE && CPU_COUNT(&one) == 0; ++cpu)
      if (CPU_ISSET(cpu, &mask)) CPU_SET(cpu, &one);
    REQUIRE(sched_setaffinity(0, sizeof one, &one) == 0);
    threads = available_threads(&reason);
  }).join();
  CHECK(threads == 1);
  CHECK(reason == "the CPUs this process may run on");
}
