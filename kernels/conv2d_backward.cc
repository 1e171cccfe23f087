// SPDX-License-Identifier: Apache-2.0
// Backward passes of the three layers that are products: conv2d, conv_transpose2d, linear.
#include <algorithm>

#include "kernels/conv2d_product.h"
#include "kernels/pack.h"
#include "kernels/product.h"
#include "kernels/tap_gather.h"
#include "kernels/weight_gradient.h"
#include "lvggt/kernels/conv2d.h"
#include "lvggt/kernels/conv_transpose2d.h"
#include "lvggt/kernels/linear.h"

namespace lvggt {
namespace {

// One axis of the input gradient. Output o reads input p = stride o + tap - padding, so input p
// gets gradients from the taps t = (p + padding) mod stride, + stride, + 2 stride, ... only: from
// output (p + padding - t) / stride each. All p of the same residue ("phase") have the same taps.
struct Phase {
  std::int64_t first_tap;  // below stride
  std::int64_t taps;       // first_tap, first_tap + stride, ...
  std::int64_t inputs;     // p = phase, phase + stride, ...
};
Phase phase_of(std::int64_t phase, std::int64_t extent, std::int64_t kernel, std::int64_t stride,
               std::int64_t padding) {
  const std::int64_t first = (phase + padding) % stride;
  return {first, std::max<std::int64_t>(0, (kernel - first + stride - 1) / stride),
          std::max<std::int64_t>(0, (extent - phase + stride - 1) / stride)};
}

// The input gradient of the pixels of one phase of each axis: a convolution of dy with stride 1.
class InputGradient {
 public:
  InputGradient(View<float, 4> dx, View<const float, 4> dy, View<const float, 4> weight,
                std::int64_t stride, std::int64_t padding, Context& ctx)
      : dx_(dx), dy_(dy), weight_(weight), stride_(stride), padding_(padding) {
    zeros_ = ctx.arena().alloc(Shape{dy.extent(3)});
    std::fill_n(zeros_.data(), dy.extent(3), 0.0f);
  }

  void run(std::int64_t phase_y, std::int64_t phase_x, Context& ctx) const {
    const std::int64_t kernel = weight_.extent(2);
    const Phase down = phase_of(phase_y, dx_.extent(1), kernel, stride_, padding_);
    const Phase across = phase_of(phase_x, dx_.extent(2), kernel, stride_, padding_);
    const std::int64_t M = dx_.extent(0) * down.inputs * across.inputs;
    if (M == 0) return;
    Arena::Scope scope(ctx.arena());
    const std::int64_t taps = std::max<std::int64_t>(1, down.taps * across.taps);
    const kernels::PackedPanels w = packed(down, across, ctx);
    const kernels::Product product{M,       w,    taps, dy_.extent(3), nullptr, Activation::kNone,
                                   nullptr, false};
    // Input p = phase + stride i reads, through its j-th tap, output i + first - j.
    const auto axis = [&](const Phase& p, std::int64_t phase) {
      return kernels::TapAxis{std::max<std::int64_t>(1, p.taps), 1,
                              (phase + padding_ - p.first_tap) / stride_, -1};
    };
    const View<float, 4> dx(dx_.data() + phase_y * dx_.stride(1) + phase_x * dx_.stride(2),
                            Shape{dx_.extent(0), down.inputs, across.inputs, dx_.extent(3)},
                            {dx_.stride(0), stride_ * dx_.stride(1), stride_ * dx_.stride(2), 1});
    const kernels::TapGather gather(dx, dy_, {}, axis(down, phase_y), axis(across, phase_x),
                                    zeros_.data());
    kernels::run_product(product, gather, ctx);
  }

 private:
  std::int64_t tap(const Phase& phase, std::int64_t i) const {
    return phase.first_tap + i * stride_;
  }

  // The phase's taps, input and output channels exchanged.
  kernels::PackedPanels packed(const Phase& down, const Phase& across, Context& ctx) const {
    const std::int64_t count = down.taps * across.taps;
    if (count == 0) {
      // Nothing reads these pixels: one tap of zero weights gives them gradient 0.
      const std::int64_t values = num_panels(weight_.extent(1)) * kPanelWidth * weight_.extent(0);
      const View<float, 1> zeros = ctx.arena().alloc(Shape{values});
      std::fill_n(zeros.data(), values, 0.0f);
      return kernels::PackedPanels(weight_.extent(1), zeros.data());
    }
    const View<std::int64_t, 1> taps = ctx.arena().alloc<std::int64_t>(Shape{count});
    for (std::int64_t t = 0; t < count; ++t)
      taps[t] = tap(down, t / across.taps) * weight_.stride(2) +
                tap(across, t % across.taps) * weight_.stride(3);
    return kernels::pack_in_arena({weight_.data(), weight_.extent(1), weight_.stride(1),
                                   weight_.extent(0), weight_.stride(0), taps},
                                  ctx);
  }

