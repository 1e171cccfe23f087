// SPDX-License-Identifier: Apache-2.0
#include "bench/simd_option.h"

#include <hwy/highway.h>

#include <string>
#include <string_view>

#include "lvggt/core/error.h"

namespace lvggt::bench {
namespace {

// Not DisableTargets: with Highway 1.0.3 the next question for the supported targets brings the
// disabled ones back.
void limit_simd(std::string_view name) {
  std::int64_t kept = 0;
  std::string known;
  for (const std::int64_t target : hwy::SupportedAndGeneratedTargets()) {
    known += std::string(" ") + hwy::TargetName(target);
    if (kept != 0 || name == hwy::TargetName(target)) kept |= target;
  }
  if (kept == 0)
    fail(ErrorKind::kUsage, "--simd: this machine has no '", name, "'; it has:", known);
  hwy::SetSupportedTargetsForTest(kept);
}

}  // namespace

void apply_simd_option(int* argc, char** argv) {
  constexpr std::string_view kOption = "--simd=";
  int kept = 1;
  for (int i = 1; i < *argc; ++i) {
    const std::string_view argument = argv[i];
    if (argument.starts_with(kOption)) {
      limit_simd(argument.substr(kOption.size()));
    } else {
      argv[kept++] = argv[i];
    }
  }
  *argc = kept;
}

}  // namespace lvggt::bench
