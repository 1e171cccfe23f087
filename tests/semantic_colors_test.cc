// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/semantic_colors.h"

#include <doctest/doctest.h>

#include <random>

using namespace lvggt;

namespace {

// Features that vary along two directions of an eight-dimensional space, the first ten times as
// much.
Tensor<float, 3> two_directions(unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<float> uniform(-1, 1);
  Tensor<float, 3> features(Shape{12, 15, 8});
  for (std::int64_t i = 0; i < 12 * 15; ++i) {
    const float a = 10 * uniform(random), b = uniform(random);
    for (std::int64_t k = 0; k < 8; ++k)
      features.data()[8 * i + k] = (k == 2 ? a : 0) + (k == 5 ? -b : 0) + 3;
  }
  return features;
}

Tensor<std::uint8_t, 3> colors_of(const SemanticColors& colors, View<const float, 3> features) {
  Tensor<std::uint8_t, 3> pixels(Shape{features.extent(0), features.extent(1), std::int64_t{3}});
  colors.apply(pixels, features);
  return pixels;
}

}  // namespace

TEST_CASE("SemanticColors: the basis holds the directions of most variation, of fixed sign") {
  SemanticColors colors;
  colors.fit(two_directions(1));
  CHECK(colors.basis()(0, 2) == doctest::Approx(1).epsilon(1e-3));
  CHECK(colors.basis()(1, 5) == doctest::Approx(1).epsilon(1e-3));
  CHECK((colors.basis() * colors.basis().transpose() - Eigen::Matrix3d::Identity()).norm() < 1e-9);
}

TEST_CASE("SemanticColors: equal vectors keep their colour in every later frame") {
  SemanticColors colors;
  const auto first = two_directions(1);
  colors.fit(first);
  auto later = two_directions(2);
  std::copy_n(first.view()[3][4].data(), 8, later.view()[7][2].data());
  const auto a = colors_of(colors, first), b = colors_of(colors, later);
  for (std::int64_t c = 0; c < 3; ++c) CHECK(a(3, 4, c) == b(7, 2, c));
}

TEST_CASE("SemanticColors: the range is robust and uses the whole scale") {
  auto features = two_directions(3);
  features(0, 0, 2) = 1e6f;  // an outlier that must not darken the rest
  SemanticColors colors;
  colors.fit(features);
  const auto pixels = colors_of(colors, features);
  int low = 255, high = 0;
  for (std::int64_t y = 1; y < 12; ++y)
    for (std::int64_t x = 0; x < 15; ++x) {
      low = std::min<int>(low, pixels(y, x, 1));
      high = std::max<int>(high, pixels(y, x, 1));
    }
  CHECK(low < 10);
  CHECK(high > 245);
}

TEST_CASE("SemanticColors: three values are shown as they are, in one range") {
  Tensor<float, 3> features(Shape{10, 10, 3});
  for (std::int64_t i = 0; i < 100; ++i) {
    features.data()[3 * i] = static_cast<float>(i) / 99;  // 0 to 1
    features.data()[3 * i + 1] = 0.5f;                    // the middle
    features.data()[3 * i + 2] = 1 - static_cast<float>(i) / 99;
  }
  SemanticColors colors;
  colors.fit(features);
  const auto pixels = colors_of(colors, features);
  CHECK(pixels(0, 0, 0) == 0);
  CHECK(pixels(9, 9, 0) == 255);
  CHECK(std::abs(pixels(4, 4, 1) - 128) <= 1);
  CHECK(pixels(0, 0, 2) == 255);
}

TEST_CASE("D33: constant features and fewer than three values give grey, not NaN") {
  for (const std::int64_t d : {1, 2, 3, 6}) {
    Tensor<float, 3> features(Shape{std::int64_t{4}, std::int64_t{5}, d});
    std::fill_n(features.data(), features.size(), 2.5f);
    SemanticColors colors;
    CHECK_FALSE(colors.fitted());
    colors.fit(features);
    CHECK(colors.fitted());
    const auto pixels = colors_of(colors, features);
    for (std::int64_t i = 0; i < pixels.size(); ++i) CHECK(pixels.data()[i] == 128);
  }
}

TEST_CASE("SemanticColors: features of another width are refused by name") {
  SemanticColors colors;
  colors.fit(two_directions(1));
  Tensor<float, 3> features(Shape{2, 2, 6});
  Tensor<std::uint8_t, 3> pixels(Shape{2, 2, 3});
  CHECK_THROWS_WITH_AS(colors.apply(pixels, features), doctest::Contains("fitted to 8"), Error);
}
