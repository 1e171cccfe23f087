// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <limits>

#include "lvggt/kernels/batch_norm2d.h"
#include "tests/reference/batch_norm2d.h"
#include "tests/support/compare.h"
#include "tests/support/golden.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

constexpr float kEps = 1e-5f, kMomentum = 0.1f;

// A layer's parameters and a batch of values around `offset`.
struct Layer {
  Tensor<float, 4> x, dy;
  Tensor<float, 1> gamma, beta;
  explicit Layer(Shape<4> shape, float offset = 0)
      : x(random_tensor(shape, 1, offset - 1, offset + 2)),
        dy(random_tensor(shape, 2)),
        gamma(random_tensor(Shape{shape[3]}, 3, -1, 2)),
        beta(random_tensor(Shape{shape[3]}, 4)) {}
  std::int64_t C() const { return x.extent(3); }
};

struct Statistics {
  Tensor<float, 1> mean, rstd;
  explicit Statistics(std::int64_t C) : mean(Shape{C}), rstd(Shape{C}) {}
};

template <class T>
Tensor<T, 4> with_activation(Tensor<T, 4> y, Activation activation) {
  for (std::int64_t i = 0; i < y.size(); ++i)
    if (activation == Activation::kRelu && !(std::real(y.data()[i]) > 0)) y.data()[i] = T(0);
  return y;
}

// The layer with the statistics of its batch, or with given ones.
template <class T>
Tensor<T, 4> reference_forward(const Tensor<T, 4>& x, const Tensor<T, 1>& gamma,
                               const Tensor<T, 1>& beta, Activation activation,
                               const reference::BatchStatistics<T>* frozen = nullptr) {
  const reference::BatchStatistics<T> own = reference::batch_statistics(x);
  const reference::BatchStatistics<T>& s = frozen ? *frozen : own;
  return with_activation(
      reference::batch_norm2d(x, gamma, beta, s.mean, s.var, T(static_cast<double>(kEps))),
      activation);
}

struct Gradients {
  Tensor<double, 4> dx;
  Tensor<double, 1> dgamma, dbeta;
};
Gradients expected_gradients(const Layer& layer, Activation activation,
                             const reference::BatchStatistics<Complex>* frozen = nullptr) {
  const auto x = in_complex(layer.x);
  const auto gamma = in_complex(layer.gamma), beta = in_complex(layer.beta);
  const auto loss = [&](const Tensor<Complex, 4>& v, const Tensor<Complex, 1>& g,
                        const Tensor<Complex, 1>& b) {
    return weighted_sum(layer.dy, reference_forward(v, g, b, activation, frozen));
  };
  return {complex_step(layer.x, [&](const auto& v) { return loss(v, gamma, beta); }),
          complex_step(layer.gamma, [&](const auto& v) { return loss(x, v, beta); }),
          complex_step(layer.beta, [&](const auto& v) { return loss(x, gamma, v); })};
}

// Statistics are exact to a rounding (of mean 1/2 here, so 0.5 u max|x|); the output then rounds
// four times values of |x - mean| rstd |gamma| < 6.
double output_limit(const Layer& layer, View<const float, 1> rstd) {
  return (4 * 6 + 2 * largest_magnitude(layer.x) * largest_magnitude(converted<float>(rstd))) *
         kUnit * 2;
}

constexpr Shape<4> kShapes[] = {{2, 3, 4, 5},  {1, 1, 2, 1},  {3, 2, 3, 16},
                                {1, 5, 7, 17}, {2, 1, 3, 33}, {1, 2, 2, 40}};

}  // namespace

