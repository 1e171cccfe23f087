// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/dense_activation_backward.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/dense_activation_backward.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// One channel of `count` pixels, dx = exp(x) dy or exp(|x|) dy: gathered into small arrays, because
// a pixel has too few channels to be a vector.
void exponential_slope(float* HWY_RESTRICT dx, std::int64_t dx_step, const float* HWY_RESTRICT dy,
                       std::int64_t dy_step, const float* HWY_RESTRICT x, std::int64_t x_step,
                       bool magnitude, std::int64_t count) {
  constexpr std::int64_t kBlock = 256;
  HWY_ALIGN float values[kBlock];
  for (std::int64_t begin = 0; begin < count; begin += kBlock) {
    const std::int64_t n = std::min(kBlock, count - begin);
    for (std::int64_t i = 0; i < n; ++i) values[i] = x[(begin + i) * x_step];
    float* const slopes = values;
    for_each_vector(n, [=](auto d, std::int64_t i) HWY_ATTR {
      const auto v = hn::LoadU(d, slopes + i);
      hn::StoreU(exp(d, magnitude ? hn::Abs(v) : v), d, slopes + i);
    });
    for (std::int64_t i = 0; i < n; ++i)
      dx[(begin + i) * dx_step] = values[i] * dy[(begin + i) * dy_step];
  }
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(exponential_slope);
auto slope_function() { return HWY_DYNAMIC_DISPATCH(exponential_slope); }

}  // namespace
}  // namespace kernels

void depth_activation_backward(View<float, 2> dx, View<const float, 1> ddepth,
                               View<const float, 1> dconfidence, View<const float, 2> x,
                               Context& ctx) {
  const std::int64_t N = x.extent(0);
  LVGGT_CHECK(x.extent(1) == 2 && dx.shape() == x.shape(), "depth_activation_backward: dx is ",
              dx.shape(), " and x ", x.shape(), ", expected [N,2]");
  LVGGT_CHECK(ddepth.extent(0) == N && dconfidence.extent(0) == N,
              "depth_activation_backward: x is ", x.shape(), " but ddepth is ", ddepth.shape(),
              " and dconfidence ", dconfidence.shape());
  const auto slope = kernels::slope_function();
  parallel_rows(
      N, kernels::rows_per_chunk(2),
      [&](std::int64_t begin, std::int64_t end) {
        float* to = dx.data() + begin * dx.stride(0);
        const float* from = x.data() + begin * x.stride(0);
        slope(to, dx.stride(0), ddepth.data() + begin, 1, from, x.stride(0), false, end - begin);
        slope(to + 1, dx.stride(0), dconfidence.data() + begin, 1, from + 1, x.stride(0), false,
              end - begin);
      },
      ctx);
}

void point_activation_backward(View<float, 2> dx, View<const float, 2> dpoints,
                               View<const float, 1> dconfidence, View<const float, 2> x,
                               Context& ctx) {
  const std::int64_t N = x.extent(0);
  LVGGT_CHECK(x.extent(1) == 4 && dx.shape() == x.shape(), "point_activation_backward: dx is ",
              dx.shape(), " and x ", x.shape(), ", expected [N,4]");
  LVGGT_CHECK(dpoints.shape() == (Shape{N, std::int64_t{3}}) && dconfidence.extent(0) == N,
              "point_activation_backward: x is ", x.shape(), " but dpoints is ", dpoints.shape(),
              " and dconfidence ", dconfidence.shape());
  const auto slope = kernels::slope_function();
  parallel_rows(
      N, kernels::rows_per_chunk(4),
      [&](std::int64_t begin, std::int64_t end) {
        float* to = dx.data() + begin * dx.stride(0);
        const float* from = x.data() + begin * x.stride(0);
        for (std::int64_t axis = 0; axis < 3; ++axis)
          slope(to + axis, dx.stride(0), dpoints.data() + begin * dpoints.stride(0) + axis,
                dpoints.stride(0), from + axis, x.stride(0), true, end - begin);
        slope(to + 3, dx.stride(0), dconfidence.data() + begin, 1, from + 3, x.stride(0), false,
              end - begin);
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
