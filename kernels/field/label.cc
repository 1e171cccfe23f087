// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/label.h"

#include <algorithm>
#include <cmath>
#include <vector>

#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#endif
#include <stb_easy_font.h>
#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif

namespace lvggt {
namespace {

// One corner of stb_easy_font's rectangles, as it lays them out.
struct Vertex {
  float x, y, z;
  unsigned char color[4];
};

// stb_easy_font takes a non-const char* and indexes its table by the character.
std::string printable(const std::string& text) {
  std::string ascii = text;
  for (char& c : ascii)
    if (c < 0x20 || c > 0x7e) c = '?';
  return ascii;
}

}  // namespace

int label_width(const std::string& text, int scale) {
  std::string ascii = printable(text);
  return scale * stb_easy_font_width(ascii.data());
}

void draw_label(View<std::uint8_t, 3> pixels, std::int64_t x, std::int64_t y,
                const std::string& text, int scale, const Rgb8& color) {
  std::string ascii = printable(text);
  // A character is at most 32 rectangles of four corners.
  std::vector<Vertex> corners(ascii.size() * 32 * 4 + 4);
  const int num_rectangles = stb_easy_font_print(0, 0, ascii.data(), nullptr, corners.data(),
                                                 static_cast<int>(corners.size() * sizeof(Vertex)));
  const std::int64_t H = pixels.extent(0), W = pixels.extent(1);
  for (int i = 0; i < num_rectangles; ++i) {
    const Vertex& from = corners[static_cast<std::size_t>(4 * i)];
    const Vertex& to = corners[static_cast<std::size_t>(4 * i + 2)];
    const auto left = x + std::lround(from.x * static_cast<float>(scale));
    const auto right = x + std::lround(to.x * static_cast<float>(scale));
    const auto top = y + std::lround(from.y * static_cast<float>(scale));
    const auto bottom = y + std::lround(to.y * static_cast<float>(scale));
    for (std::int64_t row = std::max<std::int64_t>(top, 0); row < std::min(bottom, H); ++row)
      for (std::int64_t column = std::max<std::int64_t>(left, 0); column < std::min(right, W);
           ++column)
        std::ranges::copy(color, pixels[row][column].data());
  }
}

}  // namespace lvggt
