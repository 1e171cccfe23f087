// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "lvggt/kernels/epilogue.h"
#include "tests/reference/activation.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"

namespace lvggt::test {

// Which parts of an epilogue a case has.
struct ProductParts {
  bool bias = false;
  Activation activation = Activation::kNone;
  bool gamma = false;
  bool residual = false;
};

// The parts' vectors for N output channels.
struct ProductOperands {
  ProductOperands(const ProductParts& p, std::int64_t N)
      : parts(p), bias(random_tensor(Shape{N}, 3)), gamma(random_tensor(Shape{N}, 4)) {}

  // Without the residual.
  template <int R>
  Epilogue<R> epilogue() const {
    Epilogue<R> epilogue;
    epilogue.activation = parts.activation;
    if (parts.bias) epilogue.bias = bias;
    if (parts.gamma) epilogue.gamma = gamma;
    return epilogue;
  }

  ProductParts parts;
  Tensor<float, 1> bias, gamma;
};

template <int R>
Tensor<double, R> magnitudes(const Tensor<float, R>& x) {
  Tensor<double, R> y = in_double(x);
  for (std::int64_t i = 0; i < y.size(); ++i) y.data()[i] = std::abs(y.data()[i]);
  return y;
}

template <int R>
struct ExpectedProduct {
  Tensor<double, R> y;
  Tensor<double, R> limit;
};

// Applies the epilogue in double. `sum` is the exact product and `sum_of_magnitudes` the product of
// the operands' magnitudes: a sum of K products in any order is off by at most K u times that, the
// bias adds a rounding. No activation is steeper than 1.13 (GELU, SiLU 1.1), each is itself good
// to 1.8e-7 max(1, |y|), and gamma and the residual round once more each. The last axis is the
// channels'.
template <int R>
ExpectedProduct<R> expected_product(Tensor<double, R> sum,
                                    const Tensor<double, R>& sum_of_magnitudes, std::int64_t K,
                                    const ProductOperands& operands,
                                    const Tensor<float, R>& residual) {
  const ProductParts& parts = operands.parts;
  const std::int64_t N = operands.bias.extent(0);
  ExpectedProduct<R> expected{std::move(sum), Tensor<double, R>(sum_of_magnitudes.shape())};
  for (std::int64_t i = 0; i < expected.y.size(); ++i) {
    double& y = expected.y.data()[i];
    double& limit = expected.limit.data()[i];
    limit = static_cast<double>(K) * kUnit * sum_of_magnitudes.data()[i];
    if (parts.bias) {
      y += operands.bias[i % N];
      limit += kUnit * (sum_of_magnitudes.data()[i] + 2 * std::abs(operands.bias[i % N]));
    }
    if (parts.activation != Activation::kNone) {
      limit = 1.13 * limit + 1.8e-7 * std::max(1.0, std::abs(y));
      y = reference::activation(y, parts.activation);
    }
    if (parts.gamma) {
      const double gamma = operands.gamma[i % N];
      y *= gamma;
      limit = limit * std::abs(gamma) + kUnit * std::abs(y);
    }
    if (parts.residual) {
      y += residual.data()[i];
      limit += kUnit * (std::abs(y) + limit);
    }
  }
  return expected;
}

}  // namespace lvggt::test
