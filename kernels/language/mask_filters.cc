// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/mask_filters.h"

#include <algorithm>

#include "kernels/language/mask_filters.h"

namespace lvggt {
namespace {

template <class A, class B>
void check(const char* op, const View<A, 2>& y, const View<B, 2>& x, std::int64_t size) {
  LVGGT_CHECK(y.shape() == x.shape(), op, ": y is ", y.shape(), " but x is ", x.shape());
  if (size < 1 || size % 2 == 0)
    fail(ErrorKind::kUsage, op, ": a window of ", size, " pixels has no centre; it must be odd");
}

}  // namespace

void box_filter(View<float, 2> y, View<const float, 2> x, std::int64_t size, Context& ctx) {
  check("box_filter", y, x, size);
  Arena::Scope scope(ctx.arena());
  kernels::box_filter(y, x, size, ctx.arena().alloc<double>(Shape{x.extent(1)}).data());
}

void majority_filter(View<std::uint8_t, 2> y, View<const std::uint8_t, 2> x, std::int64_t size,
                     Context& ctx) {
  check("majority_filter", y, x, size);
  Arena::Scope scope(ctx.arena());
  kernels::majority_filter(y, x, size, ctx.arena().alloc<std::int32_t>(Shape{x.extent(1)}).data());
}

void threshold_mask(View<std::uint8_t, 2> mask, View<const float, 2> x, float threshold) {
  check("threshold_mask", mask, x, 1);
  const auto [H, W] = x.shape();
  if (x.size() == 0) return;
  float low = x(0, 0), high = x(0, 0);
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t i = 0; i < W; ++i) {
      const float v = x.data()[y * x.stride(0) + i];
      low = std::min(low, v);
      high = std::max(high, v);
    }
  // In the order of the published code, so that both round alike.
  const float range = (high - low) + 1e-9F;
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t i = 0; i < W; ++i) {
      const float scaled = (x.data()[y * x.stride(0) + i] - low) / range * 2 - 1;
      mask.data()[y * mask.stride(0) + i] = std::clamp(scaled, 0.0F, 1.0F) > threshold ? 1 : 0;
    }
}

}  // namespace lvggt
