// SPDX-License-Identifier: Apache-2.0
#include "bench/peak.h"

#include "lvggt/core/parallel.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "bench/peak.cc"
#include "hwy/foreach_target.h"
//
#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::bench::HWY_NAMESPACE {
namespace {

namespace hn = hwy::HWY_NAMESPACE;

// Twelve independent sums: enough to hide a latency of 4 cycles at 2 or 3 multiply-adds a cycle,
// few enough for 16 registers. Returns the floating-point operations done.
double multiply_add_loop(long iterations, float* sink) {  // sink: [16]
  const hn::ScalableTag<float> d;
  const auto a = hn::Set(d, 0.999999f);
  const auto b = hn::Set(d, 1e-9f);
  // Different from the start, or the compiler would keep one sum for all.
  auto s0 = hn::Set(d, sink[0]), s1 = hn::Set(d, sink[1]), s2 = hn::Set(d, sink[2]);
  auto s3 = hn::Set(d, sink[3]), s4 = hn::Set(d, sink[4]), s5 = hn::Set(d, sink[5]);
  auto s6 = hn::Set(d, sink[6]), s7 = hn::Set(d, sink[7]), s8 = hn::Set(d, sink[8]);
  auto s9 = hn::Set(d, sink[9]), s10 = hn::Set(d, sink[10]), s11 = hn::Set(d, sink[11]);
  for (long i = 0; i < iterations; ++i) {
    s0 = hn::MulAdd(s0, a, b);
    s1 = hn::MulAdd(s1, a, b);
    s2 = hn::MulAdd(s2, a, b);
    s3 = hn::MulAdd(s3, a, b);
    s4 = hn::MulAdd(s4, a, b);
    s5 = hn::MulAdd(s5, a, b);
    s6 = hn::MulAdd(s6, a, b);
    s7 = hn::MulAdd(s7, a, b);
    s8 = hn::MulAdd(s8, a, b);
    s9 = hn::MulAdd(s9, a, b);
    s10 = hn::MulAdd(s10, a, b);
    s11 = hn::MulAdd(s11, a, b);
  }
  s0 =
      hn::Add(hn::Add(hn::Add(s0, s1), hn::Add(s2, s3)), hn::Add(hn::Add(s4, s5), hn::Add(s6, s7)));
  s0 = hn::Add(s0, hn::Add(hn::Add(s8, s9), hn::Add(s10, s11)));
  *sink = hn::GetLane(s0);
  return 2.0 * 12 * static_cast<double>(hn::Lanes(d)) * static_cast<double>(iterations);
}

}  // namespace
}  // namespace lvggt::bench::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt::bench {

HWY_EXPORT(multiply_add_loop);

double peak_flops(Context& ctx) {
  constexpr long kIterations = 2'000'000;  // about 4 ms
  const auto loop = HWY_DYNAMIC_DISPATCH(multiply_add_loop);
  double best = 0;
  for (int run = 0; run < 8; ++run) {
    Tensor<float, 1> sinks(Shape{std::int64_t{ctx.num_threads()} * 16});
    Tensor<double, 1> flops(Shape{std::int64_t{ctx.num_threads()}});
    const auto start = std::chrono::steady_clock::now();
    parallel_chunks(
        ctx.num_threads(),
        [&](std::int64_t chunk, int) { flops(chunk) = loop(kIterations, &sinks(chunk * 16)); },
        ctx);
    const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
    benchmark::DoNotOptimize(sinks.data());
    double total = 0;
    for (std::int64_t i = 0; i < flops.size(); ++i) total += flops(i);
    best = std::max(best, total / elapsed.count());
  }
  return best;
}

}  // namespace lvggt::bench
#endif
