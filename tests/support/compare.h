// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <bit>
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <utility>

#include "lvggt/core/tensor.h"

namespace lvggt::test {

// Unit roundoff of float: one operation is off by at most this factor.
inline constexpr double kUnit = 0x1p-24;

struct Comparison {
  bool ok = true;
  std::string message;  // the worst element: index, actual, expected, limit
};

// Index of the n-th element in row-major order.
template <int R>
Shape<R> unflatten(std::int64_t n, const Shape<R>& shape) {
  Shape<R> index;
  for (int axis = R - 1; axis >= 0; --axis) {
    index[axis] = n % shape[axis];
    n /= shape[axis];
  }
  return index;
}

template <class T, int R>
T& element(View<T, R> x, const Shape<R>& index) {
  std::int64_t offset = 0;
  for (int axis = 0; axis < R; ++axis) offset += index[axis] * x.stride(axis);
  return x.data()[offset];
}

// Fails unless the shapes agree and |actual - expected| <= limit(index, expected) everywhere. Equal
// values, infinities too, agree; a NaN on either side fails, and so does a difference with a NaN
// limit.
template <class A, class E, int R, class Limit>
Comparison compare_by(View<A, R> actual, View<E, R> expected, const Limit& limit) {
  if (actual.shape() != expected.shape())
    return {false, concat("shape ", actual.shape(), ", expected ", expected.shape())};
  Comparison result;
  double worst = -1;
  for (std::int64_t n = 0; n < actual.size(); ++n) {
    const Shape<R> index = unflatten(n, actual.shape());
    const double a = element(actual, index), e = element(expected, index);
    const double allowed = limit(index, e);
    const double error = a == e ? 0.0 : std::abs(a - e);
    const bool ok = a == e || error <= allowed;
    double badness = error == 0 ? 0.0 : error / allowed;
    if (!ok && !(badness <= std::numeric_limits<double>::max()))
      badness = std::numeric_limits<double>::infinity();
    if (badness > worst) {
      worst = badness;
      result.message = concat("worst at ", index, ": ", a, ", expected ", e, ", off by ", error,
                              ", limit ", allowed);
    }
    result.ok = result.ok && ok;
  }
  return result;
}

// limit = absolute + relative * |expected|
template <class A, class E, int R>
Comparison compare(View<A, R> actual, View<E, R> expected, double absolute, double relative = 0) {
  return compare_by(actual, expected,
                    [=](const Shape<R>&, double e) { return absolute + relative * std::abs(e); });
}

// One limit an element: factor * limits, for bounds that follow from the norms of the operands.
template <class A, class E, class L, int R>
Comparison compare(View<A, R> actual, View<E, R> expected, double factor, View<L, R> limits) {
  if (limits.shape() != expected.shape())
    return {false, concat("limits are ", limits.shape(), ", expected ", expected.shape())};
  return compare_by(actual, expected, [=](const Shape<R>& index, double) {
    return factor * static_cast<double>(element(limits, index));
  });
}

// The same bits everywhere.
template <class A, class E, int R>
Comparison compare_bits(View<A, R> actual, View<E, R> expected) {
  if (actual.shape() != expected.shape())
    return {false, concat("shape ", actual.shape(), ", expected ", expected.shape())};
  for (std::int64_t n = 0; n < actual.size(); ++n) {
    const Shape<R> index = unflatten(n, actual.shape());
    const float a = element(actual, index), e = element(expected, index);
    if (std::bit_cast<std::uint32_t>(a) != std::bit_cast<std::uint32_t>(e))
      return {false, concat("first difference at ", index, ": ", a, ", expected ", e)};
  }
  return {};
}

// Tensors compare as their views.
template <class T, int R>
View<T, R> as_view(View<T, R> x) {
  return x;
}
template <class T, int R>
View<const T, R> as_view(const Tensor<T, R>& x) {
  return x.view();
}

}  // namespace lvggt::test

// CHECK_CLOSE(actual, expected, absolute [, relative]) and CHECK_CLOSE(actual, expected, factor,
// limits)
#define CHECK_CLOSE(actual, expected, ...)                                              \
  do {                                                                                  \
    const ::lvggt::test::Comparison comparison_ = ::lvggt::test::compare(               \
        ::lvggt::test::as_view(actual), ::lvggt::test::as_view(expected), __VA_ARGS__); \
    CHECK_MESSAGE(comparison_.ok, #actual ": ", comparison_.message);                   \
  } while (false)

#define CHECK_SAME_BITS(actual, expected)                                      \
  do {                                                                         \
    const ::lvggt::test::Comparison comparison_ = ::lvggt::test::compare_bits( \
        ::lvggt::test::as_view(actual), ::lvggt::test::as_view(expected));     \
    CHECK_MESSAGE(comparison_.ok, #actual ": ", comparison_.message);          \
  } while (false)
