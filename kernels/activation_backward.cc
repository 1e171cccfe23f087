// SPDX-License-Identifier: Apache-2.0
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/activation_backward.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/activation.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// dx[i] = dy[i] slope(x[i])
template <class Slope>
HWY_INLINE void slope_row(float* dx, const float* dy, const float* HWY_RESTRICT x,
                          std::int64_t count, const Slope& slope) {
  for_each_vector(count, [=](auto d, std::int64_t i) HWY_ATTR {
    hn::StoreU(hn::Mul(hn::LoadU(d, dy + i), slope(d, hn::LoadU(d, x + i))), d, dx + i);
  });
}

// Selected, not multiplied: an infinite dy where y is 0 gives 0.
void relu_backward_row(float* dx, const float* dy, const float* HWY_RESTRICT y,
                       std::int64_t count) {
  for_each_vector(count, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto passed = hn::Gt(hn::LoadU(d, y + i), hn::Zero(d));
    hn::StoreU(hn::IfThenElseZero(passed, hn::LoadU(d, dy + i)), d, dx + i);
  });
}

void sigmoid_backward_row(float* dx, const float* dy, const float* HWY_RESTRICT y,
                          std::int64_t count) {
  slope_row(dx, dy, y, count,
            [](auto d, auto v) HWY_ATTR { return hn::Mul(v, hn::Sub(hn::Set(d, 1.0f), v)); });
}

void gelu_backward_row(float* dx, const float* dy, const float* HWY_RESTRICT x,
                       std::int64_t count) {
  slope_row(dx, dy, x, count, [](auto d, auto v) HWY_ATTR { return gelu_slope(d, v); });
}

void silu_backward_row(float* dx, const float* dy, const float* HWY_RESTRICT x,
                       std::int64_t count) {
  slope_row(dx, dy, x, count, [](auto d, auto v) HWY_ATTR {
    const auto one = hn::Set(d, 1.0f);
    const auto s = sigmoid(d, v);
    return hn::Mul(s, hn::MulAdd(v, hn::Sub(one, s), one));
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(relu_backward_row);
HWY_EXPORT(sigmoid_backward_row);
HWY_EXPORT(gelu_backward_row);
HWY_EXPORT(silu_backward_row);

using BackwardRow = void (*)(float*, const float*, const float*, std::int64_t);

void run_rows(const char* op, BackwardRow row, View<float, 2> dx, View<const float, 2> dy,
              View<const float, 2> x, Context& ctx) {
  LVGGT_CHECK(dx.shape() == x.shape() && dy.shape() == x.shape(), op, ": dx is ", dx.shape(),
              " and dy is ", dy.shape(), " but the kept value is ", x.shape());
  if (dx.dense() && dy.dense() && x.dense()) {
    parallel_rows(
        x.size(), kElementsPerChunk,
        [&](std::int64_t begin, std::int64_t end) {
          row(dx.data() + begin, dy.data() + begin, x.data() + begin, end - begin);
        },
        ctx);
    return;
  }
  const std::int64_t C = x.extent(1);
  parallel_rows(
      x.extent(0), rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) row(dx[n].data(), dy[n].data(), x[n].data(), C);
      },
      ctx);
}

auto relu_function() { return HWY_DYNAMIC_DISPATCH(relu_backward_row); }
auto sigmoid_function() { return HWY_DYNAMIC_DISPATCH(sigmoid_backward_row); }
auto gelu_function() { return HWY_DYNAMIC_DISPATCH(gelu_backward_row); }
auto silu_function() { return HWY_DYNAMIC_DISPATCH(silu_backward_row); }

}  // namespace
}  // namespace kernels

void relu_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> y,
                   Context& ctx) {
  kernels::run_rows("relu_backward", kernels::relu_function(), dx, dy, y, ctx);
}

void sigmoid_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> y,
                      Context& ctx) {
  kernels::run_rows("sigmoid_backward", kernels::sigmoid_function(), dx, dy, y, ctx);
}

void gelu_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> x,
                   Context& ctx) {
  kernels::run_rows("gelu_backward", kernels::gelu_function(), dx, dy, x, ctx);
}

void silu_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> x,
                   Context& ctx) {
  kernels::run_rows("silu_backward", kernels::silu_function(), dx, dy, x, ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
