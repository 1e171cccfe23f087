// SPDX-License-Identifier: Apache-2.0
#include "lvggt/core/simd.h"

#include <hwy/highway.h>
#include <hwy/targets.h>

#include "lvggt/core/error.h"

namespace lvggt {

namespace {

// Highway calls AVX-512 AVX3.
std::string name_of(std::int64_t target) {
  std::string name = hwy::TargetName(target);
  if (name == "AVX3") return "AVX-512";
  if (name == "AVX3_DL") return "AVX-512 Ice Lake";
  return name;
}

}  // namespace

std::vector<std::string> simd_targets() {
  std::vector<std::string> names;
  for (const std::int64_t target : hwy::SupportedAndGeneratedTargets())
    names.push_back(name_of(target));
  return names;
}

void use_simd_target(std::string_view name) {
  std::string all;
  std::int64_t better = 0;  // targets before it in the list
  for (const std::int64_t target : hwy::SupportedAndGeneratedTargets()) {
    if (name_of(target) == name) {
      hwy::DisableTargets(better);
      return;
    }
    better |= target;
    all += (all.empty() ? "" : ", ") + name_of(target);
  }
  fail(ErrorKind::kUsage, "instruction set '", name, "' is none of those of this CPU: ", all);
}

std::string simd_target() { return simd_targets().front(); }

}  // namespace lvggt
