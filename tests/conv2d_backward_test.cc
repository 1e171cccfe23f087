// SPDX-License-Identifier: Apache-2.0
#include "tests/reference/conv2d_backward.h"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>

#include "lvggt/kernels/conv2d.h"
#include "tests/reference/conv2d.h"
#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/product.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Kernel {
  std::int64_t k, stride, padding;
};
// All that the model uses.
constexpr Kernel kKernels[] = {{1, 1, 0}, {3, 1, 1}, {3, 2, 1}, {2, 2, 0}, {14, 14, 0}};

struct Size {
  std::int64_t B, H, W, Cin, Cout;
};

struct Operands {
  Tensor<float, 4> x, w, dy;
};
Operands operands(const Kernel& kernel, const Size& s) {
  return {random_tensor(Shape{s.B, s.H, s.W, s.Cin}, 1),
          random_tensor(Shape{s.Cout, s.Cin, kernel.k, kernel.k}, 2),
          random_tensor(Shape{s.B, conv2d_extent(s.H, kernel.k, kernel.stride, kernel.padding),
                              conv2d_extent(s.W, kernel.k, kernel.stride, kernel.padding), s.Cout},
                        3)};
}

// A sum of n products in any order is off by at most n u times the sum of their magnitudes; adding
// it to what was there rounds once more.
void check_against(const Operands& in, const Kernel& kernel,
                   const reference::Conv2dGradients<double>& expected, Context& ctx) {
  const reference::Conv2dGradients<double> sizes = reference::conv2d_backward(
      magnitudes(in.dy), magnitudes(in.x), magnitudes(in.w), kernel.stride, kernel.padding);
  const double taps = static_cast<double>(kernel.k * kernel.k * in.w.extent(0));
  const double pixels =
      static_cast<double>(in.dy.extent(0) * in.dy.extent(1) * in.dy.extent(2)) + 2;
  Strided<4> x(in.x.view()), dy(in.dy.view()), dx(in.x.shape());
  Tensor<float, 4> dweight(in.w.shape());
  Tensor<float, 1> dbias(Shape{in.w.extent(0)});
  for (int n = 1; n <= 2; ++n) {  // the parameters' gradients accumulate, the input's does not
    conv2d_backward(dx.view(), dweight, dbias, dy.view(), x.view(), in.w, kernel.stride,
                    kernel.padding, ctx);
    CHECK_CLOSE(dx.view(), expected.dx, taps * kUnit, sizes.dx.view());
    for (float* p = dweight.data(); p != dweight.data() + dweight.size(); ++p) *p /= n;
    for (float* p = dbias.data(); p != dbias.data() + dbias.size(); ++p) *p /= n;
    CHECK_CLOSE(dweight, expected.dweight, pixels * kUnit, sizes.dweight.view());
    CHECK_CLOSE(dbias, expected.dbias, pixels * kUnit, sizes.dbias.view());
  }
  CHECK(dx.gaps_untouched());
}

void check(const Kernel& kernel, const Size& size, Context& ctx) {
  CAPTURE(kernel.k);
  CAPTURE(kernel.stride);
  CAPTURE(size.H);
  CAPTURE(size.W);
  CAPTURE(size.Cin);
  CAPTURE(size.Cout);
  const Operands in = operands(kernel, size);
  check_against(in, kernel,
                reference::conv2d_backward(in_double(in.dy), in_double(in.x), in_double(in.w),
                                           kernel.stride, kernel.padding),
                ctx);
}

}  // namespace

TEST_CASE(
    "conv2d_backward: dx and dweight agree with the complex step, every kernel of the model") {
  Context ctx(2);
  for (const Kernel& kernel : kKernels) {
    const std::int64_t unit = kernel.k == 14 ? 14 : 1;
    for (const Size& size : {Size{1, 1, 1, 2, 3}, Size{2, 5, 4, 3, 2}, Size{1, 4, 7, 2, 3}}) {
      if (unit == 14 && size.H > 1) continue;
      if (size.H + 2 * kernel.padding < kernel.k && unit == 1) continue;
      CAPTURE(kernel.k);
      CAPTURE(kernel.stride);
      CAPTURE(size.H);
      const Operands in =
          operands(kernel, {size.B, size.H * unit, size.W * unit, size.Cin, size.Cout});
      const auto loss = [&](const Tensor<Complex, 4>& x, const Tensor<Complex, 4>& w) {
        return weighted_sum(in.dy, reference::conv2d(x, w, kernel.stride, kernel.padding));
      };
      const Tensor<Complex, 4> x = in_complex(in.x), w = in_complex(in.w);
      reference::Conv2dGradients<double> expected{
          complex_step(in.x, [&](const Tensor<Complex, 4>& v) { return loss(v, w); }),
          complex_step(in.w, [&](const Tensor<Complex, 4>& v) { return loss(x, v); }),
          Tensor<double, 1>(Shape{size.Cout})};
      for (std::int64_t i = 0; i < in.dy.size(); ++i)
        expected.dbias[i % size.Cout] += in.dy.data()[i];
      for_each_target([&] { check_against(in, kernel, expected, ctx); });
    }
  }
}

