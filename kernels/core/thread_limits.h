// SPDX-License-Identifier: Apache-2.0
// Private: how many threads a process may use, from what the system says.
#pragma once

#include <string>

namespace lvggt {

// The tightest CPU quota between the control group `group` ("/a/b") and the root of its hierarchy,
// the folder `root`; 0 for none. Reads the files of both versions of control groups.
double cgroup_quota(const std::string& root, std::string group);

// CPUs of the affinity mask, at most the quota rounded down, at least 1. Quota 0 is none.
int threads_within(int affinity, double quota);

}  // namespace lvggt
