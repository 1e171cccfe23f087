// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/layer_norm.h"

#include <doctest/doctest.h>

#include <cmath>

#include "tests/reference/layer_norm.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Expected {
  Tensor<double, 2> y;
  Tensor<double, 2> limit;  // times u
};

// In units of u = 2^-24: the mean of C values of size M is off by at most (C/4 + 2) M / C per
// partial sum of at least 4 lanes, less than (C/4 + 2) max|x|; so is every deviation, divided by
// the standard deviation s. The variance adds (C/4 + 6)/2 relative, the affine part 2.
Expected expected_of(View<const float, 2> x, View<const float, 1> gamma, View<const float, 1> beta,
                     double eps) {
  const Tensor<double, 2> wide = converted<double>(x);
  Expected expected{reference::layer_norm(wide, eps), Tensor<double, 2>(x.shape())};
  const auto [N, C] = x.shape();
  for (std::int64_t n = 0; n < N; ++n) {
    double mean = 0, variance = 0, largest = 0;
    for (std::int64_t c = 0; c < C; ++c) mean += wide(n, c) / static_cast<double>(C);
    for (std::int64_t c = 0; c < C; ++c) {
      variance += std::pow(wide(n, c) - mean, 2) / static_cast<double>(C);
      largest = std::max(largest, std::abs(wide(n, c)));
    }
    const double steps = static_cast<double>(C) / 4 + 2;
    for (std::int64_t c = 0; c < C; ++c) {
      const double normed = expected.y(n, c);
      double& y = expected.y(n, c);
      if (gamma) y *= gamma[c];
      if (beta) y += beta[c];
      expected.limit(n, c) =
          (gamma ? std::abs(gamma[c]) : 1.0) *
              (steps * largest / std::sqrt(variance + eps) + (steps / 2 + 6) * std::abs(normed)) +
          2 * std::abs(y);
    }
  }
  return expected;
}

}  // namespace

TEST_CASE("layer_norm_forward: agrees with the definition, with and without the affine part") {
  Context ctx(1);
  for_each_target([&] {
    for (std::int64_t C = 1; C <= 140; C += C < 36 ? 1 : 13) {
      CAPTURE(C);
      const auto gamma = random_tensor(Shape{C}, 2, 0.5f, 2), beta = random_tensor(Shape{C}, 3);
      const auto x = random_tensor(Shape{std::int64_t{5}, C}, 1, -3, 5);
      Tensor<float, 2> y(x.shape());
      layer_norm_forward(y, x, gamma, beta, 1e-5f, ctx);
      const Expected affine = expected_of(x, gamma, beta, 1e-5f);
      CHECK_CLOSE(y, affine.y, kUnit, affine.limit.view());
      layer_norm_forward(y, x, {}, {}, 1e-6f, ctx);
      const Expected plain = expected_of(x, {}, {}, 1e-6f);
      CHECK_CLOSE(y, plain.y, kUnit, plain.limit.view());
    }
  });
}

TEST_CASE("layer_norm_forward: the model's widths, strided views, in place, no rows") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t C : {64, 384, 1024, 2048}) {
      CAPTURE(C);
      for (const std::int64_t N : {0, 1, 37}) {
        const auto gamma = random_tensor(Shape{C}, 2, 0.5f, 2), beta = random_tensor(Shape{C}, 3);
        const auto x = random_tensor(Shape{N, C}, 1, -3, 5);
        Strided<2> strided_x(x.view()), y(x.shape());
        layer_norm_forward(y.view(), strided_x.view(), gamma, beta, 1e-5f, ctx);
        const Expected expected = expected_of(x, gamma, beta, 1e-5f);
        CHECK_CLOSE(y.view(), expected.y, kUnit, expected.limit.view());
        CHECK(y.gaps_untouched());
        layer_norm_forward(strided_x.view(), strided_x.view(), gamma, beta, 1e-5f, ctx);
        CHECK_SAME_BITS(strided_x.view(), y.view());
      }
    }
  });
}

TEST_CASE("layer_norm_forward: a large common offset does not drown the variance") {
  // With E[x^2] - E[x]^2 the variance would be lost: 1e4^2 has a unit in the last place of 8.
  Context ctx(1);
  for_each_target([&] {
    const auto x = random_tensor(Shape{3, 1024}, 1, 9999, 10001);
    Tensor<float, 2> y(x.shape());
    layer_norm_forward(y, x, {}, {}, 1e-6f, ctx);
    CHECK_CLOSE(y, reference::layer_norm(in_double(x), 1e-6), 0.02);
  });
}

TEST_CASE(
    "layer_norm_forward: eps decides where the variance is small, and constant rows give beta") {
  Context ctx(1);
  for_each_target([&] {
    const auto x = random_tensor(Shape{2, 96}, 1, -1e-3f, 1e-3f);
    const auto beta = random_tensor(Shape{96}, 2);
    Tensor<float, 2> y(x.shape()), constant(Shape{1, 96});
    for (const float eps : {1e-5f, 1e-6f}) {
      layer_norm_forward(y, x, {}, beta, eps, ctx);
      const Expected expected = expected_of(x, {}, beta, eps);
      CHECK_CLOSE(y, expected.y, kUnit, expected.limit.view());
    }
    layer_norm_forward(constant, constant, {}, beta, 1e-6f, ctx);
    CHECK_SAME_BITS(constant[0], beta);
  });
}

TEST_CASE("layer_norm_forward: heads of a qkv slice are the same as rows of their own") {
  Context ctx(2);
  const auto qkv = random_tensor(Shape{7, 9, 64}, 1);  // 3 times 3 heads
  const auto gamma = random_tensor(Shape{64}, 2), beta = random_tensor(Shape{64}, 3);
  for_each_target([&] {
    const View<const float, 3> k = qkv.view().narrow(1, 3, 6);
    Tensor<float, 3> y(k.shape());
    layer_norm_forward(y, k, gamma, beta, 1e-5f, ctx);
    for (std::int64_t n = 0; n < 7; ++n) {
      Tensor<float, 2> rows(Shape{3, 64});
      layer_norm_forward(rows, k[n], gamma, beta, 1e-5f, ctx);
      CHECK_SAME_BITS(y[n], rows);
    }
  });
}

TEST_CASE("layer_norm_forward: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{203, 1024}, 1);
  Tensor<float, 2> y1(x.shape()), y8(x.shape());
  layer_norm_forward(y1, x, {}, {}, 1e-5f, one);
  layer_norm_forward(y8, x, {}, {}, 1e-5f, eight);
  CHECK_SAME_BITS(y8, y1);
}

TEST_CASE("layer_norm_forward: wrong shapes are refused, both are named") {
  Context ctx(1);
  Tensor<float, 2> x(Shape{2, 8}), y(Shape{2, 9});
  const Tensor<float, 1> gamma(Shape{9});
  CHECK_THROWS_WITH_AS(layer_norm_forward(y, x, {}, {}, 1e-5f, ctx), doctest::Contains("[2,1,9]"),
                       Error);
  CHECK_THROWS_WITH_AS(layer_norm_forward(x, x, gamma, {}, 1e-5f, ctx), doctest::Contains("[9]"),
                       Error);
}
