// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/field_query.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "lvggt/field/heat_map.h"
#include "lvggt/field/time_line.h"
#include "tests/support/random.h"

using namespace lvggt;

namespace {

// Unit rows from a generator.
Tensor<float, 2> unit_rows(std::int64_t n, std::int64_t width, std::uint32_t seed) {
  Tensor<float, 2> rows = test::random_tensor(Shape{n, width}, seed);
  for (std::int64_t i = 0; i < n; ++i) {
    double length = 0;
    for (std::int64_t k = 0; k < width; ++k) length += rows(i, k) * rows(i, k);
    for (std::int64_t k = 0; k < width; ++k)
      rows(i, k) = static_cast<float>(rows(i, k) / std::sqrt(length));
  }
  return rows;
}

// What a callback was given, copied.
struct Kept {
  std::int64_t question, level, pixels;
  float score, similarity;
};

std::vector<Kept> ask(const QuestionVectors& vectors, const DecodedCosines& decoder,
                      const DecodedCosines& states, View<const float, 4> codes,
                      View<const float, 4> state_codes, Context& ctx) {
  FieldQuery query(decoder, &states, vectors, {}, ctx);
  std::vector<Kept> kept;
  query.ask(
      codes, state_codes,
      [&](const FrameAnswer& answer) {
        std::int64_t pixels = 0;
        for (std::int64_t y = 0; y < answer.mask.extent(0); ++y)
          pixels +=
              std::count(answer.mask[y].data(), answer.mask[y].data() + answer.mask.extent(1), 1);
        kept.push_back({answer.question, answer.level, pixels, answer.score, answer.similarity});
      },
      ctx);
  return kept;
}

bool refused(const Questions& questions, const std::string& part) {
  try {
    check_questions(questions);
  } catch (const Error& error) {
    return error.kind() == ErrorKind::kUsage &&
           std::string(error.what()).find(part) != std::string::npos;
  }
  return false;
}

}  // namespace

TEST_CASE("FieldQuery: many questions at once are answered as each one alone") {
  Context ctx(2);
  constexpr std::int64_t kWidth = 8, kPhrases = 2 * FieldQuery::kAtOnce - 1, kStates = 3;
  const DecodedCosines decoder(kWidth), states(kWidth);
  const Tensor<float, 4> codes =
      test::random_tensor(Shape{std::int64_t{2}, std::int64_t{9}, std::int64_t{11}, kWidth}, 1);
  const Tensor<float, 4> state_codes =
      test::random_tensor(Shape{std::int64_t{1}, std::int64_t{9}, std::int64_t{11}, kWidth}, 2);
  QuestionVectors vectors{unit_rows(kPhrases + kStates, kWidth, 3), unit_rows(4, kWidth, 4),
                          unit_rows(kStates, kWidth, 5)};
  const std::vector<Kept> all = ask(vectors, decoder, states, codes, state_codes, ctx);
  REQUIRE(all.size() == kPhrases + kStates);
  // The states lie on both sides of a group's end.
  for (const std::int64_t i : {std::int64_t{0}, std::int64_t{63}, std::int64_t{64}, kPhrases - 1,
                               kPhrases, kPhrases + 1, kPhrases + 2}) {
    QuestionVectors one;
    one.canonical = vectors.canonical.clone();
    one.phrases = Tensor<float, 2>(Shape{std::int64_t{1}, kWidth});
    std::copy_n(vectors.phrases[i].data(), kWidth, one.phrases.data());
    if (i >= kPhrases) {
      one.states = Tensor<float, 2>(Shape{std::int64_t{1}, kWidth});
      std::copy_n(vectors.states[i - kPhrases].data(), kWidth, one.states.data());
    }
    std::vector<Kept> alone = ask(one, decoder, states, codes, state_codes, ctx);
    REQUIRE(alone.size() == 1);
    alone[0].question = i;
    CAPTURE(i);
    CHECK(all[static_cast<std::size_t>(i)].question == i);
    CHECK(alone[0].level == all[static_cast<std::size_t>(i)].level);
    CHECK(alone[0].pixels == all[static_cast<std::size_t>(i)].pixels);
    CHECK(alone[0].score == doctest::Approx(all[static_cast<std::size_t>(i)].score).epsilon(1e-5));
    CHECK(alone[0].similarity ==
          doctest::Approx(all[static_cast<std::size_t>(i)].similarity).epsilon(1e-5));
  }
}

