// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/contact_sheet.h"

#include <doctest/doctest.h>

#include <set>

using namespace lvggt;

namespace {

Tensor<std::uint8_t, 3> plain(std::int64_t H, std::int64_t W, std::uint8_t value) {
  Tensor<std::uint8_t, 3> picture(Shape{H, W, std::int64_t{3}});
  std::fill_n(picture.data(), picture.size(), value);
  return picture;
}

// The grey values of cells found on the middle line of the first row.
std::set<int> cells_shown(const Tensor<std::uint8_t, 3>& sheet, int cell_height) {
  std::set<int> values;
  for (std::int64_t y = 0; y < sheet.extent(0); ++y) {
    std::int64_t run = 0;
    for (std::int64_t x = 1; x < sheet.extent(1); ++x) {
      const bool same =
          sheet(y, x, 0) == sheet(y, x - 1, 0) && sheet(y, x, 0) >= 40 && sheet(y, x, 0) < 140;
      run = same ? run + 1 : 0;
      if (run == cell_height) values.insert(sheet(y, x, 0));
    }
  }
  return values;
}

}  // namespace

TEST_CASE(
    "ContactSheet: shows the first and the last frames and bounds its memory by thinning out") {
  for (const int num_frames : {1, 2, 3, 4, 5, 7, 8, 63, 100}) {
    ContactSheet sheet({"input"}, {4, 16, 1, "title", "footer"});
    int pictures_made = 0;
    for (int i = 0; i < num_frames; ++i) {
      if (!sheet.wants_next()) {
        sheet.skip();
        continue;
      }
      ++pictures_made;
      sheet.add(std::to_string(i), {plain(12, 16, static_cast<std::uint8_t>(40 + i))});
    }
    const auto shown = cells_shown(sheet.render(), 12);
    CHECK(shown.size() == static_cast<std::size_t>(std::min(num_frames, 4)));
    CHECK(*shown.begin() == 40);
    CHECK(*shown.rbegin() >= 40 + num_frames - 1 - num_frames / 4);
    CHECK(pictures_made <= 4 * 8 + 8);
  }
}

TEST_CASE("ContactSheet: an empty picture leaves its cell free; frames may be wider than a cell") {
  ContactSheet sheet({"input", "rgb"}, {3, 20, 1, "", ""});
  sheet.add("0", {plain(30, 40, 100), {}});
  const auto rendered = sheet.render();
  CHECK(cells_shown(rendered, 15) == std::set<int>{100});
  CHECK_THROWS_WITH_AS(sheet.add("1", {plain(30, 40, 100)}), doctest::Contains("2 rows"), Error);
}

TEST_CASE("ContactSheet: without frames there is nothing to render") {
  ContactSheet sheet({"input"}, {3, 20, 1, "", ""});
  CHECK(sheet.empty());
  CHECK_THROWS_AS(sheet.render(), Error);
}

TEST_CASE("thumbnail: averages areas, keeps the aspect, never enlarges") {
  Tensor<std::uint8_t, 3> picture(Shape{2, 4, 3});
  for (std::int64_t i = 0; i < picture.size(); ++i)
    picture.data()[i] = static_cast<std::uint8_t>(10 * (i / 3));
  const auto half = thumbnail(picture, 2);
  CHECK(half.shape() == Shape{1, 2, 3});
  CHECK(half(0, 0, 0) == 25);  // (0 + 10 + 40 + 50) / 4
  CHECK(half(0, 1, 2) == 45);
  CHECK(thumbnail(picture, 100).shape() == picture.shape());
}

TEST_CASE("draw_label: draws inside its width, cuts at the picture's edge, survives any byte") {
  auto picture = plain(20, 60, 0);
  draw_label(picture, 2, 2, "depth 12", 1, {255, 200, 100});
  std::int64_t lit = 0, rightmost = 0;
  for (std::int64_t y = 0; y < 20; ++y)
    for (std::int64_t x = 0; x < 60; ++x)
      if (picture(y, x, 0) == 255) {
        ++lit;
        rightmost = std::max(rightmost, x);
        CHECK(picture(y, x, 1) == 200);
      }
  CHECK(lit > 60);
  CHECK(rightmost < 2 + label_width("depth 12", 1));
  draw_label(picture, -30, -5, "across the edge of a picture", 3, {1, 2, 3});
  draw_label(picture, 50, 15, std::string("\x80\xff\n\0\x01", 5), 2, {1, 2, 3});
  draw_label(picture, 0, 0, "", 2, {1, 2, 3});
  CHECK(label_width("", 2) == 0);
}
