// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/layer_norm.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/layer_norm.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <cmath>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// gamma and beta may be null.
void layer_norm_row(float* y, const float* x, const float* HWY_RESTRICT gamma,
                    const float* HWY_RESTRICT beta, std::int64_t C, float eps) {
  const float mean =
      sum_vectors(C, [=](auto d, std::int64_t i) HWY_ATTR { return hn::LoadU(d, x + i); }) /
      static_cast<float>(C);
  const float sum_of_squares = sum_vectors(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto deviation = hn::Sub(hn::LoadU(d, x + i), hn::Set(d, mean));
    return hn::Mul(deviation, deviation);
  });
  const float rstd = 1.0f / std::sqrt(sum_of_squares / static_cast<float>(C) + eps);
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    auto v = hn::Mul(hn::Sub(hn::LoadU(d, x + i), hn::Set(d, mean)), hn::Set(d, rstd));
    if (gamma) v = hn::Mul(v, hn::LoadU(d, gamma + i));
    if (beta) v = hn::Add(v, hn::LoadU(d, beta + i));
    hn::StoreU(v, d, y + i);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(layer_norm_row);
auto layer_norm_row_function() { return &HWY_DYNAMIC_DISPATCH(layer_norm_row); }

// [N, C] as [N, 1, C]
template <class T>
View<T, 3> one_head(View<T, 2> x) {
  return View<T, 3>(x.data(), Shape{x.extent(0), std::int64_t{1}, x.extent(1)},
                    {x.stride(0), x.extent(1), 1});
}

}  // namespace
}  // namespace kernels

void layer_norm_forward(View<float, 3> y, View<const float, 3> x, View<const float, 1> gamma,
                        View<const float, 1> beta, float eps, Context& ctx) {
  const auto [N, heads, C] = x.shape();
  LVGGT_CHECK(y.shape() == x.shape(), "layer_norm: y is ", y.shape(), " but x is ", x.shape());
  LVGGT_CHECK((!gamma || gamma.extent(0) == C) && (!beta || beta.extent(0) == C),
              "layer_norm: x is ", x.shape(), " but gamma is ", gamma.shape(), " and beta ",
              beta.shape());
  const auto row = kernels::layer_norm_row_function();
  const std::int64_t num_heads = heads, channels = C;
  parallel_rows(
      N, kernels::rows_per_chunk(heads * C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          for (std::int64_t h = 0; h < num_heads; ++h)
            row(y[n][h].data(), x[n][h].data(), gamma.data(), beta.data(), channels, eps);
      },
      ctx);
}

void layer_norm_forward(View<float, 2> y, View<const float, 2> x, View<const float, 1> gamma,
                        View<const float, 1> beta, float eps, Context& ctx) {
  layer_norm_forward(kernels::one_head(y), kernels::one_head(x), gamma, beta, eps, ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
