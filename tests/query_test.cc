// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/query.h"

#include <doctest/doctest.h>

#include <cmath>

#include "lvggt/language/mask_filters.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// Features are codes: without an autoencoder everything can be computed by hand.
constexpr std::int64_t kWidth = 8;

Tensor<float, 2> unit_rows(std::int64_t n, std::uint32_t seed) {
  Tensor<float, 2> x = random_tensor(Shape{n, kWidth}, seed);
  Context ctx(1);
  normalise_rows(x, {}, x, ctx);
  return x;
}

double naive_relevancy(View<const float, 1> e, View<const float, 1> q,
                       const Tensor<float, 2>& canonical) {
  const auto dot = [&](View<const float, 1> v) {
    double sum = 0, length = 0;
    for (std::int64_t c = 0; c < kWidth; ++c) {
      sum += static_cast<double>(e[c]) * v[c];
      length += static_cast<double>(e[c]) * e[c];
    }
    return length > 0 ? sum / std::sqrt(length) : 0;
  };
  double least = 1;
  for (std::int64_t c = 0; c < canonical.extent(0); ++c) {
    const double a = std::exp(10 * dot(q)), b = std::exp(10 * dot(canonical[c]));
    least = std::min(least, a / (a + b));
  }
  return least;
}

// Means over the pixels of the window that are in the map.
template <class T>
Tensor<double, 2> window_means(const Tensor<T, 2>& x, std::int64_t size) {
  const auto [H, W] = x.shape();
  const std::int64_t r = size / 2;
  Tensor<double, 2> means(x.shape());
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t i = 0; i < W; ++i) {
      double sum = 0, count = 0;
      for (std::int64_t v = std::max<std::int64_t>(y - r, 0); v <= std::min(y + r, H - 1); ++v)
        for (std::int64_t u = std::max<std::int64_t>(i - r, 0); u <= std::min(i + r, W - 1); ++u) {
          sum += x(v, u);
          ++count;
        }
      means(y, i) = sum / count;
    }
  return means;
}

Tensor<std::uint8_t, 2> random_mask(std::int64_t H, std::int64_t W, std::uint32_t seed) {
  const Tensor<float, 2> noise = random_tensor(Shape{H, W}, seed);
  Tensor<std::uint8_t, 2> mask(Shape{H, W});
  for (std::int64_t i = 0; i < mask.size(); ++i) mask.data()[i] = noise.data()[i] > 0.05F;
  return mask;
}

}  // namespace

TEST_CASE("mask filters: windows are clipped to maps of any size") {
  Context ctx(1);
  for (const auto& [H, W] :
       {std::pair<std::int64_t, std::int64_t>{1, 1}, {3, 5}, {40, 2}, {33, 61}})
    for (const std::int64_t size : {1, 7, 29}) {
      const Tensor<float, 2> x = random_tensor(Shape{H, W}, 3);
      Tensor<float, 2> y(Shape{H, W});
      box_filter(y, x, size, ctx);
      CHECK_CLOSE(y, window_means(x, size), 1e-7, 1e-7);
      const Tensor<std::uint8_t, 2> mask = random_mask(H, W, 4);
      const Tensor<double, 2> means = window_means(mask, size);
      Tensor<std::uint8_t, 2> smooth(Shape{H, W});
      majority_filter(smooth, mask, size, ctx);
      for (std::int64_t i = 0; i < mask.size(); ++i)
        CHECK(smooth.data()[i] == (means.data()[i] > 0.5));
    }
}

TEST_CASE("mask filters: half of a window is no majority, and an even window is refused") {
  Context ctx(1);
  Tensor<std::uint8_t, 2> mask(Shape{1, 2}), smooth(Shape{1, 2});
  mask(0, 0) = 1;
  majority_filter(smooth, mask, 7, ctx);
  CHECK(smooth(0, 0) == 0);
  CHECK_THROWS_WITH_AS(majority_filter(smooth, mask, 6, ctx), doctest::Contains("must be odd"),
                       Error);
}

TEST_CASE("threshold_mask: a constant map has an empty mask, else the upper part is kept") {
  Tensor<float, 2> x(Shape{2, 3});
  Tensor<std::uint8_t, 2> mask(Shape{2, 3});
  std::fill_n(x.data(), 6, 0.7F);
  mask(0, 0) = 1;
  threshold_mask(mask, x, 0.4F);
  for (std::int64_t i = 0; i < 6; ++i) CHECK(mask.data()[i] == 0);
  const float values[] = {0.2F, 0.9F, 0.3F, 0.6F, 0.68F, 0.72F};
  std::copy_n(values, 6, x.data());  // above 0.2 + 0.7 * 0.7 = 0.69
  threshold_mask(mask, x, 0.4F);
  const int expected[] = {0, 1, 0, 0, 0, 1};
  for (std::int64_t i = 0; i < 6; ++i) CHECK(mask.data()[i] == expected[i]);
}

