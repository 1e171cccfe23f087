// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/linear.h"

#include "kernels/pack.h"
#include "kernels/product.h"

namespace lvggt {

namespace {

void run_linear(View<float, 2> y, View<const float, 2> x, const kernels::PackedPanels& w,
                std::int64_t weight_K, const Epilogue<2>& epilogue, Context& ctx) {
  const auto [M, K] = x.shape();
  LVGGT_CHECK(K == weight_K, "linear: x is ", x.shape(), " but the weight is ",
              Shape{w.N, weight_K});
  LVGGT_CHECK(y.shape() == (Shape{M, w.N}), "linear: y is ", y.shape(), " but x ", x.shape(),
              " and the weight ", Shape{w.N, weight_K}, " give ", Shape{M, w.N});
  LVGGT_CHECK(epilogue.bias.empty() || epilogue.bias.extent(0) == w.N, "linear: bias is ",
              epilogue.bias.shape(), " but the weight is ", Shape{w.N, weight_K});
  LVGGT_CHECK(epilogue.gamma.empty() || epilogue.gamma.extent(0) == w.N, "linear: gamma is ",
              epilogue.gamma.shape(), " but the weight is ", Shape{w.N, weight_K});
  LVGGT_CHECK(epilogue.residual.empty() || epilogue.residual.shape() == y.shape(),
              "linear: residual is ", epilogue.residual.shape(), " but y is ", y.shape());

  const View<const float, 2> residual = epilogue.residual;
  const kernels::Product product{M,
                                 w,
                                 1,
                                 K,
                                 epilogue.bias.data(),
                                 epilogue.activation,
                                 epilogue.gamma.data(),
                                 !residual.empty()};
  const auto gather = [&](const kernels::RowTable& table) {
    for (std::int64_t r = 0; r < table.count; ++r) {
      const std::int64_t m = table.begin + r;
      table.x[r] = x.data() + m * x.stride(0);
      table.y[r] = y.data() + m * y.stride(0);
      if (residual) table.residual[r] = residual.data() + m * residual.stride(0);
    }
  };
  if (w.storage == Storage::kI8) {
    kernels::run_product_int8(product, x, gather, ctx);
  } else {
    kernels::run_product(product, gather, ctx);
  }
}

}  // namespace

void linear_forward(View<float, 2> y, View<const float, 2> x, const PackedMatrix& w,
                    const Epilogue<2>& epilogue, Context& ctx) {
  LVGGT_CHECK(w.taps == 1, "linear: the weight is a convolution's, with ", w.taps, " taps");
  run_linear(y, x, w, w.K, epilogue, ctx);
}

void linear_forward(View<float, 2> y, View<const float, 2> x, View<const float, 2> weight,
                    const Epilogue<2>& epilogue, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const std::int64_t tap = 0;
  const kernels::PackedPanels w = kernels::pack_in_arena(
      {weight.data(), weight.extent(0), weight.stride(0), weight.extent(1), 1, {&tap, Shape{1}}},
      ctx);
  run_linear(y, x, w, weight.extent(1), epilogue, ctx);
}

}  // namespace lvggt
