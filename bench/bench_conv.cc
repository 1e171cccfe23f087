// SPDX-License-Identifier: Apache-2.0
// The convolutions of the DPT heads and the UNets, and the resize between them, at 294 x 518
// pixels.
#include <cmath>

#include "bench/peak.h"
#include "bench/shapes.h"
#include "lvggt/kernels/conv2d.h"
#include "lvggt/kernels/conv_transpose2d.h"
#include "lvggt/kernels/interpolate.h"

namespace {

using namespace lvggt;
using namespace lvggt::bench;

// The last output of row 0 by its definition, so that a broken kernel is not timed.
void verify(View<const float, 4> y, View<const float, 4> x, View<const float, 4> w,
            std::int64_t stride, std::int64_t padding) {
  const std::int64_t ox = y.extent(2) - 1, n = y.extent(3) - 1, k = w.extent(2);
  double sum = 0;
  for (std::int64_t ky = 0; ky < k; ++ky) {
    for (std::int64_t kx = 0; kx < k; ++kx) {
      const std::int64_t iy = ky - padding, ix = ox * stride + kx - padding;
      if (iy < 0 || ix < 0 || ix >= x.extent(2)) continue;
      for (std::int64_t c = 0; c < x.extent(3); ++c) {
        sum += static_cast<double>(x(0, iy, ix, c)) * w(n, c, ky, kx);
      }
    }
  }
  LVGGT_CHECK(std::abs(y(0, 0, ox, n) - sum) < 1e-3, "bench_conv: y is ", y(0, 0, ox, n),
              " but should be ", sum);
}

void conv2d_forward(benchmark::State& state) {
  const std::int64_t kernel = state.range(0), Cin = state.range(1), Cout = state.range(2);
  const std::int64_t H = state.range(3), W = state.range(4);
  const std::int64_t stride = kernel == 2 ? 2 : 1, padding = kernel == 3 ? 1 : 0;
  Context ctx;
  const auto x = random_tensor(Shape{std::int64_t{1}, H, W, Cin}, 1);
  const auto weight = random_tensor(Shape{Cout, Cin, kernel, kernel}, 2);
  const PackedConv2d w = pack_conv2d(weight, stride, padding);
  Tensor<float, 4> y(Shape{std::int64_t{1}, conv2d_extent(H, kernel, stride, padding),
                           conv2d_extent(W, kernel, stride, padding), Cout});
  lvggt::conv2d_forward(y, x, w, {}, ctx);
  verify(y, x, weight, stride, padding);
  const double flops = 2.0 * static_cast<double>(y.size() * Cin * kernel * kernel);
  run_against_peak(state, ctx, flops,
                   [&] { lvggt::conv2d_forward(y, x, w, {.activation = Activation::kRelu}, ctx); });
}

BENCHMARK(conv2d_forward)
    ->ArgNames({"kernel", "Cin", "Cout", "H", "W"})
    ->Args({3, 256, 256, 168, 296})
    ->Args({3, 256, 128, 168, 296})
    ->Args({3, 128, 128, 168, 296})
    ->Args({3, 128, 32, 294, 518})
    ->Args({3, 32, 32, 294, 518})
    ->Args({2, 64, 64, 147, 259})
    ->Args({1, 2048, 256, 21, 37})
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);

// Input and parameter gradients apart: each does as many multiply-adds as the forward pass.
void conv2d_backward(benchmark::State& state, bool parameters) {
  const std::int64_t kernel = state.range(0), Cin = state.range(1), Cout = state.range(2);
  const std::int64_t H = state.range(3), W = state.range(4);
  const std::int64_t stride = kernel == 2 ? 2 : 1, padding = kernel == 3 ? 1 : 0;
  Context ctx;
  const auto x = random_tensor(Shape{std::int64_t{1}, H, W, Cin}, 1);
  const auto weight = random_tensor(Shape{Cout, Cin, kernel, kernel}, 2);
  const auto dy = random_tensor(Shape{std::int64_t{1}, conv2d_extent(H, kernel, stride, padding),
                                      conv2d_extent(W, kernel, stride, padding), Cout},
                                3);
  Tensor<float, 4> dx(x.shape()), dweight(weight.shape());
  Tensor<float, 1> dbias(Shape{Cout});
  const double flops = 2.0 * static_cast<double>(dy.size() * Cin * kernel * kernel);
  run_against_peak(state, ctx, flops, [&] {
    if (parameters) {
      lvggt::conv2d_backward({}, dweight, dbias, dy, x, weight, stride, padding, ctx);
    } else {
      lvggt::conv2d_backward(dx, {}, {}, dy, {}, weight, stride, padding, ctx);
    }
  });
}

void backward_sizes(benchmark::internal::Benchmark* bench) {
  bench->ArgNames({"kernel", "Cin", "Cout", "H", "W"})
      ->Args({3, 256, 256, 168, 296})
      ->Args({3, 128, 128, 168, 296})
      ->Args({3, 128, 32, 294, 518})
      ->Args({3, 64, 32, 294, 518})
      ->Args({3, 32, 32, 294, 518})
      ->Args({3, 256, 256, 36, 64})
      ->Args({3, 32, 3, 294, 518})
      ->Args({2, 64, 64, 147, 259})
      ->Args({1, 2048, 256, 21, 37})
      ->Args({1, 128, 128, 168, 296})
      ->UseManualTime()
      ->Unit(benchmark::kMillisecond);
}
BENCHMARK_CAPTURE(conv2d_backward, input, false)->Apply(backward_sizes);
BENCHMARK_CAPTURE(conv2d_backward, parameters, true)->Apply(backward_sizes);

void conv_transpose2d_forward(benchmark::State& state) {
  const std::int64_t kernel = state.range(0), C = state.range(1), H = state.range(2),
                     W = state.range(3);
  Context ctx;
  const auto x = random_tensor(Shape{std::int64_t{1}, H, W, C}, 1);
  const PackedConvTranspose2d w =
      pack_conv_transpose2d(random_tensor(Shape{C, C, kernel, kernel}, 2));
  Tensor<float, 4> y(Shape{std::int64_t{1}, kernel * H, kernel * W, C});
  const double flops = 2.0 * static_cast<double>(y.size() * C);
  run_against_peak(state, ctx, flops, [&] { lvggt::conv_transpose2d_forward(y, x, w, {}, ctx); });
}

BENCHMARK(conv_transpose2d_forward)
    ->ArgNames({"kernel", "C", "H", "W"})
    ->Args({4, 256, 21, 37})
    ->Args({2, 512, 21, 37})
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);

void bilinear_forward(benchmark::State& state) {
  const std::int64_t C = state.range(0), H = 168, W = 296, Ho = 294, Wo = 518;
  Context ctx;
  const auto x = random_tensor(Shape{std::int64_t{1}, H, W, C}, 1);
  Tensor<float, 4> y(Shape{std::int64_t{1}, Ho, Wo, C});
  for (auto _ : state) lvggt::bilinear_forward(y, x, true, ctx);
  LVGGT_CHECK(y(0, Ho - 1, Wo - 1, 0) == x(0, H - 1, W - 1, 0),
              "bench_conv: corners are not aligned");
  state.SetBytesProcessed(state.iterations() * (x.size() + y.size()) * 4);
}

BENCHMARK(bilinear_forward)
    ->ArgName("C")
    ->Arg(256)
    ->Arg(128)
    ->UseRealTime()
    ->Unit(benchmark::kMillisecond);

}  // namespace
