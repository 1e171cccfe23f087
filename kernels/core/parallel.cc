// SPDX-License-Identifier: Apache-2.0
#include "lvggt/core/parallel.h"

#include <sched.h>
#include <tbb/global_control.h>
#include <tbb/parallel_for.h>
#include <tbb/task_arena.h>
#ifdef LVGGT_TSAN_ANNOTATIONS
#include <sanitizer/tsan_interface.h>
#endif

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <fstream>
#include <optional>
#include <string>
#include <thread>

#include "kernels/core/thread_limits.h"

namespace lvggt {

namespace {

int affinity_threads() {
  cpu_set_t set;
  CPU_ZERO(&set);
  if (sched_getaffinity(0, sizeof(set), &set) != 0) return 1;
  return std::max(1, CPU_COUNT(&set));
}

// The path of this process's group in the hierarchy that /proc/self/cgroup lists under `controller`
// ("" is the unified hierarchy).
std::string cgroup_path(const std::string& controller) {
  std::ifstream file("/proc/self/cgroup");
  for (std::string line; std::getline(file, line);) {
    const auto first = line.find(':');
    const auto second = line.find(':', first + 1);
    if (first == std::string::npos || second == std::string::npos) continue;
    const std::string names = "," + line.substr(first + 1, second - first - 1) + ",";
    if (names == "," + controller + "," ||
        (!controller.empty() && names.find("," + controller + ",") != std::string::npos))
      return line.substr(second + 1);
  }
  return "/";
}

// CPUs that one group's files allow, 0 when they set no limit.
double quota_of(const std::string& directory) {
  double quota = 0, period = 0;
  if (std::ifstream file(directory + "/cpu.max"); file >> quota >> period && period > 0)
    return quota / period;
  std::ifstream quota_file(directory + "/cpu.cfs_quota_us"),
      period_file(directory + "/cpu.cfs_period_us");
  if (quota_file >> quota && period_file >> period && quota > 0 && period > 0)
    return quota / period;
  return 0;
}

// The tightest CPU quota of this process's group in either version of control groups, 0 for none.
double quota_of_process() {
  const double unified = cgroup_quota("/sys/fs/cgroup", cgroup_path(""));
  const double cpu = cgroup_quota("/sys/fs/cgroup/cpu", cgroup_path("cpu"));
  return unified > 0 && cpu > 0 ? std::min(unified, cpu) : std::max(unified, cpu);
}

}  // namespace

double cgroup_quota(const std::string& root, std::string group) {
  double tightest = 0;
  while (true) {
    const double quota = quota_of(root + group);
    if (quota > 0 && (tightest == 0 || quota < tightest)) tightest = quota;
    const auto slash = group.rfind('/');
    if (slash == std::string::npos || group.empty()) return tightest;
    group.resize(slash);
  }
}

int threads_within(int affinity, double quota) {
  if (!(quota > 0) || std::floor(quota) >= affinity) return std::max(1, affinity);
  return std::max(1, static_cast<int>(std::floor(quota)));
}

int available_threads(std::string* reason) {
  const int affinity = affinity_threads();
  const int threads = threads_within(affinity, quota_of_process());
  if (reason)
    *reason =
        threads < affinity ? "the control group's CPU quota" : "the CPUs this process may run on";
  return threads;
}

namespace {

// A hand-over of work from one thread to another. oneTBB orders these itself; ThreadSanitizer
// cannot see that inside a libtbb that was not built for it and is told here. Does nothing in other
// builds.
struct HandOver {
  void give() {
#ifdef LVGGT_TSAN_ANNOTATIONS
    __tsan_release(this);
#endif
  }
  void take() {
#ifdef LVGGT_TSAN_ANNOTATIONS
    __tsan_acquire(this);
#endif
  }
};

}  // namespace

struct Context::Threads {
  explicit Threads(int n) : arena(n) {
    // oneTBB starts no more workers than there are CPUs unless it is told to.
    if (n > tbb::this_task_arena::max_concurrency())
      more_than_cpus.emplace(tbb::global_control::max_allowed_parallelism,
                             static_cast<std::size_t>(n));
    start_workers(n);
  }

  // oneTBB starts a worker and allocates for it when it first finds work, which may be late on a
  // busy machine: here every place in the arena is held until all are taken. Where threads cannot
  // be had in time, the work goes on with those there are.
  void start_workers(int n) {
    if (n < 2) return;
    using Clock = std::chrono::steady_clock;
    const auto deadline = Clock::now() + std::chrono::milliseconds(200);
    std::atomic<int> arrived{0};
    arena.execute([&] {
      tbb::parallel_for(
          tbb::blocked_range<int>(0, n, 1),
          [&](const tbb::blocked_range<int>& range) {
            arrived += static_cast<int>(range.size());
            while (arrived < n && Clock::now() < deadline) std::this_thread::yield();
          },
          tbb::simple_partitioner());
    });
  }

  std::optional<tbb::global_control> more_than_cpus;
  tbb::task_arena arena;
  std::array<HandOver, kMaxThreads> workers;  // from one thread in a worker's place to the next
};

Context::Context(int num_threads) {
  if (num_threads < 0 || num_threads > kMaxThreads)
    fail(ErrorKind::kUsage, "threads: ", num_threads, " is not between 0 (all available) and ",
         kMaxThreads);
  num_threads_ = num_threads == 0 ? available_threads() : num_threads;
  threads_ = std::make_unique<Threads>(num_threads_);
}

Context::~Context() = default;

void parallel_chunks(std::int64_t num_chunks, FunctionRef<void(std::int64_t, int)> body,
                     Context& ctx) {
  if (num_chunks <= 0) return;
  if (num_chunks == 1 || ctx.num_threads() == 1) {
    for (std::int64_t chunk = 0; chunk < num_chunks; ++chunk) body(chunk, 0);
    return;
  }
  Context::Threads& threads = ctx.threads();
  HandOver start, done;
  start.give();
  threads.arena.execute([&] {
    tbb::parallel_for(
        tbb::blocked_range<std::int64_t>(0, num_chunks, 1),
        [&](const tbb::blocked_range<std::int64_t>& range) {
          const int worker = tbb::this_task_arena::current_thread_index();
          HandOver& place = threads.workers[static_cast<std::size_t>(worker)];
          start.take();
          place.take();
          for (std::int64_t chunk = range.begin(); chunk != range.end(); ++chunk)
            body(chunk, worker);
          place.give();
          done.give();
        },
        tbb::simple_partitioner());
  });
  done.take();
}

}  // namespace lvggt
