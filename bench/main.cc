// SPDX-License-Identifier: Apache-2.0
// The main function of the benchmarks: Google Benchmark's, and --simd=NAME.
#include <benchmark/benchmark.h>
#include <hwy/highway.h>

#include <cstdio>
#include <string>
#include <string_view>

#include "lvggt/core/simd.h"

namespace {

// Takes every instruction set better than `name` away, as on a machine that lacks them. False if
// there is none of that name. Not DisableTargets: with Highway 1.0.3 the next question for the
// supported targets brings the disabled ones back.
bool limit_simd(std::string_view name) {
  std::int64_t kept = 0;
  for (const std::int64_t target : hwy::SupportedAndGeneratedTargets()) {
    if (kept != 0 || name == hwy::TargetName(target)) kept |= target;
  }
  if (kept != 0) hwy::SetSupportedTargetsForTest(kept);
  return kept != 0;
}

}  // namespace

int main(int argc, char** argv) {
  constexpr std::string_view kSimd = "--simd=";
  int kept = 1;
  for (int i = 1; i < argc; ++i) {
    const std::string_view argument = argv[i];
    if (!argument.starts_with(kSimd)) {
      argv[kept++] = argv[i];
    } else if (!limit_simd(argument.substr(kSimd.size()))) {
      std::fprintf(stderr, "--simd: this machine has no '%s'; it has:",
                   std::string(argument.substr(kSimd.size())).c_str());
      for (const std::int64_t target : hwy::SupportedAndGeneratedTargets())
        std::fprintf(stderr, " %s", hwy::TargetName(target));
      std::fprintf(stderr, "\n");
      return 2;
    }
  }
  benchmark::Initialize(&kept, argv);
  if (benchmark::ReportUnrecognizedArguments(kept, argv)) return 2;
  benchmark::AddCustomContext("simd", lvggt::simd_target());
  benchmark::RunSpecifiedBenchmarks();
  benchmark::Shutdown();
}
