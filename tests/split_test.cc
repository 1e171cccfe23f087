// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/split.h"

#include <doctest/doctest.h>

#include <numeric>

#include "tests/support/safetensors_bytes.h"

using namespace lvggt;
using Positions = std::vector<std::int64_t>;

namespace {

FrameRanges ranges(std::string_view text) { return FrameRanges::parse(text, "--train"); }

Positions numbers(std::int64_t first, std::int64_t last) {
  Positions result(static_cast<std::size_t>(last - first + 1));
  std::iota(result.begin(), result.end(), first);
  return result;
}

}  // namespace

TEST_CASE("split: lists of frame numbers are sorted and merged, ends included") {
  CHECK(ranges("1-48").text() == "1-48");
  CHECK(ranges("60,1-3,4,7-9,8-12").text() == "1-4,7-12,60");
  const FrameRanges r = ranges("2-4,9");
  for (const std::int64_t inside : {2, 3, 4, 9}) CHECK(r.contains(inside));
  for (const std::int64_t outside : {0, 1, 5, 8, 10}) CHECK_FALSE(r.contains(outside));
  CHECK_FALSE(FrameRanges().contains(0));
}

TEST_CASE("split: anything else is refused with the option's name") {
  for (const char* text : {"", "a", "1-", "-3", "3-1", "1,,2", "1,", "1 - 2", "1-2-3", "1;2", "1.5",
                           "99999999999999999999"}) {
    const auto outcome = test::outcome_of([&] { ranges(text); });
    INFO(text);
    CHECK(outcome.kind == ErrorKind::kUsage);
    CHECK(outcome.says("--train"));
  }
}

TEST_CASE("split: frames go to the part whose list has their number") {
  const Positions all = numbers(1, 72);
  SplitOptions options;
  CHECK(split_frames(all, options, "scene").train.size() == 72);
  options.held_out = ranges("49-72");
  Split split = split_frames(all, options, "scene");
  CHECK(split.train == numbers(0, 47));
  CHECK(split.held_out == numbers(48, 71));
  options.train = ranges("1-10");
  CHECK(split_frames(all, options, "scene").train == numbers(0, 9));
}

TEST_CASE("split: every N-th frame can be held out") {
  SplitOptions options;
  options.hold_out_every = 3;
  const Split split = split_frames(numbers(10, 18), options, "scene");
  CHECK(split.held_out == Positions{2, 5, 8});
  CHECK(split.train == Positions{0, 1, 3, 4, 6, 7});
  options.train = ranges("10-13");
  CHECK(split_frames(numbers(10, 18), options, "scene").train == Positions{0, 1, 3});
}

TEST_CASE("split: contradictions and empty parts are refused") {
  const Positions all = numbers(1, 10);
  const auto says = [&](SplitOptions options, std::string_view text) {
    const auto outcome = test::outcome_of([&] { split_frames(all, options, "the scene"); });
    INFO(outcome.message);
    return outcome.kind == ErrorKind::kUsage && outcome.says(text);
  };
  CHECK(says({ranges("1-5"), ranges("5-6"), 0}, "frame 5"));
  CHECK(says({{}, ranges("5-6"), 2}, "one of them"));
  CHECK(says({{}, {}, 1}, "2 or more"));
  CHECK(says({ranges("20-30"), {}, 0}, "the scene: has no frame to train on"));
  CHECK(says({{}, ranges("1-10"), 0}, "no frame to train on"));
  CHECK(says({{}, ranges("11-20"), 0}, "none of the frames to hold out"));
}
