// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/layer_scale.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/layer_scale.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

void layer_scale_row(float* y, const float* x, const float* HWY_RESTRICT gamma,
                     const float* residual, std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    hn::StoreU(hn::MulAdd(hn::LoadU(d, gamma + i), hn::LoadU(d, x + i), hn::LoadU(d, residual + i)),
               d, y + i);
  });
}

// sum += a b
void add_product_row(float* HWY_RESTRICT sum, const float* HWY_RESTRICT a,
                     const float* HWY_RESTRICT b, std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    hn::StoreU(hn::MulAdd(hn::LoadU(d, a + i), hn::LoadU(d, b + i), hn::LoadU(d, sum + i)), d,
               sum + i);
  });
}

void multiply_row(float* y, const float* x, const float* HWY_RESTRICT gamma, std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    hn::StoreU(hn::Mul(hn::LoadU(d, x + i), hn::LoadU(d, gamma + i)), d, y + i);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(layer_scale_row);
HWY_EXPORT(add_product_row);
HWY_EXPORT(multiply_row);
auto layer_scale_function() { return HWY_DYNAMIC_DISPATCH(layer_scale_row); }
auto add_product_function() { return HWY_DYNAMIC_DISPATCH(add_product_row); }
auto multiply_function() { return HWY_DYNAMIC_DISPATCH(multiply_row); }

// dgamma += sum(dy x): rows are summed 64 at a time, more when there are so many that the sums
// would outgrow them, and the sums are added in order.
void factor_gradient(View<float, 1> dgamma, View<const float, 2> dy, View<const float, 2> x,
                     Context& ctx) {
  const std::int64_t N = x.extent(0), C = x.extent(1);
  const std::int64_t grain = std::max<std::int64_t>(64, N / 64), chunks = (N + grain - 1) / grain;
  Arena::Scope scope(ctx.arena());
  const View<float, 2> sums = ctx.arena().alloc(Shape{chunks, C});
  const auto row = add_product_function();
  parallel_chunks(
      chunks,
      [&](std::int64_t chunk, int) {
        std::fill_n(sums[chunk].data(), C, 0.0f);
        for (std::int64_t n = chunk * grain; n < std::min(N, (chunk + 1) * grain); ++n)
          row(sums[chunk].data(), dy[n].data(), x[n].data(), C);
      },
      ctx);
  for (std::int64_t chunk = 0; chunk < chunks; ++chunk)
    for (std::int64_t c = 0; c < C; ++c) dgamma[c] += sums(chunk, c);
}

}  // namespace
}  // namespace kernels

void layer_scale_forward(View<float, 2> y, View<const float, 2> x, View<const float, 1> gamma,
                         View<const float, 2> residual, Context& ctx) {
  const std::int64_t C = x.extent(1);
  LVGGT_CHECK(y.shape() == x.shape() && residual.shape() == x.shape() && gamma.extent(0) == C,
              "layer_scale: x is ", x.shape(), " but y is ", y.shape(), ", residual ",
              residual.shape(), " and gamma ", gamma.shape());
  const auto row = kernels::layer_scale_function();
  parallel_rows(
      x.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          row(y[n].data(), x[n].data(), gamma.data(), residual[n].data(), C);
      },
      ctx);
}

void layer_scale_backward(View<float, 2> dx, View<float, 1> dgamma, View<const float, 2> dy,
                          View<const float, 2> x, View<const float, 1> gamma, Context& ctx) {
  const std::int64_t C = x.extent(1);
  LVGGT_CHECK(dy.shape() == x.shape() && (!dx || dx.shape() == x.shape()),
              "layer_scale_backward: x is ", x.shape(), " but dy is ", dy.shape(), " and dx ",
              dx.shape());
  LVGGT_CHECK(gamma.extent(0) == C && (!dgamma || dgamma.extent(0) == C),
              "layer_scale_backward: x is ", x.shape(), " but gamma is ", gamma.shape(),
              " and dgamma ", dgamma.shape());
  if (dgamma) kernels::factor_gradient(dgamma, dy, x, ctx);
  if (dx.empty()) return;
  const auto row = kernels::multiply_function();
  parallel_rows(
      x.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) row(dx[n].data(), dy[n].data(), gamma.data(), C);
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
