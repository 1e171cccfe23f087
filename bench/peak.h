// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <benchmark/benchmark.h>

#include <algorithm>
#include <chrono>

#include "lvggt/core/context.h"

namespace lvggt::bench {

// What all threads of ctx reach together in a loop of multiply-adds that touches registers only, in
// FLOP/s (2 a multiply-add): the best of several short runs.
double peak_flops(Context& ctx);

// Calls work() once an iteration and reports
//   FLOP/s   flops per second over all iterations
//   %peak    the same in percent of the machine's peak, measured right before and after the loop
template <class Work>
void run_against_peak(benchmark::State& state, Context& ctx, double flops, const Work& work) {
  const double before = peak_flops(ctx);
  double seconds = 0;
  for (auto _ : state) {
    const auto start = std::chrono::steady_clock::now();
    work();
    const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
    state.SetIterationTime(elapsed.count());
    seconds += elapsed.count();
  }
  const double peak = std::max(before, peak_flops(ctx));
  const double reached = flops * static_cast<double>(state.iterations()) / seconds;
  state.counters["FLOP/s"] =
      benchmark::Counter(reached, benchmark::Counter::kDefaults, benchmark::Counter::OneK::kIs1000);
  state.counters["%peak"] = 100 * reached / peak;
}

}  // namespace lvggt::bench