  View<float, 4> dx_;
  View<const float, 4> dy_;
  View<const float, 4> weight_;
  std::int64_t stride_;
  std::int64_t padding_;
  View<float, 1> zeros_;
};

// With stride 1 there is one phase, and dx is the convolution of dy with the filters turned by 180
// degrees, input and output channels exchanged.
void input_gradient_of_stride_1(View<float, 4> dx, View<const float, 4> dy,
                                View<const float, 4> weight, std::int64_t padding, Context& ctx) {
  const std::int64_t Cout = weight.extent(0), Cin = weight.extent(1), kernel = weight.extent(2);
  Arena::Scope scope(ctx.arena());
  const View<std::int64_t, 1> taps = ctx.arena().alloc<std::int64_t>(Shape{kernel * kernel});
  for (std::int64_t t = 0; t < taps.extent(0); ++t)
    taps[t] =
        (kernel - 1 - t / kernel) * weight.stride(2) + (kernel - 1 - t % kernel) * weight.stride(3);
  const kernels::PackedPanels w = kernels::pack_in_arena(
      {weight.data(), Cin, weight.stride(1), Cout, weight.stride(0), taps}, ctx);
  kernels::run_conv2d(dx, dy, {Cout, kernel, 1, kernel - 1 - padding}, w, {}, ctx);
}

// [M, C] as [1, 1, M, C]
template <class T>
View<T, 4> as_map(View<T, 2> rows) {
  if (rows.empty()) return {};
  const std::int64_t M = rows.extent(0), C = rows.extent(1);
  return View<T, 4>(rows.data(), Shape{std::int64_t{1}, std::int64_t{1}, M, C},
                    {M * rows.stride(0), M * rows.stride(0), rows.stride(0), 1});
}

// [N, K] as [N, K, 1, 1]
template <class T>
View<T, 4> as_filters(View<T, 2> weight) {
  if (weight.empty()) return {};
  return View<T, 4>(weight.data(),
                    Shape{weight.extent(0), weight.extent(1), std::int64_t{1}, std::int64_t{1}},
                    {weight.stride(0), 1, 1, 1});
}

}  // namespace

void conv2d_backward(View<float, 4> dx, View<float, 4> dweight, View<float, 1> dbias,
                     View<const float, 4> dy, View<const float, 4> x, View<const float, 4> weight,
                     std::int64_t stride, std::int64_t padding, Context& ctx) {
  const auto [Cout, Cin, kernel, kernel_x] = weight.shape();
  LVGGT_CHECK(kernel == kernel_x, "conv2d_backward: weight ", weight.shape(),
              " does not have a square kernel");
  const auto check_input = [&](const char* name, const Shape<4>& shape) {
    const Shape expected{shape[0], conv2d_extent(shape[1], weight.extent(2), stride, padding),
                         conv2d_extent(shape[2], weight.extent(2), stride, padding),
                         weight.extent(0)};
    LVGGT_CHECK(shape[3] == weight.extent(1) && dy.shape() == expected, "conv2d_backward: dy is ",
                dy.shape(), " but ", name, " ", shape, " and the weight ", weight.shape(), " give ",
                expected);
  };
  if (dx) check_input("dx", dx.shape());
  if (dweight) check_input("x", x.shape());
  LVGGT_CHECK(dweight.empty() || dweight.shape() == weight.shape(), "conv2d_backward: dweight is ",
              dweight.shape(), " but the weight is ", weight.shape());
  LVGGT_CHECK(dbias.empty() || dbias.extent(0) == dy.extent(3), "conv2d_backward: dbias is ",
              dbias.shape(), " but dy is ", dy.shape());
  if (dweight) {
    kernels::weight_gradient(dweight, dbias, dy, x, stride, padding, ctx);
  } else if (dbias) {
    kernels::bias_gradient(dbias, dy, ctx);
  }
  if (dx.empty()) return;
  if (stride == 1 && padding < kernel)
    return input_gradient_of_stride_1(dx, dy, weight, padding, ctx);
  Arena::Scope scope(ctx.arena());
  const InputGradient gradient(dx, dy, weight, stride, padding, ctx);
  for (std::int64_t phase = 0; phase < stride * stride; ++phase)
    gradient.run(phase / stride, phase % stride, ctx);
}

void conv_transpose2d_backward(View<float, 4> dx, View<float, 4> dweight, View<float, 1> dbias,
                               View<const float, 4> dy, View<const float, 4> x,
                               View<const float, 4> weight, Context& ctx) {
  const std::int64_t k = weight.extent(2);
  LVGGT_CHECK(k == weight.extent(3), "conv_transpose2d_backward: weight ", weight.shape(),
              " does not have a square kernel");
  const auto check_input = [&](const char* name, const Shape<4>& shape) {
    const Shape expected{shape[0], k * shape[1], k * shape[2], weight.extent(1)};
    LVGGT_CHECK(shape[3] == weight.extent(0) && dy.shape() == expected,
                "conv_transpose2d_backward: dy is ", dy.shape(), " but ", name, " ", shape,
                " and the weight ", weight.shape(), " give ", expected);
  };
  if (dx) check_input("dx", dx.shape());
  if (dweight) check_input("x", x.shape());
  LVGGT_CHECK(dweight.empty() || dweight.shape() == weight.shape(),
              "conv_transpose2d_backward: dweight is ", dweight.shape(), " but the weight is ",
              weight.shape());
  LVGGT_CHECK(dbias.empty() || dbias.extent(0) == dy.extent(3),
              "conv_transpose2d_backward: dbias is ", dbias.shape(), " but dy is ", dy.shape());
  // The convolution that this layer is the input gradient of reads dy and writes dx; its weight is
  // this one, [Cout, Cin, k, k] of that convolution.
  if (dweight) kernels::weight_gradient(dweight, {}, x, dy, k, 0, ctx);
  if (dbias) kernels::bias_gradient(dbias, dy, ctx);
  if (dx) conv2d_forward(dx, dy, weight, k, 0, {}, ctx);
}

void linear_backward(View<float, 2> dx, View<float, 2> dweight, View<float, 1> dbias,
                     View<const float, 2> dy, View<const float, 2> x, View<const float, 2> weight,
                     Context& ctx) {
  conv2d_backward(as_map(dx), as_filters(dweight), dbias, as_map(dy), as_map(x), as_filters(weight),
                  1, 0, ctx);
}

}  // namespace lvggt
