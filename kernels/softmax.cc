// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/softmax.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/softmax.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// A NaN may be lost here, but not in the exponentials.
float largest_of(const float* HWY_RESTRICT x, std::int64_t C) {
  const hn::ScalableTag<float> d;
  const auto N = static_cast<std::int64_t>(hn::Lanes(d));
  float largest = x[0];
  std::int64_t i = 0;
  if (C >= N) {
    auto lanes = hn::LoadU(d, x);
    for (i = N; i + N <= C; i += N) lanes = hn::Max(lanes, hn::LoadU(d, x + i));
    largest = hn::GetLane(hn::MaxOfLanes(d, lanes));
  }
  for (; i < C; ++i) largest = std::max(largest, x[i]);
  return largest;
}

void softmax_row(float* y, const float* x, float scale, std::int64_t C) {
  const float largest = largest_of(x, C);
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto below = hn::Sub(hn::LoadU(d, x + i), hn::Set(d, largest));
    hn::StoreU(exp_nonpositive(d, hn::Mul(below, hn::Set(d, scale))), d, y + i);
  });
  const float inverse =
      1.0f / sum_vectors(C, [=](auto d, std::int64_t i) HWY_ATTR { return hn::LoadU(d, y + i); });
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    hn::StoreU(hn::Mul(hn::LoadU(d, y + i), hn::Set(d, inverse)), d, y + i);
  });
}

void softmax_backward_row(float* dx, const float* dy, const float* HWY_RESTRICT y, float scale,
                          std::int64_t C) {
  const float mean = sum_vectors(C, [=](auto d, std::int64_t i) HWY_ATTR {
    return hn::Mul(hn::LoadU(d, y + i), hn::LoadU(d, dy + i));
  });
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto slope = hn::Mul(hn::LoadU(d, y + i), hn::Set(d, scale));
    hn::StoreU(hn::Mul(slope, hn::Sub(hn::LoadU(d, dy + i), hn::Set(d, mean))), d, dx + i);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(softmax_row);
HWY_EXPORT(softmax_backward_row);
auto softmax_function() { return HWY_DYNAMIC_DISPATCH(softmax_row); }
auto softmax_backward_function() { return HWY_DYNAMIC_DISPATCH(softmax_backward_row); }

}  // namespace
}  // namespace kernels

void softmax_forward(View<float, 2> y, View<const float, 2> x, float scale, Context& ctx) {
  const std::int64_t C = x.extent(1);
  LVGGT_CHECK(y.shape() == x.shape(), "softmax: y is ", y.shape(), " but x is ", x.shape());
  LVGGT_CHECK(scale > 0, "softmax: scale ", scale, " is not positive");
  if (C == 0) return;
  const auto row = kernels::softmax_function();
  parallel_rows(
      x.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) row(y[n].data(), x[n].data(), scale, C);
      },
      ctx);
}

void softmax_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> y,
                      float scale, Context& ctx) {
  const std::int64_t C = y.extent(1);
  LVGGT_CHECK(dx.shape() == y.shape() && dy.shape() == y.shape(), "softmax_backward: dx is ",
              dx.shape(), " and dy is ", dy.shape(), " but y is ", y.shape());
  const auto row = kernels::softmax_backward_function();
  parallel_rows(
      y.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          row(dx[n].data(), dy[n].data(), y[n].data(), scale, C);
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
