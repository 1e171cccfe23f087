// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/scores.h"

#include <doctest/doctest.h>

#include <array>

namespace {

using namespace lvggt;

template <std::size_t N>
Tensor<float, 2> rows(const std::array<std::array<float, 2>, N>& values) {
  Tensor<float, 2> table(Shape{static_cast<std::int64_t>(N), std::int64_t{2}});
  for (std::size_t i = 0; i < N; ++i)
    std::copy(values[i].begin(), values[i].end(), table[static_cast<std::int64_t>(i)].data());
  return table;
}

Tensor<std::int32_t, 2> map(std::initializer_list<std::int32_t> classes) {
  Tensor<std::int32_t, 2> result(Shape{std::int64_t{1}, static_cast<std::int64_t>(classes.size())});
  std::copy(classes.begin(), classes.end(), result.data());
  return result;
}

}  // namespace

TEST_CASE("SceneCodes: equal rows of many frames are one code, rows of zeros are none") {
  SceneCodes codes;
  CHECK_FALSE(codes.usable());
  codes.add(rows<3>({{{1, 0}, {0, 1}, {0, 0}}}));
  codes.add(rows<2>({{{0.5F, 0.5F}, {0, 1.00001F}}}));
  REQUIRE(codes.size() == 3);
  CHECK(codes.usable());
  CHECK(codes.states(0) == std::vector<std::size_t>{0, 2});
  CHECK(codes.changing_objects() == std::vector<std::int64_t>{0});
  CHECK(codes.nearest(std::array<float, 2>{0.1F, 0.8F}) == 1);
  CHECK_FALSE(codes.find(std::array<float, 2>{0.1F, 0.8F}));
}

TEST_CASE("SceneCodes: a scene described segment by segment has no classes") {
  SceneCodes codes;
  for (int i = 0; i < 100; ++i) codes.add(rows<1>({{{float(i), 1}}}));
  CHECK_FALSE(codes.usable());
}

TEST_CASE("scores: classes of predictions and targets, with holes and with what is no code") {
  SceneCodes codes;
  codes.add(rows<2>({{{1, 0}, {0, 1}}}));
  Tensor<float, 3> features(Shape{std::int64_t{1}, std::int64_t{3}, std::int64_t{2}});
  features(0, 0, 0) = 1;
  features(0, 1, 1) = 1;
  features(0, 2, 0) = 0.7F;
  Tensor<float, 2> mask(Shape{std::int64_t{1}, std::int64_t{3}});
  mask(0, 0) = 1;
  mask(0, 2) = 1;
  auto classes = map({9, 9, 9});
  nearest_classes(classes, features, codes);
  CHECK(std::equal(classes.data(), classes.data() + 3, map({0, 1, 0}).data()));
  target_classes(classes, features, mask, codes);
  CHECK(std::equal(classes.data(), classes.data() + 3, map({0, kNoClass, kNoClass}).data()));
}

TEST_CASE("IouCounter: pools frames and leaves unlabelled pixels out") {
  IouCounter counter(3);
  counter.add(map({0, 0, 1, kNoClass}), map({0, 1, 1, 0}));
  counter.add(map({0, 0}), map({0, 0}));
  CHECK(*counter.iou(0) == doctest::Approx(3.0 / 4));
  CHECK(*counter.iou(1) == doctest::Approx(1.0 / 2));
  CHECK(*counter.mean_iou() == doctest::Approx(5.0 / 8));

  std::vector<double> twice = counter.counts();
  for (double& count : twice) count *= 2;
  IouCounter sum(3);
  sum.set_counts(twice);
  CHECK(*sum.mean_iou() == *counter.mean_iou());
  CHECK(sum.counts() == twice);
  CHECK_THROWS(sum.set_counts(std::vector<double>(4)));
}

TEST_CASE(
    "D34: a class neither there nor predicted does not count, one only predicted counts as 0") {
  IouCounter counter(3);
  CHECK_FALSE(counter.mean_iou());
  counter.add(map({kNoClass}), map({2}));
  CHECK_FALSE(counter.mean_iou());
  counter.add(map({0, 0}), map({0, 1}));
  CHECK_FALSE(counter.iou(2));
  CHECK(*counter.iou(1) == 0);
  CHECK(*counter.mean_iou() == doctest::Approx(0.25));
}

TEST_CASE("voted_state: most pixels decide among the states of one object") {
  SceneCodes codes;
  codes.add(rows<2>({{{1, 0}, {0, 1}}}));
  codes.add(rows<2>({{{0.5F, 0}, {0, 1}}}));
  CHECK(voted_state(map({1, 1, 1, 2, 2, 0}), codes, 0) == std::optional<std::size_t>(2));
  CHECK(voted_state(map({0, 2, 1}), codes, 0) == std::optional<std::size_t>(0));
  CHECK_FALSE(voted_state(map({1, 1, kNoClass}), codes, 0));
}

TEST_CASE("psnr: a constant error of a tenth is 20 dB, none is capped") {
  Tensor<float, 3> truth(Shape{std::int64_t{2}, std::int64_t{2}, std::int64_t{3}});
  auto predicted = truth.clone();
  CHECK(psnr(predicted, truth) == 100);
  std::fill_n(predicted.data(), predicted.size(), 0.1F);
  CHECK(psnr(predicted, truth) == doctest::Approx(20));
}
