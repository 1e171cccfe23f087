// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/rms_norm.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/rms_norm.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <cmath>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

void rms_norm_row(float* y, const float* x, const float* HWY_RESTRICT gamma, std::int64_t C,
                  float eps) {
  const float sum_of_squares = sum_vectors(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto v = hn::LoadU(d, x + i);
    return hn::Mul(v, v);
  });
  const float rstd = 1.0f / std::sqrt(sum_of_squares / static_cast<float>(C) + eps);
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto v = hn::Mul(hn::LoadU(d, x + i), hn::Set(d, rstd));
    hn::StoreU(hn::Mul(v, hn::LoadU(d, gamma + i)), d, y + i);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(rms_norm_row);
auto rms_norm_row_function() { return &HWY_DYNAMIC_DISPATCH(rms_norm_row); }

}  // namespace
}  // namespace kernels

void rms_norm_forward(View<float, 2> y, View<const float, 2> x, View<const float, 1> gamma,
                      float eps, Context& ctx) {
  const std::int64_t C = x.extent(1);
  LVGGT_CHECK(y.shape() == x.shape(), "rms_norm: y is ", y.shape(), " but x is ", x.shape());
  LVGGT_CHECK(gamma.extent(0) == C, "rms_norm: x is ", x.shape(), " but gamma is ", gamma.shape());
  const auto row = kernels::rms_norm_row_function();
  parallel_rows(
      x.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          row(y[n].data(), x[n].data(), gamma.data(), C, eps);
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