TEST_CASE("relevancy: is the least softmax against the canonical phrases, in any group size") {
  Context ctx(2);
  const DecodedCosines identity(kWidth);
  const Tensor<float, 2> phrases = unit_rows(300, 1), canonical = unit_rows(4, 2);
  const Tensor<float, 2> codes = random_tensor(Shape{std::int64_t{50}, kWidth}, 3, -3, 3);
  const Relevancy relevancy(identity, phrases, canonical, ctx);
  CHECK(relevancy.num_groups() == 2);
  Tensor<float, 2> maps(Shape{300, 50});
  relevancy.run(maps, codes, ctx);
  for (const std::int64_t q : {0, 17, 255, 256, 299})
    for (std::int64_t i = 0; i < 50; ++i)
      CHECK(maps(q, i) ==
            doctest::Approx(naive_relevancy(codes[i], phrases[q], canonical)).epsilon(1e-5));
}

TEST_CASE("relevancy: a code without length is as relevant as not") {
  Context ctx(1);
  const DecodedCosines identity(kWidth);
  const Relevancy relevancy(identity, unit_rows(2, 1), unit_rows(4, 2), ctx);
  Tensor<float, 2> maps(Shape{2, 1}), codes(Shape{std::int64_t{1}, kWidth});
  relevancy.run(maps, codes, ctx);
  CHECK(maps(0, 0) == 0.5F);
  CHECK(maps(1, 0) == 0.5F);
}

TEST_CASE("PhraseQuery: the level with the largest filtered relevancy answers, for all threads") {
  const DecodedCosines identity(kWidth);
  const Tensor<float, 2> phrases = unit_rows(3, 1), canonical = unit_rows(4, 2);
  const std::int64_t L = 3, H = 21, W = 34;
  const Tensor<float, 4> codes = random_tensor(Shape{L, H, W, kWidth}, 5);
  PhraseAnswers first;
  for (const int threads : {1, 8}) {
    Context ctx(threads);
    const PhraseQuery query(identity, phrases, canonical, {}, ctx);
    PhraseAnswers answers;
    query.answer(answers, codes, ctx);
    CHECK(!answers.rescaled);
    Tensor<float, 3> filtered(Shape{std::int64_t{3}, H, W});
    Tensor<std::uint8_t, 3> mask(filtered.shape());
    for (std::int64_t q = 0; q < 3; ++q) {
      std::int64_t best = 0;
      for (std::int64_t l = 0; l < L; ++l)
        if (answers.score(q, l) > answers.score(q, best)) best = l;
      CHECK(answers.level[static_cast<std::size_t>(q)] == best);
      query.answer_level({}, filtered, {}, mask, codes[best], ctx);
      CHECK_SAME_BITS(answers.relevancy[q], filtered[q]);
      for (std::int64_t y = 0; y < H; ++y)
        for (std::int64_t x = 0; x < W; ++x) CHECK(answers.mask(q, y, x) == mask(q, y, x));
    }
    if (threads == 1)
      first = std::move(answers);
    else
      CHECK_SAME_BITS(answers.relevancy, first.relevancy);
  }
}

TEST_CASE("PhraseQuery: codes that are all above 0 are decoded as 2 x - 1, unless told not to") {
  Context ctx(1);
  const DecodedCosines identity(kWidth);
  Tensor<float, 4> codes =
      random_tensor(Shape{std::int64_t{1}, std::int64_t{6}, std::int64_t{7}, kWidth}, 5);
  const PhraseQuery query(identity, unit_rows(1, 1), unit_rows(4, 2), {}, ctx);
  const PhraseQuery plain(identity, unit_rows(1, 1), unit_rows(4, 2), {.rescale_positive = false},
                          ctx);
  PhraseAnswers expected, answers;
  query.answer(expected, codes, ctx);
  for (std::int64_t i = 0; i < codes.size(); ++i)
    codes.data()[i] = 0.5F * (codes.data()[i] + 1) + 1e-6F;
  query.answer(answers, codes, ctx);
  CHECK(answers.rescaled);
  CHECK_CLOSE(answers.relevancy, expected.relevancy, 1e-4);
  plain.answer(answers, codes, ctx);
  CHECK(!answers.rescaled);
  codes(0, 5, 6, 7) = 0;
  query.answer(answers, codes, ctx);
  CHECK(!answers.rescaled);
}

