// SPDX-License-Identifier: Apache-2.0
// The float64 kernels against the fast ones, which have definitions of their own to answer to.
#include <doctest/doctest.h>

#include "lvggt/exact/kernels.h"
#include "lvggt/exact/parameters.h"
#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/batch_norm2d.h"
#include "lvggt/kernels/conv2d.h"
#include "lvggt/kernels/conv_transpose2d.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/kernels/interpolate.h"
#include "lvggt/kernels/layer_norm.h"
#include "lvggt/kernels/linear.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"

namespace lvggt {
namespace {

using test::in_double;
using test::random_tensor;

// Operands below are at most 1 and sums have fewer than 300 terms, whose partial sums stay below
// 16: 300 roundings of half an ulp of 16 would be 3e-4 if all went one way, they go both.
constexpr double kFloatError = 3e-5;

// An output of both: NaN at first, so that what is not written shows.
template <int R>
struct Both {
  explicit Both(Shape<R> shape, float start = std::numeric_limits<float>::quiet_NaN())
      : fast(shape), exact(shape) {
    std::fill_n(fast.data(), fast.size(), start);
    std::fill_n(exact.data(), exact.size(), static_cast<double>(start));
  }
  void check(const char* what) const {
    CAPTURE(what);
    CHECK_CLOSE(fast, exact, kFloatError);
  }
  Tensor<float, R> fast;
  Tensor<double, R> exact;
};

// An input of both.
template <int R>
struct Operand {
  explicit Operand(Shape<R> shape, std::uint32_t seed, float low = -1, float high = 1)
      : fast(random_tensor(shape, seed, low, high)), exact(in_double(fast)) {}
  Tensor<float, R> fast;
  Tensor<double, R> exact;
};

template <int R, class... Extents>
Shape<R> shape_of(Extents... extents) {
  return Shape<R>{{static_cast<std::int64_t>(extents)...}};
}

TEST_CASE("exact conv2d: forward and backward are the fast kernel's") {
  Context ctx(2);
  struct Case {
    std::int64_t k, stride, padding;
  };
  for (const Case c : {Case{3, 1, 1}, Case{3, 2, 1}, Case{2, 2, 0}, Case{1, 1, 0}}) {
    CAPTURE(c.k);
    CAPTURE(c.stride);
    const Operand<4> x(shape_of<4>(2, 7, 9, 5), 1), w(shape_of<4>(6, 5, c.k, c.k), 2);
    const Operand<1> bias(shape_of<1>(6), 3);
    const Shape<4> out = shape_of<4>(2, conv2d_extent(7, c.k, c.stride, c.padding),
                                     conv2d_extent(9, c.k, c.stride, c.padding), 6);
    const Operand<4> residual(out, 4), dy(out, 5);
    Both<4> y(out), dx(x.fast.shape()), dw(w.fast.shape(), 0.5f);
    Both<1> db(shape_of<1>(6), 0.5f);
    conv2d_forward(y.fast, x.fast, w.fast, c.stride, c.padding,
                   {.bias = bias.fast, .activation = Activation::kRelu, .residual = residual.fast},
                   ctx);
    conv2d_forward(
        y.exact, x.exact, w.exact, c.stride, c.padding,
        {.bias = bias.exact, .activation = Activation::kRelu, .residual = residual.exact}, ctx);
    y.check("y");
    conv2d_backward(dx.fast, dw.fast, db.fast, dy.fast, x.fast, w.fast, c.stride, c.padding, ctx);
    conv2d_backward(dx.exact, dw.exact, db.exact, dy.exact, x.exact, w.exact, c.stride, c.padding,
                    ctx);
    dx.check("dx");
    dw.check("dweight");
    db.check("dbias");
  }
}

TEST_CASE("exact conv_transpose2d: forward and backward are the fast kernel's") {
  Context ctx(2);
  for (const std::int64_t k : {std::int64_t{2}, std::int64_t{4}}) {
    const Operand<4> x(shape_of<4>(2, 3, 4, 5), 1), w(shape_of<4>(5, 3, k, k), 2);
    const Operand<4> dy(shape_of<4>(2, 3 * k, 4 * k, 3), 3);
    const Operand<1> bias(shape_of<1>(3), 4);
    Both<4> y(dy.fast.shape()), dx(x.fast.shape()), dw(w.fast.shape(), 0.5f);
    Both<1> db(shape_of<1>(3), 0.5f);
    conv_transpose2d_forward(y.fast, x.fast, w.fast, bias.fast, ctx);
    conv_transpose2d_forward(y.exact, x.exact, w.exact, bias.exact, ctx);
    y.check("y");
    conv_transpose2d_backward(dx.fast, dw.fast, db.fast, dy.fast, x.fast, w.fast, ctx);
    conv_transpose2d_backward(dx.exact, dw.exact, db.exact, dy.exact, x.exact, w.exact, ctx);
    dx.check("dx");
    dw.check("dweight");
    db.check("dbias");
  }
}

TEST_CASE("exact linear: forward and backward are the fast kernel's") {
  Context ctx(2);
  const Operand<2> x(shape_of<2>(9, 7), 1), w(shape_of<2>(5, 7), 2), dy(shape_of<2>(9, 5), 3);
  const Operand<1> bias(shape_of<1>(5), 4), gamma(shape_of<1>(5), 5);
  for (const Activation activation : {Activation::kNone, Activation::kRelu, Activation::kGelu,
                                      Activation::kSilu, Activation::kSigmoid}) {
    Both<2> y(dy.fast.shape());
    linear_forward(y.fast, x.fast, w.fast,
                   {.bias = bias.fast, .activation = activation, .gamma = gamma.fast}, ctx);
    linear_forward(y.exact, x.exact, w.exact,
                   {.bias = bias.exact, .activation = activation, .gamma = gamma.exact}, ctx);
    y.check("y");
  }
  Both<2> dx(x.fast.shape()), dw(w.fast.shape(), 0.5f);
  Both<1> db(shape_of<1>(5), 0.5f);
  linear_backward(dx.fast, dw.fast, db.fast, dy.fast, x.fast, w.fast, ctx);
  linear_backward(dx.exact, dw.exact, db.exact, dy.exact, x.exact, w.exact, ctx);
  dx.check("dx");
  dw.check("dweight");
  db.check("dbias");
}

TEST_CASE("exact layer_norm: forward and backward are the fast kernel's") {
  Context ctx(2);
  const Operand<2> x(shape_of<2>(9, 7), 1), dy(shape_of<2>(9, 7), 2);
  const Operand<1> gamma(shape_of<1>(7), 3), beta(shape_of<1>(7), 4);
  Both<2> y(x.fast.shape()), dx(x.fast.shape());
  Both<1> mean(shape_of<1>(9)), rstd(shape_of<1>(9)), dgamma(shape_of<1>(7), 0.5f),
      dbeta(shape_of<1>(7), 0.5f);
  layer_norm_forward(y.fast, mean.fast, rstd.fast, x.fast, gamma.fast, beta.fast, 1e-5f, ctx);
  layer_norm_forward(y.exact, mean.exact, rstd.exact, x.exact, gamma.exact, beta.exact, 1e-5, ctx);
  layer_norm_backward(dx.fast, dgamma.fast, dbeta.fast, dy.fast, mean.fast, rstd.fast, x.fast,
                      gamma.fast, ctx);
  layer_norm_backward(dx.exact, dgamma.exact, dbeta.exact, dy.exact, mean.exact, rstd.exact,
                      x.exact, gamma.exact, ctx);
  y.check("y");
  mean.check("mean");
  rstd.check("rstd");
  dx.check("dx");
  dgamma.check("dgamma");
  dbeta.check("dbeta");
}

// Two ways to the same: at once, and by sums as several processes do it; and frozen statistics.
TEST_CASE("exact batch_norm2d: forward and backward are the fast kernel's") {
  Context ctx(2);
  const std::int64_t C = 5;
  const Shape<4> map = shape_of<4>(3, 4, 6, C);
  const Operand<4> x(map, 1, -1, 2), dy(map, 2);
  const Operand<1> gamma(Shape{C}, 3), beta(Shape{C}, 4), pivot(Shape{C}, 5);
  Both<4> y(map), dx(map);
  Both<1> mean(Shape{C}), rstd(Shape{C}), running_mean(Shape{C}, 0.5f), running_var(Shape{C}, 1.5f);
  Both<1> dgamma(Shape{C}, 0.5f), dbeta(Shape{C}, 0.5f);
  const auto check = [&] {
    for (const Both<1>* vector : {&mean, &rstd, &running_mean, &running_var, &dgamma, &dbeta})
      vector->check("statistics, dgamma or dbeta");
    y.check("y");
    dx.check("dx");
  };
  const auto relu = Activation::kRelu;
  batch_norm2d_forward(y.fast, mean.fast, rstd.fast, running_mean.fast, running_var.fast, x.fast,
                       gamma.fast, beta.fast, 1e-5f, 0.1f, relu, ctx);
  batch_norm2d_forward(y.exact, mean.exact, rstd.exact, running_mean.exact, running_var.exact,
                       x.exact, gamma.exact, beta.exact, 1e-5, 0.1, relu, ctx);
  batch_norm2d_backward(dx.fast, dgamma.fast, dbeta.fast, dy.fast, mean.fast, rstd.fast, x.fast,
                        gamma.fast, beta.fast, relu, ctx);
  batch_norm2d_backward(dx.exact, dgamma.exact, dbeta.exact, dy.exact, mean.exact, rstd.exact,
                        x.exact, gamma.exact, beta.exact, relu, ctx);
  check();

  Tensor<double, 2> sums(shape_of<2>(2, C));
  batch_norm2d_sums(sums, x.exact, pivot.exact, ctx);
  batch_norm2d_statistics(mean.exact, rstd.exact, {}, {}, sums, pivot.exact, x.fast.size() / C,
                          1e-5, 0.1);
  check();

  batch_norm2d_rstd(rstd.fast, running_var.fast, 1e-5f);
  batch_norm2d_rstd(rstd.exact, running_var.exact, 1e-5);
  batch_norm2d_normalize(y.fast, x.fast, running_mean.fast, rstd.fast, gamma.fast, beta.fast, relu,
                         ctx);
  batch_norm2d_normalize(y.exact, x.exact, running_mean.exact, rstd.exact, gamma.exact, beta.exact,
                         relu, ctx);
  batch_norm2d_backward_input(dx.fast, dy.fast, {}, 1, running_mean.fast, rstd.fast, x.fast,
                              gamma.fast, beta.fast, relu, ctx);
  batch_norm2d_backward_input(dx.exact, dy.exact, {}, 1, running_mean.exact, rstd.exact, x.exact,
                              gamma.exact, beta.exact, relu, ctx);
  check();
}

TEST_CASE("exact bilinear: both resizes and their backward passes are the fast kernel's") {
  Context ctx(2);
  for (const bool align_corners : {true, false})
    for (const Shape<2>& size : {shape_of<2>(11, 13), shape_of<2>(3, 4), shape_of<2>(1, 5)}) {
      CAPTURE(align_corners);
      CAPTURE(size[0]);
      const Operand<4> x(shape_of<4>(2, 5, 7, 3), 1), dy(shape_of<4>(2, size[0], size[1], 3), 2);
      Both<4> y(dy.fast.shape()), dx(x.fast.shape());
      bilinear_forward(y.fast, x.fast, align_corners, ctx);
      bilinear_forward(y.exact, x.exact, align_corners, ctx);
      bilinear_backward(dx.fast, dy.fast, align_corners, ctx);
      bilinear_backward(dx.exact, dy.exact, align_corners, ctx);
      y.check("y");
      dx.check("dx");
    }
}

TEST_CASE("exact element-wise operations are the fast kernel's") {
  Context ctx(2);
  const Operand<2> x(shape_of<2>(9, 7), 1), dy(shape_of<2>(9, 7), 2);
  Both<2> y(x.fast.shape());
  activation_forward(y.fast, x.fast, Activation::kSigmoid, ctx);
  activation_forward(y.exact, x.exact, Activation::kSigmoid, ctx);
  y.check("sigmoid");
  sigmoid_backward(y.fast, dy.fast, y.fast, ctx);
  sigmoid_backward(y.exact, dy.exact, y.exact, ctx);
  y.check("sigmoid_backward");
  relu_backward(y.fast, dy.fast, x.fast, ctx);
  relu_backward(y.exact, dy.exact, x.exact, ctx);
  y.check("relu_backward");
  accumulate(y.fast, x.fast, ctx);
  accumulate(y.exact, x.exact, ctx);
  y.check("accumulate");
  copy_rows(y.fast, dy.fast, ctx);
  copy_rows(y.exact, dy.exact, ctx);
  y.check("copy_rows");
}

TEST_CASE("exact losses and their gradients are the fast kernel's") {
  Context ctx(2);
  const Shape<4> map = shape_of<4>(2, 3, 5, 4);
  const Operand<4> a(map, 1), b(map, 2);
  Operand<3> mask(shape_of<3>(2, 3, 5), 3, 0, 1);
  for (std::int64_t i = 0; i < mask.fast.size(); ++i)
    mask.exact.data()[i] = mask.fast.data()[i] = mask.fast.data()[i] < 0.8f ? 1 : 0;
  Both<4> da(map);
  const auto value = [](double exact) { return doctest::Approx(exact).epsilon(1e-6); };
  for (const bool masked : {true, false}) {
    const View<const float, 3> m = masked ? mask.fast.view() : View<const float, 3>();
    const View<const double, 3> me = masked ? mask.exact.view() : View<const double, 3>();
    CHECK(l1_loss_forward(a.fast, b.fast, m, ctx) ==
          value(l1_loss_forward(a.exact, b.exact, me, ctx)));
    l1_loss_backward(da.fast, 100, a.fast, b.fast, m, ctx);
    l1_loss_backward(da.exact, 100, a.exact, b.exact, me, ctx);
    da.check("l1");
    CHECK(mse_loss_forward(a.fast, b.fast, m, ctx) ==
          value(mse_loss_forward(a.exact, b.exact, me, ctx)));
    mse_loss_backward(da.fast, 100, a.fast, b.fast, m, ctx);
    mse_loss_backward(da.exact, 100, a.exact, b.exact, me, ctx);
    da.check("mse");
    for (const CosineAxis axis : {CosineAxis::kChannels, CosineAxis::kWidth}) {
      CHECK(cosine_loss_forward(a.fast, b.fast, m, axis, ctx) ==
            value(cosine_loss_forward(a.exact, b.exact, me, axis, ctx)));
      cosine_loss_backward(da.fast, 30, a.fast, b.fast, m, axis, ctx);
      cosine_loss_backward(da.exact, 30, a.exact, b.exact, me, axis, ctx);
      da.check("cosine");
    }
  }
}

TEST_CASE("exact adamw: norm and three clipped steps are the fast optimiser's") {
  Context ctx(2);
  ParameterStore store({{"w", {4, 6}}, {"b", {6}}});
  const auto fill = [&](StoreRole role, std::uint32_t seed) {
    for (const char* name : {"w", "b"}) {
      const std::span<float> values = store.values(role, name);
      const Tensor<float, 1> random = random_tensor(Shape{std::ssize(values)}, seed++);
      std::copy_n(random.data(), random.size(), values.data());
    }
  };
  fill(StoreRole::kWeights, 1);
  ExactParameters exact(store);
  for (std::int64_t t = 1; t <= 3; ++t) {
    fill(StoreRole::kGradients, 10 * static_cast<std::uint32_t>(t));
    std::ranges::copy(store.block(StoreRole::kGradients),
                      exact.block(StoreRole::kGradients).begin());
    const double norm = gradient_norm(store, ctx);
    CHECK(norm == doctest::Approx(gradient_norm(exact)).epsilon(1e-12));
    adamw_step(store, t, 1e-2, 1 / norm, 0, {.weight_decay = 0.1}, ctx);
    adamw_step(exact, t, 1e-2, 1 / norm, {.weight_decay = 0.1});
    for (const StoreRole role :
         {StoreRole::kWeights, StoreRole::kFirstMoments, StoreRole::kSecondMoments})
      CHECK_CLOSE(
          (View<const float, 1>(store.block(role).data(), Shape{std::ssize(store.block(role))})),
          (View<const double, 1>(exact.block(role).data(), Shape{std::ssize(exact.block(role))})),
          1e-6);
  }
}

}  // namespace
}  // namespace lvggt
