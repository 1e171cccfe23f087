// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/schedule.h"

#include <doctest/doctest.h>

namespace lvggt {
namespace {

TEST_CASE("schedule: the warm-up starts above 0 and ends at the full rate") {
  const Schedule schedule{.learning_rate = 4e-5, .warmup_steps = 20};
  CHECK(learning_rate_at(schedule, 0) == doctest::Approx(2e-6));
  CHECK(learning_rate_at(schedule, 19) == doctest::Approx(4e-5));
  CHECK(learning_rate_at(schedule, 20) == 4e-5);
  CHECK(learning_rate_at(schedule, 1000000) == 4e-5);
}

TEST_CASE("schedule: half a cosine after the warm-up, as the published one after its own") {
  // The published schedule sets the rate once an epoch: 20 of warm-up, 100 in all, and its epoch 25
  // has this rate.
  const Schedule schedule{4e-5, 1e-6, 20, 100, Decay::kCosine};
  CHECK(learning_rate_at(schedule, 20) == doctest::Approx(4e-5));
  CHECK(learning_rate_at(schedule, 21) == doctest::Approx(3.99849662066941e-05).epsilon(1e-12));
  CHECK(learning_rate_at(schedule, 25) == doctest::Approx(3.9625312967863e-05).epsilon(1e-12));
  CHECK(learning_rate_at(schedule, 60) == doctest::Approx((4e-5 + 1e-6) / 2));
  CHECK(learning_rate_at(schedule, 100) == 1e-6);
  CHECK(learning_rate_at(schedule, 5000) == 1e-6);
}

TEST_CASE("schedule: values that make no sense are refused") {
  CHECK_THROWS_AS(validate_schedule({.learning_rate = 0}), Error);
  CHECK_THROWS_AS(validate_schedule({.warmup_steps = -1}), Error);
  CHECK_THROWS_AS(validate_schedule({4e-5, 1e-6, 20, 20, Decay::kCosine}), Error);
  CHECK_THROWS_AS(validate_schedule({4e-5, 1e-3, 2, 20, Decay::kCosine}), Error);
  CHECK_NOTHROW(validate_schedule({4e-5, 1e-6, 2, 20, Decay::kCosine}));
}

}  // namespace
}  // namespace lvggt