TEST_CASE("PhraseQuery: what does not fit or is not a number is refused by name") {
  Context ctx(1);
  const DecodedCosines identity(kWidth);
  const PhraseQuery query(identity, unit_rows(1, 1), unit_rows(4, 2), {}, ctx);
  PhraseAnswers answers;
  CHECK_THROWS_WITH_AS(query.answer(answers, Tensor<float, 4>(Shape{1, 2, 2, 3}), ctx),
                       "query: the field has codes of 3 numbers but the autoencoder takes 8",
                       Error);
  Tensor<float, 4> codes(Shape{std::int64_t{2}, std::int64_t{2}, std::int64_t{2}, kWidth});
  codes(1, 0, 1, 3) = std::numeric_limits<float>::infinity();
  CHECK_THROWS_WITH_AS(query.answer(answers, codes, ctx),
                       "query: the code of level 1, row 0, column 1 is inf", Error);
  CHECK_THROWS_WITH_AS(PhraseQuery(identity, unit_rows(1, 1), unit_rows(4, 2), {.box = 4}, ctx),
                       doctest::Contains("must be odd"), Error);
}

TEST_CASE("StateQuery: the mean cosine inside each sentence's own mask, 0 in an empty one") {
  Context ctx(2);
  const DecodedCosines identity(kWidth);
  const Tensor<float, 2> sentences = unit_rows(3, 1);
  const StateQuery query(identity, sentences, ctx);
  const std::int64_t H = 60, W = 50;
  const Tensor<float, 3> codes = random_tensor(Shape{H, W, kWidth}, 5);
  Tensor<std::uint8_t, 3> masks(Shape{std::int64_t{3}, H, W});
  double sums[2] = {}, counts[2] = {};
  for (std::int64_t i = 0; i < 2; ++i) {
    const Tensor<std::uint8_t, 2> mask = random_mask(H, W, static_cast<std::uint32_t>(i + 1));
    for (std::int64_t y = 0; y < H; ++y)
      for (std::int64_t x = 0; x < W; ++x) {
        masks(i, y, x) = mask(y, x);
        if (mask(y, x) == 0) continue;
        double dot = 0, length = 0;
        for (std::int64_t c = 0; c < kWidth; ++c) {
          dot += static_cast<double>(codes(y, x, c)) * sentences(i, c);
          length += static_cast<double>(codes(y, x, c)) * codes(y, x, c);
        }
        sums[i] += dot / std::sqrt(length);
        ++counts[i];
      }
  }
  float similarity[3];
  query.similarity(similarity, codes, masks, ctx);
  CHECK(similarity[0] == doctest::Approx(sums[0] / counts[0]).epsilon(1e-5));
  CHECK(similarity[1] == doctest::Approx(sums[1] / counts[1]).epsilon(1e-5));
  CHECK(similarity[2] == 0);
}

TEST_CASE("time series: ends stay, neighbours are those of the list, the mean decides") {
  const float values[] = {0, 1, 0, 0, 1};
  const std::vector<float> smoothed = smooth_series(values);
  CHECK(smoothed[0] == 0);
  CHECK(smoothed[1] == doctest::Approx(0.8));
  CHECK(smoothed[2] == doctest::Approx(0.1));
  CHECK(smoothed[4] == 1);
  const TimeAnswer answer = answer_over_time(values);
  CHECK(answer.threshold == doctest::Approx(0.4));
  const std::int64_t frames[] = {3, 10, 11, 12, 40};
  const auto intervals = positive_intervals(answer.positive, frames);
  REQUIRE(intervals.size() == 2);
  CHECK(intervals[0] == FrameInterval(10, 10));
  CHECK(intervals[1] == FrameInterval(40, 40));
  CHECK(in_intervals(10, intervals));
  CHECK(!in_intervals(11, intervals));
}

TEST_CASE("time series: short, empty and constant ones have answers") {
  CHECK(smooth_series(std::vector<float>{1, 2}, kFiveTaps) == std::vector<float>{1, 2});
  CHECK(answer_over_time({}).positive.empty());
  for (const float value : {0.3F, 0.7F, -0.1F}) {
    const TimeAnswer answer = answer_over_time(std::vector<float>(9, value));
    CHECK(answer.positive == std::vector<std::uint8_t>(9, 1));
  }
  CHECK_THROWS_WITH_AS(smooth_series(std::vector<float>{1, 2}, std::vector<float>{0.5F, 0.5F}),
                       doctest::Contains("must be odd"), Error);
}
