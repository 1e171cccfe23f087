// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>

#include "lvggt/kernels/layer_norm.h"
#include "tests/reference/layer_norm.h"
#include "tests/support/compare.h"
#include "tests/support/golden.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

constexpr float kEps = 1e-5f;

struct Layer {
  Tensor<float, 2> x, dy;
  Tensor<float, 1> gamma, beta;
  Layer(std::int64_t N, std::int64_t C)
      : x(random_tensor(Shape{N, C}, 1, -1, 2)),
        dy(random_tensor(Shape{N, C}, 2)),
        gamma(random_tensor(Shape{C}, 3, -1, 2)),
        beta(random_tensor(Shape{C}, 4)) {}
};

Complex loss(const Layer& layer, const Tensor<Complex, 2>& x, const Tensor<Complex, 1>& gamma,
             const Tensor<Complex, 1>& beta) {
  Tensor<Complex, 2> y = reference::layer_norm(x, Complex(static_cast<double>(kEps)));
  for (std::int64_t i = 0; i < y.size(); ++i)
    y.data()[i] = y.data()[i] * gamma[i % y.extent(1)] + beta[i % y.extent(1)];
  return weighted_sum(layer.dy, y);
}

}  // namespace

TEST_CASE("layer_norm_backward: agrees with the complex step, with and without affine part") {
  Context ctx(2);
  for (const auto& size :
       {Shape{1, 1}, Shape{3, 2}, Shape{5, 7}, Shape{2, 16}, Shape{4, 35}, Shape{1, 70}}) {
    CAPTURE(size);
    const Layer layer(size[0], size[1]);
    const auto x = in_complex(layer.x);
    const auto gamma = in_complex(layer.gamma), beta = in_complex(layer.beta);
    Tensor<Complex, 1> ones(gamma.shape());
    for (std::int64_t c = 0; c < ones.size(); ++c) ones[c] = 1;
    const auto dx_affine =
        complex_step(layer.x, [&](const auto& v) { return loss(layer, v, gamma, beta); });
    const auto dx_plain =
        complex_step(layer.x, [&](const auto& v) { return loss(layer, v, ones, beta); });
    const auto dg =
        complex_step(layer.gamma, [&](const auto& v) { return loss(layer, x, v, beta); });
    const auto db =
        complex_step(layer.beta, [&](const auto& v) { return loss(layer, x, gamma, v); });
    for_each_target([&] {
      Strided<2> sx(layer.x.view()), dy(layer.dy.view()), dx(layer.x.shape());
      Tensor<float, 2> y(layer.x.shape());
      Tensor<float, 1> mean(Shape{layer.x.extent(0)}), rstd(mean.shape()),
          dgamma(layer.gamma.shape()), dbeta(layer.beta.shape());
      layer_norm_forward(y, mean, rstd, sx.view(), layer.gamma, layer.beta, kEps, ctx);
      dgamma[0] = dbeta[0] = 3;  // accumulate
      layer_norm_backward(dx.view(), dgamma, dbeta, dy.view(), mean, rstd, sx.view(), layer.gamma,
                          ctx);
      dgamma[0] -= 3;
      dbeta[0] -= 3;
      // Two values may lie close together: then rstd magnifies the rounding of x - mean.
      const double limit = 5e-6 * largest_magnitude(converted<float>(rstd.view()));
      CHECK_CLOSE(dx.view(), dx_affine, limit);
      CHECK_CLOSE(dgamma, dg, 1e-5);
      CHECK_CLOSE(dbeta, db, 1e-6);
      CHECK(dx.gaps_untouched());
      layer_norm_backward(dx.view(), {}, {}, dy.view(), mean, rstd, sx.view(), {}, ctx);
      CHECK_CLOSE(dx.view(), dx_plain, limit);
      layer_norm_backward(dy.view(), {}, {}, dy.view(), mean, rstd, sx.view(), {}, ctx);
      CHECK_SAME_BITS(dy.view(), dx.view());  // dx may be dy
    });
  }
}

