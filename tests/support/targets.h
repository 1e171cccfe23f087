// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>
#include <hwy/targets.h>

#include <cstdint>
#include <string>

namespace lvggt::test {

// Runs body once on every instruction set that was compiled and that this CPU has.
template <class Body>
void for_each_target(const Body& body) {
  struct Restore {
    ~Restore() { hwy::SetSupportedTargetsForTest(0); }
  };
  for (const std::int64_t target : hwy::SupportedAndGeneratedTargets()) {
    const Restore restore;
    hwy::SetSupportedTargetsForTest(target);
    const std::string name = hwy::TargetName(target);
    CAPTURE(name);
    body();
  }
}

}  // namespace lvggt::test