TEST_CASE("batch_norm2d_forward: agrees with the definition, with and without ReLU, strided") {
  Context ctx(2);
  for_each_target([&] {
    for (const Shape<4>& shape : kShapes) {
      CAPTURE(shape);
      const Layer layer(shape);
      const auto statistics = reference::batch_statistics(in_double(layer.x));
      for (const Activation activation : {Activation::kNone, Activation::kRelu}) {
        Statistics s(layer.C());
        Strided<4> x(layer.x.view()), y(shape);
        batch_norm2d_forward(y.view(), s.mean, s.rstd, {}, {}, x.view(), layer.gamma, layer.beta,
                             kEps, kMomentum, activation, ctx);
        CHECK_CLOSE(s.mean, statistics.mean, 0, 2 * kUnit);
        for (std::int64_t c = 0; c < layer.C(); ++c)
          CHECK(s.rstd[c] ==
                doctest::Approx(1 / std::sqrt(statistics.var[c] + kEps)).epsilon(2 * kUnit));
        const auto expected = reference_forward(in_double(layer.x), in_double(layer.gamma),
                                                in_double(layer.beta), activation);
        CHECK_CLOSE(y.view(), expected, output_limit(layer, s.rstd));
        CHECK(y.gaps_untouched());
        batch_norm2d_forward(x.view(), s.mean, s.rstd, {}, {}, x.view(), layer.gamma, layer.beta,
                             kEps, kMomentum, activation, ctx);  // y may be x
        CHECK_SAME_BITS(x.view(), y.view());
      }
    }
  });
}

TEST_CASE(
    "batch_norm2d_forward: running statistics move by the momentum, to the unbiased variance") {
  Context ctx(1);
  const Layer layer({2, 3, 4, 5});
  const auto statistics = reference::batch_statistics(in_double(layer.x));
  const auto mean0 = random_tensor(Shape{5}, 7), var0 = random_tensor(Shape{5}, 8, 1, 2);
  for_each_target([&] {
    Statistics s(5);
    Tensor<float, 4> y(layer.x.shape());
    Tensor<float, 1> mean = mean0.clone(), var = var0.clone();
    batch_norm2d_forward(y, s.mean, s.rstd, mean, var, layer.x, layer.gamma, layer.beta, kEps,
                         kMomentum, Activation::kNone, ctx);
    for (std::int64_t c = 0; c < 5; ++c) {
      CHECK(mean[c] == doctest::Approx(0.9 * mean0[c] + 0.1 * statistics.mean[c]).epsilon(1e-6));
      CHECK(var[c] ==
            doctest::Approx(0.9 * var0[c] + 0.1 * statistics.var[c] * 24 / 23).epsilon(1e-6));
    }
  });
}

TEST_CASE("batch_norm2d_backward: agrees with the complex step, with and without ReLU, strided") {
  Context ctx(2);
  for (const Shape<4>& shape :
       {Shape<4>{2, 3, 4, 5}, Shape<4>{1, 1, 2, 1}, Shape<4>{1, 2, 3, 19}, Shape<4>{1, 5, 1, 2}}) {
    CAPTURE(shape);
    const Layer layer(shape);
    for (const Activation activation : {Activation::kNone, Activation::kRelu}) {
      const Gradients expected = expected_gradients(layer, activation);
      for_each_target([&] {
        Statistics s(layer.C());
        Tensor<float, 4> y(shape);
        Tensor<float, 1> dgamma(Shape{layer.C()}), dbeta(Shape{layer.C()});
        Strided<4> x(layer.x.view()), dy(layer.dy.view()), dx(shape);
        batch_norm2d_forward(y, s.mean, s.rstd, {}, {}, x.view(), layer.gamma, layer.beta, kEps,
                             kMomentum, activation, ctx);
        dgamma[0] = dbeta[0] = 3;  // accumulate
        batch_norm2d_backward(dx.view(), dgamma, dbeta, dy.view(), s.mean, s.rstd, x.view(),
                              layer.gamma, layer.beta, activation, ctx);
        dgamma[0] -= 3;
        dbeta[0] -= 3;
        CHECK_CLOSE(dx.view(), expected.dx, 5e-5 * largest_magnitude(layer.gamma));
        CHECK_CLOSE(dgamma, expected.dgamma, 5e-6);
        CHECK_CLOSE(dbeta, expected.dbeta, 5e-6);
        CHECK(dx.gaps_untouched());
        batch_norm2d_backward(dy.view(), {}, {}, dy.view(), s.mean, s.rstd, x.view(), layer.gamma,
                              layer.beta, activation, ctx);  // dx may be dy
        CHECK_SAME_BITS(dy.view(), dx.view());
      });
    }
  }
}