TEST_CASE("conv2d_backward: odd sizes, one pixel, one channel, channels across tiles and panels") {
  Context ctx(2);
  for_each_target([&] {
    for (const Kernel& kernel : kKernels) {
      if (kernel.k == 14) continue;
      for (const Size& size :
           {Size{1, 1, 1, 4, 3}, Size{2, 7, 9, 5, 6}, Size{2, 6, 8, 3, 17}, Size{1, 2, 5, 16, 16},
            Size{3, 3, 4, 19, 33}, Size{1, 5, 1, 1, 1}, Size{1, 2, 2, 25, 49}}) {
        if (size.H + 2 * kernel.padding < kernel.k || size.W + 2 * kernel.padding < kernel.k)
          continue;
        check(kernel, size, ctx);
      }
    }
    check({14, 14, 0}, {1, 28, 42, 3, 5}, ctx);
  });
}

TEST_CASE("conv2d_backward: maps that cross every block of pixels and of channels") {
  Context ctx(2);
  for_each_target([&] {
    check({3, 1, 1}, {1, 13, 131, 38, 20}, ctx);
    check({3, 1, 1}, {1, 3, 5, 20, 163}, ctx);
    check({3, 1, 1}, {2, 9, 67, 33, 3}, ctx);
    check({1, 1, 0}, {1, 9, 7, 70, 8}, ctx);
    check({3, 2, 1}, {2, 21, 37, 33, 20}, ctx);
    check({2, 2, 0}, {1, 37, 150, 10, 17}, ctx);
    check({1, 1, 0}, {1, 21, 37, 300, 50}, ctx);
  });
}

TEST_CASE("conv2d_backward: what is not wanted is not needed") {
  Context ctx(1);
  const Kernel kernel{3, 1, 1};
  const Operands in = operands(kernel, {1, 6, 7, 5, 4});
  Tensor<float, 4> dx(in.x.shape()), alone_dx(in.x.shape()), dw(in.w.shape()),
      alone_dw(in.w.shape());
  Tensor<float, 1> db(Shape{4}), alone_db(Shape{4});
  conv2d_backward(dx, dw, db, in.dy, in.x, in.w, 1, 1, ctx);
  conv2d_backward(alone_dx, {}, {}, in.dy, {}, in.w, 1, 1, ctx);
  conv2d_backward({}, alone_dw, {}, in.dy, in.x, in.w, 1, 1, ctx);
  conv2d_backward({}, {}, alone_db, in.dy, {}, in.w, 1, 1, ctx);
  CHECK_SAME_BITS(alone_dx, dx);
  CHECK_SAME_BITS(alone_dw, dw);
  CHECK_CLOSE(alone_db, db, 42 * kUnit);
}

TEST_CASE("conv2d_backward: dy and dx may be slices of concatenated maps, x a crop") {
  Context ctx(2);
  const auto wide = random_tensor(Shape{2, 9, 11, 8}, 1), w = random_tensor(Shape{5, 3, 3, 3}, 2);
  const auto joined_dy = random_tensor(Shape{2, 7, 7, 12}, 3);
  const View<const float, 4> x = wide.view().narrow(1, 1, 8).narrow(2, 2, 9).narrow(3, 4, 7);
  const View<const float, 4> dy = joined_dy.view().narrow(3, 4, 9);
  const Tensor<float, 4> crop = converted<float>(x), slice = converted<float>(dy);
  for_each_target([&] {
    Tensor<float, 4> joined_dx(wide.shape()), dx(crop.shape()), dw(w.shape()), alone_dw(w.shape());
    const View<float, 4> inside = joined_dx.view().narrow(1, 1, 8).narrow(2, 2, 9).narrow(3, 4, 7);
    conv2d_backward(inside, dw, {}, dy, x, w, 1, 1, ctx);
    conv2d_backward(dx, alone_dw, {}, slice, crop, w, 1, 1, ctx);
    CHECK_SAME_BITS(inside, dx);
    CHECK_SAME_BITS(dw, alone_dw);
    for (const std::int64_t c : {0, 3, 7}) CHECK(joined_dx(1, 4, 5, c) == 0);
  });
}

