// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/batch_norm2d.h"

#include <doctest/doctest.h>

#include "tests/reference/batch_norm2d.h"
#include "tests/reference/conv2d.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

Tensor<double, 4> conv_with_bias(const Tensor<float, 4>& x, const Tensor<float, 4>& w,
                                 const Tensor<float, 1>& bias) {
  Tensor<double, 4> y = reference::conv2d(in_double(x), in_double(w), 1, 1);
  for (std::int64_t i = 0; i < y.size(); ++i) y.data()[i] += bias[i % bias.extent(0)];
  return y;
}

}  // namespace

TEST_CASE(
    "batch_norm2d_fold: the folded convolution is the convolution followed by the batch norm") {
  const auto x = random_tensor(Shape{2, 5, 4, 3}, 1);
  auto w = random_tensor(Shape{7, 3, 3, 3}, 2);
  auto bias = random_tensor(Shape{7}, 3);
  const auto gamma = random_tensor(Shape{7}, 4), beta = random_tensor(Shape{7}, 5);
  const auto mean = random_tensor(Shape{7}, 6), variance = random_tensor(Shape{7}, 7, 0.001f, 2);
  const Tensor<double, 4> expected =
      reference::batch_norm2d(conv_with_bias(x, w, bias), in_double(gamma), in_double(beta),
                              in_double(mean), in_double(variance), static_cast<double>(1e-5f));
  batch_norm2d_fold(w, bias, gamma, beta, mean, variance, 1e-5f);
  // Each of the 27 weights (times |x| < 1) and the bias were rounded once.
  Tensor<double, 4> limit(expected.shape());
  for (std::int64_t i = 0; i < limit.size(); ++i) {
    limit.data()[i] = std::abs(bias[i % 7]);
    for (std::int64_t k = 0; k < 27; ++k) limit.data()[i] += std::abs(w.data()[i % 7 * 27 + k]);
  }
  CHECK_CLOSE(conv_with_bias(x, w, bias), expected, kUnit, limit.view());
}

TEST_CASE("batch_norm2d_fold: a vector of another length is refused by its shape") {
  Tensor<float, 4> w(Shape{7, 3, 3, 3});
  Tensor<float, 1> c7(Shape{7}), c6(Shape{6});
  CHECK_THROWS_WITH_AS(batch_norm2d_fold(w, c7, c7, c6, c7, c7, 1e-5f),
                       doctest::Contains("[7,3,3,3] but a vector of its channels is [6]"), Error);
}