TEST_CASE("batch_norm2d: frozen statistics, forward and backward, agree with the definition") {
  Context ctx(2);
  const Layer layer({2, 3, 2, 19});
  const auto mean = random_tensor(Shape{19}, 7), var = random_tensor(Shape{19}, 8, 0.5f, 2);
  const reference::BatchStatistics<Complex> frozen{in_complex(mean), in_complex(var)};
  const reference::BatchStatistics<double> statistics{in_double(mean), in_double(var)};
  for (const Activation activation : {Activation::kNone, Activation::kRelu}) {
    const Gradients expected = expected_gradients(layer, activation, &frozen);
    const auto expected_y = reference_forward(in_double(layer.x), in_double(layer.gamma),
                                              in_double(layer.beta), activation, &statistics);
    for_each_target([&] {
      Tensor<float, 1> rstd(Shape{19}), dgamma(Shape{19}), dbeta(Shape{19});
      Tensor<double, 2> sums(Shape{2, 19});
      Tensor<float, 4> y(layer.x.shape()), dx(layer.x.shape());
      batch_norm2d_rstd(rstd, var, kEps);
      batch_norm2d_normalize(y, layer.x, mean, rstd, layer.gamma, layer.beta, activation, ctx);
      CHECK_CLOSE(y, expected_y, 4e-6);
      batch_norm2d_backward_sums(sums, layer.dy, mean, rstd, layer.x, layer.gamma, layer.beta,
                                 activation, ctx);
      batch_norm2d_backward_parameters(dgamma, dbeta, sums);
      batch_norm2d_backward_input(dx, layer.dy, {}, 0, mean, rstd, layer.x, layer.gamma, layer.beta,
                                  activation, ctx);
      CHECK_CLOSE(dx, expected.dx, 2e-6);
      CHECK_CLOSE(dgamma, expected.dgamma, 1e-5);
      CHECK_CLOSE(dbeta, expected.dbeta, 1e-5);
    });
  }
}

TEST_CASE("batch_norm2d: a batch in two halves, their sums added, is the whole batch") {
  Context ctx(2);
  const Layer layer({4, 3, 5, 19}, 3);
  const auto shared = random_tensor(Shape{19}, 7);  // the pivot, a running mean
  const auto half = [](View<const float, 4> x, std::int64_t i) {
    return x.narrow(0, 2 * i, 2 * i + 2);
  };
  for_each_target([&] {
    Statistics whole(19), split(19);
    Tensor<float, 1> mean = shared.clone(), var(Shape{19}), mean2 = shared.clone(), var2(Shape{19});
    Tensor<float, 4> y(layer.x.shape()), y2(layer.x.shape()), dx(y.shape()), dx2(y.shape());
    Tensor<float, 1> dgamma(Shape{19}), dbeta(Shape{19}), dgamma2(Shape{19}), dbeta2(Shape{19});
    batch_norm2d_forward(y, whole.mean, whole.rstd, mean, var, layer.x, layer.gamma, layer.beta,
                         kEps, kMomentum, Activation::kRelu, ctx);
    batch_norm2d_backward(dx, dgamma, dbeta, layer.dy, whole.mean, whole.rstd, layer.x, layer.gamma,
                          layer.beta, Activation::kRelu, ctx);

    Tensor<double, 2> total(Shape{2, 19}), part(Shape{2, 19});
    const auto add_part = [&] {
      for (std::int64_t i = 0; i < total.size(); ++i) total.data()[i] += part.data()[i];
    };
    for (std::int64_t i = 0; i < 2; ++i) {
      batch_norm2d_sums(part, half(layer.x, i), shared, ctx);
      add_part();
    }
    batch_norm2d_statistics(split.mean, split.rstd, mean2, var2, total, mean2, 60, kEps, kMomentum);
    total = Tensor<double, 2>(Shape{2, 19});
    for (std::int64_t i = 0; i < 2; ++i) {
      batch_norm2d_normalize(y2.view().narrow(0, 2 * i, 2 * i + 2), half(layer.x, i), split.mean,
                             split.rstd, layer.gamma, layer.beta, Activation::kRelu, ctx);
      batch_norm2d_backward_sums(part, half(layer.dy, i), split.mean, split.rstd, half(layer.x, i),
                                 layer.gamma, layer.beta, Activation::kRelu, ctx);
      batch_norm2d_backward_parameters(dgamma2, dbeta2, part);  // a process's own, summed later
      add_part();
    }
    for (std::int64_t i = 0; i < 2; ++i)
      batch_norm2d_backward_input(dx2.view().narrow(0, 2 * i, 2 * i + 2), half(layer.dy, i), total,
                                  60, split.mean, split.rstd, half(layer.x, i), layer.gamma,
                                  layer.beta, Activation::kRelu, ctx);
    CHECK_CLOSE(split.mean, whole.mean, 0, 2 * kUnit);
    CHECK_CLOSE(split.rstd, whole.rstd, 0, 2 * kUnit);
    CHECK_CLOSE(mean2, mean, 0, 4 * kUnit);
    CHECK_CLOSE(var2, var, 0, 4 * kUnit);
    CHECK_CLOSE(y2, y, 3e-6);
    CHECK_CLOSE(dx2, dx, 3e-6);
    CHECK_CLOSE(dgamma2, dgamma, 2e-5);
    CHECK_CLOSE(dbeta2, dbeta, 2e-5);
  });
}