TEST_CASE("layer_norm_forward: the output is the same with and without kept statistics") {
  Context ctx(2);
  const Layer layer(37, 130);
  for_each_target([&] {
    Tensor<float, 2> y(layer.x.shape()), kept(layer.x.shape());
    Tensor<float, 1> mean(Shape{37}), rstd(Shape{37});
    layer_norm_forward(y, layer.x, layer.gamma, layer.beta, kEps, ctx);
    layer_norm_forward(kept, mean, rstd, layer.x, layer.gamma, layer.beta, kEps, ctx);
    CHECK_SAME_BITS(kept, y);
    Tensor<float, 2> again(layer.x.shape());
    for (std::int64_t n = 0; n < 37; ++n)
      for (std::int64_t c = 0; c < 130; ++c)
        again(n, c) = layer.gamma[c] * (layer.x(n, c) - mean[n]) * rstd[n] + layer.beta[c];
    CHECK_CLOSE(again, y, 1e-6);
  });
}

TEST_CASE("layer_norm_backward D30: a constant row has a finite gradient that sums to zero") {
  Context ctx(1);
  for_each_target([&] {
    for (const float value : {0.0f, -7.25f, 1e6f}) {
      Layer layer(2, 48);
      for (std::int64_t i = 0; i < layer.x.size(); ++i) layer.x.data()[i] = value;
      Tensor<float, 2> y(layer.x.shape()), dx(layer.x.shape());
      Tensor<float, 1> mean(Shape{2}), rstd(Shape{2}), dgamma(Shape{48}), dbeta(Shape{48});
      layer_norm_forward(y, mean, rstd, layer.x, layer.gamma, layer.beta, kEps, ctx);
      layer_norm_backward(dx, dgamma, dbeta, layer.dy, mean, rstd, layer.x, layer.gamma, ctx);
      CHECK(rstd[0] == doctest::Approx(1 / std::sqrt(kEps)));
      double sum = 0, size = 0;
      for (std::int64_t c = 0; c < 48; ++c) {
        CHECK(y(1, c) == layer.beta[c]);
        CHECK(dgamma[c] == 0);
        sum += dx(1, c);
        size += std::abs(dx(1, c));
      }
      CHECK(std::isfinite(size));
      CHECK(std::abs(sum) < 1e-5 * size);
    }
  });
}

TEST_CASE("layer_norm_backward: 1 and 8 threads give the same bits, more rows than sums") {
  Context one(1), eight(8);
  const Layer layer(9001, 24);
  Tensor<float, 2> y(layer.x.shape()), dx1(y.shape()), dx8(y.shape());
  Tensor<float, 1> mean(Shape{9001}), rstd(Shape{9001}), g1(Shape{24}), g8(Shape{24}),
      b1(Shape{24}), b8(Shape{24});
  layer_norm_forward(y, mean, rstd, layer.x, layer.gamma, layer.beta, kEps, eight);
  layer_norm_backward(dx1, g1, b1, layer.dy, mean, rstd, layer.x, layer.gamma, one);
  layer_norm_backward(dx8, g8, b8, layer.dy, mean, rstd, layer.x, layer.gamma, eight);
  CHECK_SAME_BITS(dx8, dx1);
  CHECK_SAME_BITS(g8, g1);
  CHECK_SAME_BITS(b8, b1);
  double sum = 0;
  for (std::int64_t n = 0; n < 9001; ++n) sum += layer.dy(n, 5);
  CHECK(b1[5] == doctest::Approx(sum).epsilon(1e-4));
}

TEST_CASE("layer_norm_backward: wrong shapes are refused by name") {
  Context ctx(1);
  const Layer layer(2, 8);
  Tensor<float, 2> dx(Shape{2, 8}), wide(Shape{2, 9});
  Tensor<float, 1> rows(Shape{2}), three(Shape{3}), nine(Shape{9});
  CHECK_THROWS_WITH_AS(layer_norm_backward(wide, {}, {}, layer.dy, rows, rows, layer.x, {}, ctx),
                       doctest::Contains("[2,9]"), Error);
  CHECK_THROWS_WITH_AS(layer_norm_backward(dx, {}, {}, layer.dy, three, rows, layer.x, {}, ctx),
                       doctest::Contains("[3]"), Error);
  CHECK_THROWS_WITH_AS(layer_norm_backward(dx, nine, {}, layer.dy, rows, rows, layer.x, {}, ctx),
                       doctest::Contains("[9]"), Error);
  CHECK_THROWS_WITH_AS(layer_norm_forward(dx, rows, three, layer.x, {}, {}, kEps, ctx),
                       doctest::Contains("[3]"), Error);
}
