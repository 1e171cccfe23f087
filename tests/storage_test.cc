// SPDX-License-Identifier: Apache-2.0
// Products with weights in narrow storage: the same as with the rounded weights, exactly or to
// float rounding.
#include "lvggt/core/storage.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "lvggt/core/float16.h"
#include "lvggt/kernels/conv2d.h"
#include "lvggt/kernels/conv_transpose2d.h"
#include "lvggt/kernels/linear.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

float rounded(float x, Storage storage) {
  return storage == Storage::kBf16 ? to_float(to_bfloat16(x)) : to_float(to_float16(x));
}

template <int R>
Tensor<float, R> rounded(const Tensor<float, R>& x, Storage storage) {
  Tensor<float, R> y = x.clone();
  for (std::int64_t i = 0; i < y.size(); ++i) y.data()[i] = rounded(y.data()[i], storage);
  return y;
}

// The int8 product by its definition: both sides rounded to integers, multiplied and summed
// exactly.
Tensor<double, 2> int8_product(const Tensor<float, 2>& x, const Tensor<float, 2>& w) {
  const std::int64_t M = x.extent(0), N = w.extent(0), K = x.extent(1);
  const auto quantize = [K](View<const float, 1> row, int top, std::vector<double>& q) {
    float largest = 0;
    for (std::int64_t k = 0; k < K; ++k) largest = std::max(largest, std::abs(row[k]));
    const float inverse = top == kInt8WeightMax ? 1 / (largest / static_cast<float>(top))
                                                : static_cast<float>(top) / largest;
    for (std::int64_t k = 0; k < K; ++k)
      q[static_cast<std::size_t>(k)] = largest > 0 ? std::nearbyint(row[k] * inverse) : 0;
    return static_cast<double>(largest) / top;
  };
  Tensor<double, 2> y(Shape{M, N});
  std::vector<double> qx(static_cast<std::size_t>(K)), qw(static_cast<std::size_t>(K));
  for (std::int64_t m = 0; m < M; ++m) {
    const double x_scale = quantize(x.view()[m], 127, qx);
    for (std::int64_t n = 0; n < N; ++n) {
      const double w_scale = quantize(w.view()[n], kInt8WeightMax, qw);
      double sum = 0;
      for (std::size_t k = 0; k < qx.size(); ++k) sum += qx[k] * qw[k];
      y(m, n) = sum * x_scale * w_scale;
    }
  }
  return y;
}

}  // namespace

TEST_CASE("storage: bf16 and f16 weights give the product with the rounded weights, bit for bit") {
  Context ctx(2);
  for_each_target([&] {
    for (const Storage storage : {Storage::kBf16, Storage::kF16}) {
      for (const Shape<3> size :
           {Shape{1, 1, 1}, Shape{5, 17, 30}, Shape{99, 70, 300}, Shape{8, 400, 1030}}) {
        CAPTURE(size[2]);
        const auto x = random_tensor(Shape{size[0], size[2]}, 1),
                   w = random_tensor(Shape{size[1], size[2]}, 2);
        Tensor<float, 2> narrow(Shape{size[0], size[1]}), wide(narrow.shape());
        linear_forward(narrow, x, pack_linear(w, storage), {}, ctx);
        linear_forward(wide, x, pack_linear(rounded(w, storage)), {}, ctx);
        CHECK_SAME_BITS(narrow, wide);
      }
      const auto x = random_tensor(Shape{1, 9, 11, 40}, 3),
                 w = random_tensor(Shape{35, 40, 3, 3}, 4);
      Tensor<float, 4> narrow(Shape{1, 9, 11, 35}), wide(narrow.shape());
      conv2d_forward(narrow, x, pack_conv2d(w, 1, 1, storage), {}, ctx);
      conv2d_forward(wide, x, pack_conv2d(rounded(w, storage), 1, 1), {}, ctx);
      CHECK_SAME_BITS(narrow, wide);
      const auto t = random_tensor(Shape{40, 35, 2, 2}, 5);
      Tensor<float, 4> narrow_t(Shape{1, 18, 22, 35}), wide_t(narrow_t.shape());
      conv_transpose2d_forward(narrow_t, x, pack_conv_transpose2d(t, storage), {}, ctx);
      conv_transpose2d_forward(wide_t, x, pack_conv_transpose2d(rounded(t, storage)), {}, ctx);
      CHECK_SAME_BITS(narrow_t, wide_t);
    }
  });
}

