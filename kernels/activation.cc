// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/activation.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/activation.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

template <class Function>
void map_row(float* y, const float* x, std::int64_t count, const Function& function) {
  for_each_vector(count, [=](auto d, std::int64_t i)
                             HWY_ATTR { hn::StoreU(function(d, hn::LoadU(d, x + i)), d, y + i); });
}

// x <= 0 ? 0 : x rather than Max, which on x86 would turn NaN into 0.
void relu_row(float* y, const float* x, std::int64_t count) {
  map_row(y, x, count,
          [](auto d, auto v) HWY_ATTR { return hn::IfThenZeroElse(hn::Le(v, hn::Zero(d)), v); });
}
void gelu_row(float* y, const float* x, std::int64_t count) {
  map_row(y, x, count, [](auto d, auto v) HWY_ATTR { return gelu(d, v); });
}
void silu_row(float* y, const float* x, std::int64_t count) {
  map_row(y, x, count, [](auto d, auto v) HWY_ATTR { return silu(d, v); });
}
void sigmoid_row(float* y, const float* x, std::int64_t count) {
  map_row(y, x, count, [](auto d, auto v) HWY_ATTR { return sigmoid(d, v); });
}
// Pixels handled at a time by the heads' activations, whose channels are too few to be vectors: a
// channel is gathered into a small array, mapped there, and written where it belongs.
constexpr std::int64_t kBlock = 256;

// y[i] = function(x[i * stride])
template <class Function>
HWY_INLINE void map_channel(float* HWY_RESTRICT y, const float* HWY_RESTRICT x, std::int64_t stride,
                            std::int64_t count, const Function& function) {
  HWY_ALIGN float channel[kBlock];
  for (std::int64_t begin = 0; begin < count; begin += kBlock) {
    const std::int64_t n = std::min(kBlock, count - begin);
    for (std::int64_t i = 0; i < n; ++i) channel[i] = x[(begin + i) * stride];
    map_row(y + begin, channel, n, function);
  }
}

void depth_rows(float* depth, float* confidence, const float* x, std::int64_t stride,
                std::int64_t count) {
  map_channel(depth, x, stride, count, [](auto d, auto v) HWY_ATTR { return exp(d, v); });
  map_channel(confidence, x + 1, stride, count,
              [](auto d, auto v) HWY_ATTR { return hn::Add(hn::Set(d, 1.0f), exp(d, v)); });
}

void point_rows(float* HWY_RESTRICT points, std::int64_t points_stride, float* confidence,
                const float* HWY_RESTRICT x, std::int64_t stride, std::int64_t count) {
  HWY_ALIGN float coordinate[kBlock];
  for (std::int64_t begin = 0; begin < count; begin += kBlock) {
    const std::int64_t n = std::min(kBlock, count - begin);
    for (std::int64_t axis = 0; axis < 3; ++axis) {
      map_channel(coordinate, x + begin * stride + axis, stride, n, [](auto d, auto v) HWY_ATTR {
        return hn::CopySignToAbs(expm1(d, hn::Abs(v)), v);
      });
      for (std::int64_t i = 0; i < n; ++i)
        points[(begin + i) * points_stride + axis] = coordinate[i];
    }
  }
  map_channel(confidence, x + 3, stride, count,
              [](auto d, auto v) HWY_ATTR { return hn::Add(hn::Set(d, 1.0f), exp(d, v)); });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(relu_row);
HWY_EXPORT(gelu_row);
HWY_EXPORT(silu_row);
HWY_EXPORT(sigmoid_row);
HWY_EXPORT(depth_rows);
HWY_EXPORT(point_rows);

using RowFunction = void (*)(float*, const float*, std::int64_t);

RowFunction row_function(Activation activation) {
  switch (activation) {
    case Activation::kRelu:
      return &HWY_DYNAMIC_DISPATCH(relu_row);
    case Activation::kGelu:
      return &HWY_DYNAMIC_DISPATCH(gelu_row);
    case Activation::kSilu:
      return &HWY_DYNAMIC_DISPATCH(silu_row);
    case Activation::kSigmoid:
      return &HWY_DYNAMIC_DISPATCH(sigmoid_row);
    case Activation::kNone:
      break;
  }
  return [](float* y, const float* x, std::int64_t count) {
    if (y != x) std::copy_n(x, count, y);
  };
}

auto depth_rows_function() { return &HWY_DYNAMIC_DISPATCH(depth_rows); }
auto point_rows_function() { return &HWY_DYNAMIC_DISPATCH(point_rows); }

}  // namespace
}  // namespace kernels

void activation_forward(View<float, 2> y, View<const float, 2> x, Activation activation,
                        Context& ctx) {
  LVGGT_CHECK(y.shape() == x.shape(), "activation: y is ", y.shape(), " but x is ", x.shape());
  const auto function = kernels::row_function(activation);
  if (y.dense() && x.dense()) {
    parallel_rows(
        x.size(), kernels::kElementsPerChunk,
        [&](std::int64_t begin, std::int64_t end) {
          function(y.data() + begin, x.data() + begin, end - begin);
        },
        ctx);
    return;
  }
  const std::int64_t C = x.extent(1);
  parallel_rows(
      x.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) function(y[n].data(), x[n].data(), C);
      },
      ctx);
}

void depth_activation(View<float, 1> depth, View<float, 1> confidence, View<const float, 2> x,
                      Context& ctx) {
  const auto [N, C] = x.shape();
  LVGGT_CHECK(C == 2 && depth.extent(0) == N && confidence.extent(0) == N,
              "depth_activation: x is ", x.shape(), ", expected [N,2], with depth ", depth.shape(),
              " and confidence ", confidence.shape());
  const auto rows = kernels::depth_rows_function();
  parallel_rows(
      N, kernels::rows_per_chunk(2),
      [&](std::int64_t begin, std::int64_t end) {
        rows(depth.data() + begin, confidence.data() + begin, x.data() + begin * x.stride(0),
             x.stride(0), end - begin);
      },
      ctx);
}

void point_activation(View<float, 2> points, View<float, 1> confidence, View<const float, 2> x,
                      Context& ctx) {
  const auto [N, C] = x.shape();
  LVGGT_CHECK(C == 4 && points.shape() == (Shape{N, std::int64_t{3}}) && confidence.extent(0) == N,
              "point_activation: x is ", x.shape(), ", expected [N,4], with points ",
              points.shape(), " and confidence ", confidence.shape());
  const auto rows = kernels::point_rows_function();
  parallel_rows(
      N, kernels::rows_per_chunk(4),
      [&](std::int64_t begin, std::int64_t end) {
        rows(points.data() + begin * points.stride(0), points.stride(0), confidence.data() + begin,
             x.data() + begin * x.stride(0), x.stride(0), end - begin);
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
