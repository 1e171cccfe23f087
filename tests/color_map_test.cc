// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/color_map.h"

#include <doctest/doctest.h>

using namespace lvggt;

TEST_CASE("rainbow: clamps, has no jump, and never repeats a colour") {
  CHECK(rainbow(-1) == rainbow(0));
  CHECK(rainbow(NAN) == rainbow(0));
  CHECK(rainbow(2) == rainbow(1));
  for (int i = 1; i <= 1000; ++i) {
    const Rgb8 a = rainbow((i - 1) / 1000.0), b = rainbow(i / 1000.0);
    for (std::size_t c = 0; c < 3; ++c) CHECK(std::abs(a[c] - b[c]) <= 2);
  }
  CHECK(rainbow(0)[2] > rainbow(0)[0]);  // blue is low
  CHECK(rainbow(1)[0] > rainbow(1)[2]);  // red is high
}

TEST_CASE("robust_range: leaves outliers outside; a constant is shown in the middle") {
  Tensor<float, 2> values(Shape{10, 10});
  for (std::int64_t i = 0; i < 100; ++i) values.data()[i] = static_cast<float>(i);
  values.data()[99] = 1e9f;
  const ValueRange range = robust_range(values);
  CHECK(range.low == doctest::Approx(1.98));
  CHECK(range.high == doctest::Approx(97.02));
  std::fill_n(values.data(), 100, 3.0f);
  CHECK(robust_range(values).position(3) == 0.5);
}

TEST_CASE("color_bytes: rounds to the nearest of 256 and clamps") {
  Tensor<float, 3> rgb(Shape{1, 1, 3});
  Tensor<std::uint8_t, 3> pixels(Shape{1, 1, 3});
  rgb.data()[0] = -0.2f;
  rgb.data()[1] = 127.4f / 255;
  rgb.data()[2] = 1.7f;
  color_bytes(pixels, rgb);
  CHECK(pixels.data()[0] == 0);
  CHECK(pixels.data()[1] == 127);
  CHECK(pixels.data()[2] == 255);
}