TEST_CASE("storage: int8 products are exact sums of the rounded operands") {
  Context ctx(2);
  for_each_target([&] {
    for (const Shape<3> size : {Shape{1, 1, 1}, Shape{3, 17, 7}, Shape{9, 50, 64},
                                Shape{101, 33, 130}, Shape{5, 400, 1100}}) {
      CAPTURE(size[2]);
      const auto x = random_tensor(Shape{size[0], size[2]}, 1),
                 w = random_tensor(Shape{size[1], size[2]}, 2);
      Tensor<float, 2> y(Shape{size[0], size[1]});
      linear_forward(y, x, pack_linear(w, Storage::kI8), {}, ctx);
      // The integer sum is exact; converting and scaling round four times.
      CHECK_CLOSE(y, int8_product(x, w), 0, 4 * kUnit);
    }
  });
}

TEST_CASE("storage: int8 products of the largest operands do not saturate") {
  Context ctx(1);
  for_each_target([&] {
    Tensor<float, 2> x(Shape{2, 4096}), w(Shape{16, 4096}), y(Shape{2, 16});
    for (std::int64_t k = 0; k < 4096; ++k) {
      x(0, k) = 1;
      x(1, k) = -1;
      for (std::int64_t n = 0; n < 16; ++n) w(n, k) = n % 2 ? -1.0f : 1.0f;
    }
    linear_forward(y, x, pack_linear(w, Storage::kI8), {}, ctx);
    for (std::int64_t n = 0; n < 16; ++n) {
      CHECK(y(0, n) == doctest::Approx(n % 2 ? -4096 : 4096).epsilon(1e-6));
      CHECK(y(1, n) == doctest::Approx(n % 2 ? 4096 : -4096).epsilon(1e-6));
    }
  });
}

TEST_CASE("storage: int8 products keep epilogues, zero rows, and the NaN of a row") {
  Context ctx(1);
  for_each_target([&] {
    auto x = random_tensor(Shape{11, 24}, 1);
    const auto w = random_tensor(Shape{21, 24}, 2);
    const auto bias = random_tensor(Shape{21}, 3), gamma = random_tensor(Shape{21}, 4);
    const auto residual = random_tensor(Shape{11, 21}, 5);
    for (std::int64_t k = 0; k < 24; ++k) x(4, k) = 0;
    x(6, 23) = std::numeric_limits<float>::quiet_NaN();
    x(7, 0) = std::numeric_limits<float>::infinity();
    const PackedMatrix packed = pack_linear(w, Storage::kI8);
    Tensor<float, 2> plain(Shape{11, 21}), fused(plain.shape());
    linear_forward(plain, x, packed, {}, ctx);
    linear_forward(
        fused, x, packed,
        {.bias = bias, .activation = Activation::kRelu, .gamma = gamma, .residual = residual}, ctx);
    for (std::int64_t m = 0; m < 11; ++m) {
      for (std::int64_t n = 0; n < 21; ++n) {
        if (m == 6 || m == 7) {
          CHECK(std::isnan(plain(m, n)));
          continue;
        }
        if (m == 4) CHECK(plain(m, n) == 0);
        const float expected = residual(m, n) + gamma(n) * std::max(0.0f, plain(m, n) + bias(n));
        CHECK(fused(m, n) == doctest::Approx(expected).epsilon(1e-6));
      }
    }
  });
}

TEST_CASE(
    "storage: int8 products are the same bits for 1 and 8 threads and on every instruction set") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{301, 200}, 1), w = random_tensor(Shape{410, 200}, 2);
  const PackedMatrix packed = pack_linear(w, Storage::kI8);
  Tensor<float, 2> expected(Shape{301, 410}), y(expected.shape());
  linear_forward(expected, x, packed, {}, one);
  linear_forward(y, x, packed, {}, eight);
  CHECK_SAME_BITS(y, expected);
  for_each_target([&] {
    linear_forward(y, x, packed, {}, eight);
    CHECK_SAME_BITS(y, expected);
  });
}

TEST_CASE("storage: a name that is none and int8 for a convolution are refused by name") {
  CHECK(parse_storage("bf16", "--weights-storage") == Storage::kBf16);
  CHECK_THROWS_WITH_AS(parse_storage("int4", "--weights-storage"),
                       doctest::Contains("--weights-storage: 'int4'"), Error);
  const Tensor<float, 4> w(Shape{4, 4, 3, 3});
  CHECK_THROWS_WITH_AS(pack_conv2d(w, 1, 1, Storage::kI8), doctest::Contains("int8"), Error);
}
