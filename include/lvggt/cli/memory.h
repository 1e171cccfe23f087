// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <fstream>
#include <limits>
#include <sstream>
#include <string>

#include "lvggt/cli/program.h"

namespace lvggt::cli {

// A field of /proc/self/status or /proc/meminfo in bytes, 0 if it is not there.
inline std::size_t proc_bytes(const std::string& path, const std::string& field) {
  std::ifstream file(path);
  for (std::string line; std::getline(file, line);) {
    if (!line.starts_with(field + ":")) continue;
    std::istringstream words(line.substr(field.size() + 1));
    std::size_t kibibytes = 0;
    words >> kibibytes;
    return kibibytes * 1024;
  }
  return 0;
}

// Physical memory this process uses, now and at most so far.
inline std::size_t resident_bytes() { return proc_bytes("/proc/self/status", "VmRSS"); }
inline std::size_t peak_resident_bytes() { return proc_bytes("/proc/self/status", "VmHWM"); }

struct MemoryLimit {
  std::size_t bytes = std::numeric_limits<std::size_t>::max();
  std::string reason = "no limit is known";
};

namespace memory_detail {

// A file that holds one number; the largest number there is for "max", or if there is no such file.
inline std::size_t number_in(const std::string& path) {
  std::ifstream file(path);
  std::string word;
  std::size_t value = 0;
  if (file >> word && parse_number(std::string_view(word), value)) return value;
  return std::numeric_limits<std::size_t>::max();
}

// The folder of this process's control group under `root`, for version 2 ("0::/path") or 1
// ("4:memory:/path").
inline std::string cgroup_path(const std::string& controller) {
  std::ifstream file("/proc/self/cgroup");
  for (std::string line; std::getline(file, line);) {
    const std::size_t first = line.find(':'), second = line.find(':', first + 1);
    if (second == std::string::npos) continue;
    if (line.substr(first + 1, second - first - 1) == controller) return line.substr(second + 1);
  }
  return "/";
}

// Memory left in a control group or any above it.
inline std::size_t cgroup_left(const std::string& root, std::string path, const char* limit_file,
                               const char* usage_file) {
  std::size_t left = std::numeric_limits<std::size_t>::max();
  for (;;) {
    const std::string folder = root + (path == "/" ? "" : path);
    const std::size_t limit = number_in(folder + "/" + limit_file);
    const std::size_t usage = number_in(folder + "/" + usage_file);
    // Version 1 says "no limit" with a number near 2^63.
    if (limit < (std::size_t{1} << 60) && usage != std::numeric_limits<std::size_t>::max())
      left = std::min(left, limit - std::min(limit, usage));
    if (path.empty() || path == "/") return left;
    path = path.substr(0, path.rfind('/'));
    if (path.empty()) path = "/";
  }
}

}  // namespace memory_detail

// Memory this process may still take: what the system has free, at most what its control groups
// leave.
inline MemoryLimit available_memory() {
  MemoryLimit available;
  if (const std::size_t free = proc_bytes("/proc/meminfo", "MemAvailable"); free > 0)
    available = {free, "free memory of this machine"};
  using namespace memory_detail;
  const std::size_t left =
      std::min(cgroup_left("/sys/fs/cgroup", cgroup_path(""), "memory.max", "memory.current"),
               cgroup_left("/sys/fs/cgroup/memory", cgroup_path("memory"), "memory.limit_in_bytes",
                           "memory.usage_in_bytes"));
  if (left < available.bytes)
    available = {left, "what the memory limit of this control group leaves"};
  return available;
}

// What a run may take: what is available, `held` bytes of which this process has already, but at
// most the user's limit; 0: none.
inline MemoryLimit memory_limit(std::size_t users_limit, std::size_t held = 0) {
  MemoryLimit limit = available_memory();
  limit.bytes += std::min(held, ~limit.bytes);
  if (users_limit > 0 && users_limit < limit.bytes) limit = {users_limit, "--memory-limit"};
  return limit;
}

}  // namespace lvggt::cli