TEST_CASE("FieldQuery: states without their codes are refused") {
  Context ctx(1);
  const DecodedCosines decoder(4), states(4);
  const QuestionVectors vectors{unit_rows(1, 4, 1), unit_rows(4, 4, 2), unit_rows(1, 4, 3)};
  FieldQuery query(decoder, &states, vectors, {}, ctx);
  const Tensor<float, 4> codes(
      Shape{std::int64_t{1}, std::int64_t{3}, std::int64_t{3}, std::int64_t{4}});
  CHECK_THROWS_AS(query.ask(
                      codes, {}, [](const FrameAnswer&) {}, ctx),
                  Error);
  CHECK_THROWS_AS(FieldQuery(decoder, nullptr, vectors, {}, ctx), Error);
}

TEST_CASE("check_questions: none, empty ones and too many are usage errors") {
  CHECK(refused({}, "nothing is asked"));
  CHECK(refused({{"cup", "", "hand"}, {}}, "phrase 2 of 3 is empty"));
  CHECK(refused({{"cup"}, {" \t"}}, "state 1 of 1 is empty"));
  CHECK(refused({std::vector<std::string>(10'001, "cup"), {}}, "10001 questions"));
  CHECK_NOTHROW(check_questions({std::vector<std::string>(1000, "cup"), {"it is tilted"}}));
}

TEST_CASE("heat map: neutral relevancy stays grey, the highest is coloured, the mask outlined") {
  Tensor<std::uint8_t, 3> picture(Shape{std::int64_t{5}, std::int64_t{8}, std::int64_t{3}});
  std::fill_n(picture.data(), picture.size(), std::uint8_t{100});
  Tensor<float, 2> relevancy(Shape{std::int64_t{5}, std::int64_t{8}});
  Tensor<std::uint8_t, 2> mask(relevancy.shape());
  for (std::int64_t y = 0; y < 5; ++y)
    for (std::int64_t x = 0; x < 8; ++x) {
      relevancy(y, x) = x < 4 ? 0.4F : 0.9F;
      mask(y, x) = x >= 4;
    }
  Tensor<std::uint8_t, 3> heat(picture.shape());
  paint_heat_map(heat, picture, relevancy, mask);
  CHECK(heat(2, 1, 0) == heat(2, 1, 2));
  CHECK(heat(2, 5, 0) > heat(2, 5, 2));
  CHECK(heat(2, 4, 1) == 255);
  CHECK(heat(0, 6, 2) == 255);
  paint_answer(heat, picture, mask);
  CHECK(heat(2, 1, 0) == heat(2, 1, 2));
  CHECK(heat(2, 5, 0) > heat(2, 5, 2) + 50);
  CHECK_THROWS_AS(paint_answer(heat, picture, Tensor<std::uint8_t, 2>(Shape{2, 2})), Error);
}

TEST_CASE("time line: intervals reach half-way to their neighbours, and are shaded") {
  const std::vector<double> seconds{0, 1, 2, 4};
  const auto bands = positive_bands(seconds, {1, 0, 1, 1});
  REQUIRE(bands.size() == 2);
  CHECK(bands[0] == std::array<double, 2>{0, 0.5});
  CHECK(bands[1] == std::array<double, 2>{1.5, 4});
  CHECK(positive_bands(seconds, {0, 0, 0, 0}).empty());
  CHECK_THROWS_AS(positive_bands(seconds, {1}), Error);

  TimeLine line{
      "the cup is tilted",        "similarity", "smoothed",  seconds, {0.1F, 0.2F, 0.8F, 0.9F},
      {0.1F, 0.25F, 0.75F, 0.9F}, 0.5F,         {0, 0, 1, 1}};
  const Tensor<std::uint8_t, 3> plot = draw_time_lines({line, line});
  CHECK(plot.extent(0) == 440);
  const Rgb8 band = PlotPanel{}.band_color;
  std::int64_t shaded = 0;
  for (std::int64_t x = 0; x < plot.extent(1); ++x)
    shaded += std::equal(band.begin(), band.end(), &plot(50, x, 0));
  CHECK(shaded > 300);
  CHECK(shaded < 600);
  line.values.clear();
  CHECK_THROWS_AS(draw_time_lines({line}), Error);
}
