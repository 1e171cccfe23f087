// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/line_plot.h"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>

namespace {

using namespace lvggt;

std::int64_t count_color(const Tensor<std::uint8_t, 3>& picture, const Rgb8& color) {
  std::int64_t count = 0;
  for (std::int64_t y = 0; y < picture.extent(0); ++y)
    for (std::int64_t x = 0; x < picture.extent(1); ++x)
      count += picture(y, x, 0) == color[0] && picture(y, x, 1) == color[1] &&
               picture(y, x, 2) == color[2];
  return count;
}

// The mean row of the pixels of a colour between two columns.
double mean_row(const Tensor<std::uint8_t, 3>& picture, const Rgb8& color, std::int64_t left,
                std::int64_t right) {
  double sum = 0, count = 0;
  for (std::int64_t y = 30; y < picture.extent(0); ++y)
    for (std::int64_t x = left; x < right; ++x)
      if (picture(y, x, 0) == color[0] && picture(y, x, 1) == color[1] &&
          picture(y, x, 2) == color[2]) {
        sum += static_cast<double>(y);
        ++count;
      }
  return sum / count;
}

}  // namespace

TEST_CASE("axis_ticks: round numbers that cover the interval") {
  CHECK(axis_ticks(0, 100, 5) == std::vector<double>{0, 20, 40, 60, 80, 100});
  CHECK(axis_ticks(0, 1, 5).size() == 6);
  CHECK(axis_ticks(-0.03, 0.05, 4).front() == doctest::Approx(-0.02));
  CHECK(axis_ticks(7, 7, 5) == std::vector<double>{7});
  for (const double high : {1e-6, 0.3, 7.0, 123.0, 4e9}) {
    const auto ticks = axis_ticks(0, high, 6);
    CHECK(ticks.size() >= 3);
    CHECK(ticks.size() <= 8);
    CHECK(ticks.back() <= high * (1 + 1e-6));
  }
  CHECK(log_axis_ticks(0.9e-3, 1.1).size() == 4);
  CHECK(log_axis_ticks(0.03, 0.6).size() == 4);  // 0.05, 0.1, 0.2, 0.5
  CHECK(tick_text(0.02) == "0.02");
  CHECK(tick_text(1500) == "1500");
}

TEST_CASE("moving_average: the mean of the last values") {
  const auto smooth = moving_average({{0, 1}, {1, 3}, {2, 5}, {3, 9}}, 2);
  CHECK(smooth[0][1] == 1);
  CHECK(smooth[1][1] == 2);
  CHECK(smooth[3][1] == 7);
}

TEST_CASE("LinePlot: a falling curve starts above where it ends, for either axis") {
  const Rgb8 red{200, 0, 0};
  for (const bool logarithmic : {false, true}) {
    PlotPanel panel{"loss", "step", {{"", red, {}, false}}, logarithmic};
    for (int i = 0; i <= 100; ++i)
      panel.curves[0].points.push_back({double(i), std::exp(-i / 20.0)});
    const auto picture = LinePlot(640, 240).draw({panel, panel});
    REQUIRE(picture.shape() == Shape{std::int64_t{480}, std::int64_t{640}, std::int64_t{3}});
    CHECK(count_color(picture, red) > 500);
    const auto first = LinePlot(640, 240).draw({panel});
    CHECK(mean_row(first, red, 76, 100) < 70);
    CHECK(mean_row(first, red, 590, 620) > 180);
    // On a logarithmic axis an exponential is a straight line.
    const double middle = mean_row(first, red, 340, 356);
    CHECK((middle < 130) == logarithmic);
  }
}

TEST_CASE(
    "LinePlot: no points, one point, equal values and what is not finite are drawn all the same") {
  const Rgb8 blue{0, 0, 200};
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const LinePlot plot(400, 200);
  CHECK(count_color(plot.draw({{"t", "x", {}, false}}), blue) == 0);
  CHECK(count_color(plot.draw({{"t", "x", {{"a", blue, {}, false}}, true}}), blue) > 0);  // legend
  CHECK(count_color(plot.draw({{"t", "x", {{"", blue, {{3, 4}}, false}}, false}}), blue) > 0);
  CHECK(count_color(plot.draw({{"t", "x", {{"", blue, {{1, 5}, {2, 5}, {3, 5}}, false}}, false}}),
                    blue) > 100);
  CHECK(count_color(
            plot.draw({{"t", "x", {{"", blue, {{1, 5}, {2, nan}, {3, -1}, {4, 6}}, false}}, true}}),
            blue) > 100);
  CHECK(count_color(plot.draw({{"t", "x", {{"", blue, {{1, nan}, {2, nan}}, false}}, false}}),
                    blue) == 0);
  CHECK_THROWS(LinePlot(10, 10));
  CHECK_THROWS(plot.draw({}));
}
