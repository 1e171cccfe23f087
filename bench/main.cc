// SPDX-License-Identifier: Apache-2.0
// The main function of the benchmarks: Google Benchmark's, and --simd=NAME.
#include <benchmark/benchmark.h>

#include <iostream>

#include "bench/simd_option.h"
#include "lvggt/core/error.h"
#include "lvggt/core/simd.h"

int main(int argc, char** argv) {
  try {
    lvggt::bench::apply_simd_option(&argc, argv);
  } catch (const lvggt::Error& e) {
    std::cerr << e.what() << '\n';
    return lvggt::exit_code(e.kind());
  }
  benchmark::Initialize(&argc, argv);
  if (benchmark::ReportUnrecognizedArguments(argc, argv)) return 2;
  benchmark::AddCustomContext("simd", lvggt::simd_target());
  benchmark::RunSpecifiedBenchmarks();
  benchmark::Shutdown();
}