TEST_CASE("conv2d_backward: pixels that a stride leaves out get gradient 0") {
  Context ctx(1);
  const Operands in = operands({2, 2, 0}, {1, 5, 7, 3, 4});  // the last row and column
  for_each_target([&] {
    Tensor<float, 4> dx = random_tensor(in.x.shape(), 9);
    conv2d_backward(dx, {}, {}, in.dy, {}, in.w, 2, 0, ctx);
    for (std::int64_t c = 0; c < 3; ++c) {
      for (std::int64_t j = 0; j < 7; ++j) CHECK(dx(0, 4, j, c) == 0);
      for (std::int64_t i = 0; i < 5; ++i) CHECK(dx(0, i, 6, c) == 0);
    }
    CHECK(dx(0, 3, 5, 0) != 0);
  });
}

TEST_CASE("conv2d_backward: NaN in dy reaches the pixels under it and every weight it met") {
  Context ctx(1);
  Operands in = operands({3, 1, 1}, {1, 6, 7, 3, 2});
  in.dy(0, 2, 3, 1) = std::numeric_limits<float>::quiet_NaN();
  for_each_target([&] {
    Tensor<float, 4> dx(in.x.shape()), dw(in.w.shape());
    conv2d_backward(dx, dw, {}, in.dy, in.x, in.w, 1, 1, ctx);
    for (std::int64_t i = 0; i < 6; ++i)
      for (std::int64_t j = 0; j < 7; ++j)
        CHECK(std::isnan(dx(0, i, j, 0)) == (i >= 1 && i <= 3 && j >= 2 && j <= 4));
    CHECK(std::isnan(dw(1, 2, 0, 2)));
    CHECK_FALSE(std::isnan(dw(0, 2, 0, 2)));
  });
}

TEST_CASE("conv2d_backward: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  for (const Kernel& kernel :
       {Kernel{3, 1, 1}, Kernel{3, 2, 1}, Kernel{1, 1, 0}, Kernel{2, 2, 0}}) {
    const Operands in = operands(kernel, {2, 43, 131, 20, 37});
    Tensor<float, 4> dx1(in.x.shape()), dx8(in.x.shape()), dw1(in.w.shape()), dw8(in.w.shape());
    Tensor<float, 1> db1(Shape{37}), db8(Shape{37});
    conv2d_backward(dx1, dw1, db1, in.dy, in.x, in.w, kernel.stride, kernel.padding, one);
    conv2d_backward(dx8, dw8, db8, in.dy, in.x, in.w, kernel.stride, kernel.padding, eight);
    CHECK_SAME_BITS(dx8, dx1);
    CHECK_SAME_BITS(dw8, dw1);
    CHECK_SAME_BITS(db8, db1);
  }
}

TEST_CASE("conv2d_backward: no images give no gradient") {
  Context ctx(1);
  Tensor<float, 4> x(Shape{0, 6, 7, 3}), dy(Shape{0, 6, 7, 5}), w(Shape{5, 3, 3, 3});
  Tensor<float, 4> dw = random_tensor(w.shape(), 1);
  const Tensor<float, 4> before = dw.clone();
  conv2d_backward(x, dw, {}, dy, x, w, 1, 1, ctx);
  CHECK_SAME_BITS(dw, before);
}

TEST_CASE("conv2d_backward: shapes that do not fit are refused by name") {
  Context ctx(1);
  Tensor<float, 4> x(Shape{1, 6, 7, 3}), dy(Shape{1, 6, 7, 5}), w(Shape{5, 3, 3, 3}),
      narrow(Shape{1, 6, 6, 5}), channels(Shape{1, 6, 7, 4}), other(Shape{5, 3, 2, 2}),
      oblong(Shape{5, 3, 3, 2});
  Tensor<float, 1> bias(Shape{4});
  CHECK_THROWS_WITH_AS(conv2d_backward(x, {}, {}, narrow, {}, w, 1, 1, ctx),
                       doctest::Contains("[1,6,6,5]"), Error);
  CHECK_THROWS_WITH_AS(conv2d_backward({}, w, {}, dy, channels, w, 1, 1, ctx),
                       doctest::Contains("[1,6,7,4]"), Error);
  CHECK_THROWS_WITH_AS(conv2d_backward({}, other, {}, dy, x, w, 1, 1, ctx),
                       doctest::Contains("[5,3,2,2]"), Error);
  CHECK_THROWS_WITH_AS(conv2d_backward({}, w, bias, dy, x, w, 1, 1, ctx), doctest::Contains("[4]"),
                       Error);
  CHECK_THROWS_WITH_AS(conv2d_backward(x, {}, {}, dy, {}, oblong, 1, 1, ctx),
                       doctest::Contains("square"), Error);
}