TEST_CASE("batch_norm2d D30: a constant channel gives beta, and a gradient that is finite") {
  Context ctx(1);
  for_each_target([&] {
    for (const float value : {0.0f, 1.0f, -1234.567f, 1e6f}) {
      CAPTURE(value);
      Layer layer({2, 3, 5, 17});
      for (std::int64_t i = 0; i < layer.x.size(); ++i) layer.x.data()[i] = value;
      Statistics s(17);
      Tensor<float, 4> y(layer.x.shape()), dx(layer.x.shape());
      Tensor<float, 1> dgamma(Shape{17}), dbeta(Shape{17});
      batch_norm2d_forward(y, s.mean, s.rstd, {}, {}, layer.x, layer.gamma, layer.beta, kEps,
                           kMomentum, Activation::kNone, ctx);
      const float largest = 1 / std::sqrt(kEps);
      for (std::int64_t c = 0; c < 17; ++c) {
        CHECK(s.mean[c] == value);
        CHECK(s.rstd[c] == doctest::Approx(largest));
        CHECK(y(1, 2, 4, c) == layer.beta[c]);
      }
      batch_norm2d_backward(dx, dgamma, dbeta, layer.dy, s.mean, s.rstd, layer.x, layer.gamma,
                            layer.beta, Activation::kNone, ctx);
      for (std::int64_t c = 0; c < 17; ++c) {
        CHECK(dgamma[c] == 0);
        double sum = 0;  // dx is dy without its average, magnified by 1 / sqrt(eps)
        for (std::int64_t n = 0; n < 30; ++n) sum += layer.dy.data()[n * 17 + c] / 30;
        CHECK(
            dx(0, 0, 0, c) ==
            doctest::Approx(layer.gamma[c] * largest * (layer.dy(0, 0, 0, c) - sum)).epsilon(1e-4));
      }
    }
  });
}

TEST_CASE("batch_norm2d D30: a large common offset does not drown the variance") {
  Context ctx(1);
  const Layer layer({2, 9, 7, 5}, 1e4f);
  const auto statistics = reference::batch_statistics(in_double(layer.x));
  for_each_target([&] {
    Statistics s(5);
    Tensor<float, 4> y(layer.x.shape());
    batch_norm2d_forward(y, s.mean, s.rstd, {}, {}, layer.x, layer.gamma, layer.beta, kEps,
                         kMomentum, Activation::kNone, ctx);
    for (std::int64_t c = 0; c < 5; ++c)
      CHECK(s.rstd[c] ==
            doctest::Approx(1 / std::sqrt(statistics.var[c] + kEps)).epsilon(2 * kUnit));
  });
}

TEST_CASE("batch_norm2d D30: a batch of one value a channel is refused in training, not frozen") {
  Context ctx(1);
  const Layer layer({1, 1, 1, 3});
  Statistics s(3);
  Tensor<float, 4> y(layer.x.shape());
  CHECK_THROWS_WITH_AS(batch_norm2d_forward(y, s.mean, s.rstd, {}, {}, layer.x, layer.gamma,
                                            layer.beta, kEps, kMomentum, Activation::kNone, ctx),
                       doctest::Contains("no variance"), Error);
  const Tensor<float, 1> zero(Shape{3});
  Tensor<float, 1> ones(Shape{3});
  for (std::int64_t c = 0; c < 3; ++c) ones[c] = 1;
  batch_norm2d_normalize(y, layer.x, zero, ones, layer.gamma, layer.beta, Activation::kNone, ctx);
  CHECK(y(0, 0, 0, 2) == doctest::Approx(layer.gamma[2] * layer.x(0, 0, 0, 2) + layer.beta[2]));
}

