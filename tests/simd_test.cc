// SPDX-License-Identifier: Apache-2.0
#include "lvggt/core/simd.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <set>

#include "tests/support/targets.h"

using namespace lvggt;

TEST_CASE(
    "simd_target: the best of the supported instruction sets, and it can be narrowed for a test") {
  const std::vector<std::string> all = simd_targets();
  REQUIRE_FALSE(all.empty());
  CHECK(simd_target() == all.front());
  std::set<std::string> seen;
  test::for_each_target([&] {
    CHECK(simd_targets().size() == 1);
    seen.insert(simd_target());
  });
  CHECK(seen == std::set<std::string>(all.begin(), all.end()));
  CHECK(simd_targets() == all);
}
