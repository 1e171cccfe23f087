// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <complex>
#include <cstdint>

#include "lvggt/core/tensor.h"
#include "tests/support/random.h"

namespace lvggt::test {

using Complex = std::complex<double>;

template <class T, int R>
Tensor<Complex, R> in_complex(const Tensor<T, R>& x) {
  Tensor<Complex, R> y(x.shape());
  for (std::int64_t i = 0; i < x.size(); ++i)
    y.data()[i] = Complex(static_cast<double>(x.data()[i]), 0);
  return y;
}

// <dy, f(x)>, the loss that every backward pass is tested with.
template <class T, int R, class U>
T weighted_sum(const Tensor<U, R>& dy, const Tensor<T, R>& y) {
  LVGGT_CHECK(dy.shape() == y.shape(), "weighted_sum: ", dy.shape(), " and ", y.shape());
  T sum = 0;
  for (std::int64_t i = 0; i < y.size(); ++i)
    sum += static_cast<double>(dy.data()[i]) * y.data()[i];
  return sum;
}

// The gradient of loss(x), a complex function, by the complex step: Im loss(x + ih e) / h is exact
// to rounding, because nothing is subtracted.
template <class T, int R, class Loss>
Tensor<double, R> complex_step(const Tensor<T, R>& x, const Loss& loss) {
  constexpr double kStep = 1e-50;
  Tensor<Complex, R> point = in_complex(x);
  Tensor<double, R> gradient(x.shape());
  for (std::int64_t i = 0; i < x.size(); ++i) {
    const Complex value = point.data()[i];
    point.data()[i] = value + Complex(0, kStep);
    gradient.data()[i] = Complex(loss(point)).imag() / kStep;
    point.data()[i] = value;
  }
  return gradient;
}

// The gradient of loss(x), a function of doubles, by central differences: for what has no complex
// form (erf). With a step of 1e-5 both errors, step^2 and 1e-16 / step, are near 1e-10.
template <class T, int R, class Loss>
Tensor<double, R> central_differences(const Tensor<T, R>& x, const Loss& loss) {
  constexpr double kStep = 1e-5;
  Tensor<double, R> point = in_double(x), gradient(x.shape());
  for (std::int64_t i = 0; i < x.size(); ++i) {
    const double value = point.data()[i];
    point.data()[i] = value + kStep;
    const double above = loss(point);
    point.data()[i] = value - kStep;
    gradient.data()[i] = (above - loss(point)) / (2 * kStep);
    point.data()[i] = value;
  }
  return gradient;
}

}  // namespace lvggt::test