TEST_CASE("batch_norm2d: NaN in a channel stays in that channel, also through the ReLU") {
  Context ctx(1);
  Layer layer({1, 4, 5, 3});
  layer.x(0, 2, 2, 1) = std::numeric_limits<float>::quiet_NaN();
  for_each_target([&] {
    Statistics s(3);
    Tensor<float, 4> y(layer.x.shape());
    batch_norm2d_forward(y, s.mean, s.rstd, {}, {}, layer.x, layer.gamma, layer.beta, kEps,
                         kMomentum, Activation::kRelu, ctx);
    for (std::int64_t c = 0; c < 3; ++c) CHECK(std::isnan(y(0, 0, 0, c)) == (c == 1));
  });
}

TEST_CASE("batch_norm2d: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const Layer layer({3, 67, 53, 20});
  Statistics s1(20), s8(20);
  Tensor<float, 4> y1(layer.x.shape()), y8(y1.shape()), dx1(y1.shape()), dx8(y1.shape());
  Tensor<float, 1> g1(Shape{20}), g8(Shape{20}), b1(Shape{20}), b8(Shape{20});
  batch_norm2d_forward(y1, s1.mean, s1.rstd, {}, {}, layer.x, layer.gamma, layer.beta, kEps,
                       kMomentum, Activation::kRelu, one);
  batch_norm2d_forward(y8, s8.mean, s8.rstd, {}, {}, layer.x, layer.gamma, layer.beta, kEps,
                       kMomentum, Activation::kRelu, eight);
  batch_norm2d_backward(dx1, g1, b1, layer.dy, s1.mean, s1.rstd, layer.x, layer.gamma, layer.beta,
                        Activation::kRelu, one);
  batch_norm2d_backward(dx8, g8, b8, layer.dy, s8.mean, s8.rstd, layer.x, layer.gamma, layer.beta,
                        Activation::kRelu, eight);
  CHECK_SAME_BITS(s8.mean, s1.mean);
  CHECK_SAME_BITS(s8.rstd, s1.rstd);
  CHECK_SAME_BITS(y8, y1);
  CHECK_SAME_BITS(dx8, dx1);
  CHECK_SAME_BITS(g8, g1);
  CHECK_SAME_BITS(b8, b1);
}

TEST_CASE("batch_norm2d: shapes and activations that do not fit are refused by name") {
  Context ctx(1);
  const Layer layer({1, 2, 3, 4});
  Statistics s(4), five(5);
  Tensor<float, 4> y(layer.x.shape()), wide(Shape{1, 2, 3, 5});
  Tensor<double, 2> sums(Shape{2, 5});
  CHECK_THROWS_WITH_AS(batch_norm2d_normalize(wide, layer.x, s.mean, s.rstd, layer.gamma,
                                              layer.beta, Activation::kNone, ctx),
                       doctest::Contains("[1,2,3,5]"), Error);
  CHECK_THROWS_WITH_AS(batch_norm2d_normalize(y, layer.x, five.mean, s.rstd, layer.gamma,
                                              layer.beta, Activation::kNone, ctx),
                       doctest::Contains("[5]"), Error);
  CHECK_THROWS_WITH_AS(batch_norm2d_normalize(y, layer.x, s.mean, s.rstd, layer.gamma, layer.beta,
                                              Activation::kGelu, ctx),
                       doctest::Contains("ReLU"), Error);
  CHECK_THROWS_WITH_AS(batch_norm2d_sums(sums, layer.x, {}, ctx), doctest::Contains("[2,5]"),
                       Error);
  CHECK_THROWS_WITH_AS(batch_norm2d_backward(y, {}, {}, wide, s.mean, s.rstd, layer.x, layer.gamma,
                                             layer.beta, Activation::kNone, ctx),
                       doctest::Contains("[1,2,3,5]"), Error);
}
