// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/conv2d.h"

#include <algorithm>

#include "kernels/conv2d_product.h"
#include "kernels/pack.h"
#include "kernels/product.h"
#include "kernels/tap_gather.h"
#include "kernels/winograd.h"

namespace lvggt {

PackedConv2d pack_conv2d(View<const float, 4> weight, std::int64_t stride, std::int64_t padding,
                         Storage storage) {
  const auto [Cout, Cin, kernel, kernel_x] = weight.shape();
  LVGGT_CHECK(kernel == kernel_x, "conv2d: weight ", weight.shape(),
              " does not have a square kernel");
  const std::int64_t taps = kernel * kernel;
  PackedConv2d packed{Cin, kernel, stride, padding,
                      kernels::empty_matrix(Cout, taps, Cin, storage)};
  for (std::int64_t n = 0; n < Cout; ++n) {
    const View<const float, 3> filter = weight[n];
    for (std::int64_t t = 0; t < taps; ++t) {
      for (std::int64_t c = 0; c < Cin; ++c) {
        kernels::set_weight(packed.matrix, n, t * Cin + c, filter(c, t / kernel, t % kernel));
      }
    }
  }
  return packed;
}

namespace kernels {

void run_conv2d(View<float, 4> y, View<const float, 4> x, const ConvGeometry& geometry,
                const PackedPanels& w, const Epilogue<4>& epilogue, Context& ctx) {
  const auto [B, H, W, Cin] = x.shape();
  const std::int64_t Cout = w.N;
  LVGGT_CHECK(Cin == geometry.in_channels, "conv2d: x is ", x.shape(), " but the weight reads ",
              geometry.in_channels, " channels");
  const Shape expected{B, conv2d_extent(H, geometry.kernel, geometry.stride, geometry.padding),
                       conv2d_extent(W, geometry.kernel, geometry.stride, geometry.padding), Cout};
  LVGGT_CHECK(y.shape() == expected, "conv2d: y is ", y.shape(), " but x ", x.shape(), " gives ",
              expected);
  LVGGT_CHECK(epilogue.bias.empty() || epilogue.bias.extent(0) == Cout, "conv2d: bias is ",
              epilogue.bias.shape(), " but y is ", y.shape());
  LVGGT_CHECK(epilogue.gamma.empty() || epilogue.gamma.extent(0) == Cout, "conv2d: gamma is ",
              epilogue.gamma.shape(), " but y is ", y.shape());
  LVGGT_CHECK(epilogue.residual.empty() || epilogue.residual.shape() == y.shape(),
              "conv2d: residual is ", epilogue.residual.shape(), " but y is ", y.shape());

  if (winograd_pays(x.shape(), geometry, Cout)) return run_winograd(y, x, w, epilogue, ctx);
  Arena::Scope scope(ctx.arena());
  // Longer windows than a block of the product would have to be copied.
  const std::int64_t kernel = geometry.kernel, window = kernel * Cin;
  const bool windows =
      kernel > 1 && x.stride(2) == Cin && (geometry.padding == 0 || window <= kMostLines);
  const View<float, 1> zeros = ctx.arena().alloc(Shape{window});
  std::fill_n(zeros.data(), window, 0.0f);
  const TapAxis axis{kernel, geometry.stride, -geometry.padding, 1};
  TapGather gather(y, x, epilogue.residual, axis, axis, zeros.data());
  if (windows) {
    gather.use_windows(
        ctx.arena().alloc(Shape{std::int64_t{ctx.num_threads()}, kernel, kChunkRows, window}));
  }
  const Product product{B * expected[1] * expected[2],
                        w,
                        windows ? kernel : kernel * kernel,
                        windows ? window : Cin,
                        epilogue.bias.data(),
                        epilogue.activation,
                        epilogue.gamma.data(),
                        !epilogue.residual.empty()};
  run_product(product, gather, ctx);
}

}  // namespace kernels

void conv2d_forward(View<float, 4> y, View<const float, 4> x, const PackedConv2d& w,
                    const Epilogue<4>& epilogue, Context& ctx) {
  kernels::run_conv2d(y, x, {w.in_channels, w.kernel, w.stride, w.padding}, w.matrix, epilogue,
                      ctx);
}

void conv2d_forward(View<float, 4> y, View<const float, 4> x, View<const float, 4> weight,
                    std::int64_t stride, std::int64_t padding, const Epilogue<4>& epilogue,
                    Context& ctx) {
  const auto [Cout, Cin, kernel, kernel_x] = weight.shape();
  LVGGT_CHECK(kernel == kernel_x, "conv2d: weight ", weight.shape(),
              " does not have a square kernel");
  Arena::Scope scope(ctx.arena());
  const View<std::int64_t, 1> taps = ctx.arena().alloc<std::int64_t>(Shape{kernel * kernel});
  for (std::int64_t t = 0; t < taps.extent(0); ++t)
    taps[t] = t / kernel * weight.stride(2) + t % kernel * weight.stride(3);
  const kernels::PackedPanels w = kernels::pack_in_arena(
      {weight.data(), Cout, weight.stride(0), Cin, weight.stride(1), taps}, ctx);
  kernels::run_conv2d(y, x, {Cin, kernel, stride, padding}, w, epilogue, ctx);
}

}  // namespace lvggt
