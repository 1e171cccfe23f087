// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/layer_scale.h"

#include <doctest/doctest.h>

#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

template <class T>
Tensor<T, 2> definition(const Tensor<T, 2>& x, const Tensor<T, 1>& gamma,
                        const Tensor<T, 2>& residual) {
  Tensor<T, 2> y(x.shape());
  for (std::int64_t n = 0; n < x.extent(0); ++n)
    for (std::int64_t c = 0; c < x.extent(1); ++c) y(n, c) = residual(n, c) + gamma[c] * x(n, c);
  return y;
}

}  // namespace

TEST_CASE("layer_scale: output and gradients agree with the definition, strided and in place") {
  Context ctx(2);
  for (const std::int64_t C : {1, 2, 7, 16, 35}) {
    CAPTURE(C);
    const auto x = random_tensor(Shape{std::int64_t{4}, C}, 1),
               residual = random_tensor(x.shape(), 2);
    const auto dy = random_tensor(x.shape(), 3);
    const auto gamma = random_tensor(Shape{C}, 4);
    const auto cx = in_complex(x), cr = in_complex(residual);
    const auto cg = in_complex(gamma);
    const auto expected_dx =
        complex_step(x, [&](const auto& v) { return weighted_sum(dy, definition(v, cg, cr)); });
    const auto expected_dgamma =
        complex_step(gamma, [&](const auto& v) { return weighted_sum(dy, definition(cx, v, cr)); });
    for_each_target([&] {
      Strided<2> sx(x.view()), sr(residual.view()), sdy(dy.view()), y(x.shape()), dx(x.shape());
      layer_scale_forward(y.view(), sx.view(), gamma, sr.view(), ctx);
      CHECK_CLOSE(y.view(), definition(in_double(x), in_double(gamma), in_double(residual)),
                  4 * kUnit);
      CHECK(y.gaps_untouched());
      Tensor<float, 1> dgamma(gamma.shape()), alone(gamma.shape());
      dgamma[0] = 3;  // accumulates
      layer_scale_backward(dx.view(), dgamma, sdy.view(), sx.view(), gamma, ctx);
      dgamma[0] -= 3;
      CHECK_CLOSE(dx.view(), expected_dx, 2 * kUnit);
      CHECK_CLOSE(dgamma, expected_dgamma, 16 * kUnit);
      CHECK(dx.gaps_untouched());
      layer_scale_backward({}, alone, sdy.view(), sx.view(), gamma, ctx);
      CHECK_CLOSE(alone, expected_dgamma, 16 * kUnit);
      layer_scale_backward(sdy.view(), {}, sdy.view(), sx.view(), gamma, ctx);
      CHECK_SAME_BITS(sdy.view(), dx.view());
      layer_scale_forward(sr.view(), sx.view(), gamma, sr.view(), ctx);
      CHECK_SAME_BITS(sr.view(), y.view());
    });
  }
}

TEST_CASE("layer_scale: 1 and 8 threads give the same bits, wrong shapes are refused by name") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{9001, 24}, 1), dy = random_tensor(x.shape(), 2);
  const auto gamma = random_tensor(Shape{24}, 3);
  Tensor<float, 2> dx1(x.shape()), dx8(x.shape()), wide(Shape{9001, 25});
  Tensor<float, 1> g1(Shape{24}), g8(Shape{24}), nine(Shape{9});
  layer_scale_backward(dx1, g1, dy, x, gamma, one);
  layer_scale_backward(dx8, g8, dy, x, gamma, eight);
  CHECK_SAME_BITS(dx8, dx1);
  CHECK_SAME_BITS(g8, g1);
  CHECK_THROWS_WITH_AS(layer_scale_forward(wide, x, gamma, x, one), doctest::Contains("[9001,25]"),
                       Error);
  CHECK_THROWS_WITH_AS(layer_scale_backward(dx1, nine, dy, x, gamma, one), doctest::Contains("[9]"),
                       Error);
  CHECK_THROWS_WITH_AS(layer_scale_backward(wide, g1, dy, x, gamma, one),
                       doctest::Contains("[9001,25]"), Error);
}
