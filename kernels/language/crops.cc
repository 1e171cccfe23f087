// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/crops.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <map>

#include "lvggt/core/parallel.h"
#include "lvggt/language/clip.h"

namespace lvggt {
namespace {

constexpr int kWeightBits = 11;

// Two neighbours of an output position and their weights, which sum to 2048.
struct Tap {
  std::int64_t first = 0, second = 0;
  std::int32_t w0 = 0, w1 = 0;
};

// Columns that lie at or beyond the edge take the edge pixel alone; rows clamp their indices only.
Tap tap_at(std::int64_t position, std::int64_t from, std::int64_t to, bool column) {
  const double scale = static_cast<double>(from) / static_cast<double>(to);
  float f = static_cast<float>((static_cast<double>(position) + 0.5) * scale - 0.5);
  auto i = static_cast<std::int64_t>(std::floor(f));
  f -= static_cast<float>(i);
  if (column && (i < 0 || i >= from - 1)) {
    f = 0;
    i = std::clamp<std::int64_t>(i, 0, from - 1);
  }
  constexpr float kOne = 1 << kWeightBits;
  Tap tap;
  tap.w0 = static_cast<std::int32_t>(std::lrint((1.0f - f) * kOne));
  tap.w1 = static_cast<std::int32_t>(std::lrint(f * kOne));
  tap.first = std::clamp<std::int64_t>(i, 0, from - 1);
  tap.second = std::clamp<std::int64_t>(i + 1, 0, from - 1);
  return tap;
}

void average_pairs(View<std::uint8_t, 3> out, View<const std::uint8_t, 3> in) {
  for (std::int64_t y = 0; y < out.extent(0); ++y)
    for (std::int64_t x = 0; x < out.extent(1); ++x)
      for (std::int64_t c = 0; c < 3; ++c)
        out(y, x, c) =
            static_cast<std::uint8_t>((in(2 * y, 2 * x, c) + in(2 * y, 2 * x + 1, c) +
                                       in(2 * y + 1, 2 * x, c) + in(2 * y + 1, 2 * x + 1, c) + 2) >>
                                      2);
}

// Horizontal sums of one input row.
void blend_columns(std::int32_t* sums, const std::uint8_t* row, const std::vector<Tap>& taps) {
  for (const Tap& tap : taps)
    for (std::int64_t c = 0; c < 3; ++c)
      *sums++ = row[3 * tap.first + c] * tap.w0 + row[3 * tap.second + c] * tap.w1;
}

}  // namespace

std::vector<ObjectBox> find_objects(View<const std::int32_t, 2> labels) {
  struct Extent {
    std::int64_t left, right, top, bottom;
  };
  std::map<std::int32_t, Extent> extents;
  for (std::int64_t y = 0; y < labels.extent(0); ++y) {
    for (std::int64_t x = 0; x < labels.extent(1); ++x) {
      const std::int32_t label = labels(y, x);
      if (label <= 0) continue;
      Extent& e = extents.try_emplace(label, Extent{x, x, y, y}).first->second;
      e.left = std::min(e.left, x);
      e.right = std::max(e.right, x);
      e.bottom = y;
    }
  }
  std::vector<ObjectBox> boxes;
  for (const auto& [label, e] : extents)
    boxes.push_back({label, e.left, e.top, e.right - e.left, e.bottom - e.top});
  return boxes;
}

Tensor<std::uint8_t, 3> object_crop(View<const std::uint8_t, 3> rgb,
                                    View<const std::int32_t, 2> labels, const ObjectBox& box) {
  LVGGT_CHECK(
      rgb.extent(0) == labels.extent(0) && rgb.extent(1) == labels.extent(1) && rgb.extent(2) == 3,
      "object_crop: the picture is ", rgb.shape(), " but its labels are ", labels.shape());
  LVGGT_CHECK(!box.dropped() && box.x >= 0 && box.y >= 0 && box.x + box.width <= labels.extent(1) &&
                  box.y + box.height <= labels.extent(0),
              "object_crop: the box ", Shape{box.x, box.y, box.width, box.height}, " of label ",
              box.label, " is empty or outside of ", labels.shape());
  const std::int64_t side = std::max(box.width, box.height);
  const std::int64_t left = (side - box.width) / 2, top = (side - box.height) / 2;
  Tensor<std::uint8_t, 3> square(Shape{side, side, std::int64_t{3}});
  for (std::int64_t y = 0; y < box.height; ++y)
    for (std::int64_t x = 0; x < box.width; ++x)
      if (labels(box.y + y, box.x + x) == box.label)
        std::memcpy(&square(top + y, left + x, 0), &rgb(box.y + y, box.x + x, 0), 3);
  return square;
}

void resize_linear_u8(View<std::uint8_t, 3> out, View<const std::uint8_t, 3> in) {
  const std::int64_t S = out.extent(0), N = in.extent(0);
  LVGGT_CHECK(out.shape() == (Shape{S, S, std::int64_t{3}}) &&
                  in.shape() == (Shape{N, N, std::int64_t{3}}) && S > 0 && N > 0,
              "resize_linear_u8: ", in.shape(), " cannot become ", out.shape());
  if (N == 2 * S) return average_pairs(out, in);
  std::vector<Tap> columns;
  for (std::int64_t x = 0; x < S; ++x) columns.push_back(tap_at(x, N, S, true));
  std::vector<std::int32_t> first(static_cast<std::size_t>(3 * S)), second(first.size());
  std::int64_t first_row = -1, second_row = -1;
  for (std::int64_t y = 0; y < S; ++y) {
    const Tap tap = tap_at(y, N, S, false);
    if (tap.first == second_row) {
      first.swap(second);
      std::swap(first_row, second_row);
    }
    if (tap.first != first_row) blend_columns(first.data(), in[tap.first].data(), columns);
    if (tap.second != second_row) blend_columns(second.data(), in[tap.second].data(), columns);
    first_row = tap.first;
    second_row = tap.second;
    std::uint8_t* to = out[y].data();
    for (std::size_t i = 0; i < first.size(); ++i)
      to[i] = static_cast<std::uint8_t>(
          (((tap.w0 * (first[i] >> 4)) >> 16) + ((tap.w1 * (second[i] >> 4)) >> 16) + 2) >> 2);
  }
}

void clip_normalize(View<float, 3> out, View<const std::uint8_t, 3> in) {
  LVGGT_CHECK(out.shape() == in.shape() && in.extent(2) == 3, "clip_normalize: ", in.shape(),
              " cannot become ", out.shape());
  for (std::int64_t y = 0; y < in.extent(0); ++y)
    for (std::int64_t x = 0; x < in.extent(1); ++x)
      for (std::int64_t c = 0; c < 3; ++c)
        out(y, x, c) = (static_cast<float>(in(y, x, c)) / 255.0f - kClipMean[c]) / kClipStd[c];
}

void clip_object_pixels(View<float, 4> pixels, View<const std::uint8_t, 3> rgb,
                        View<const std::int32_t, 2> labels, const std::vector<ObjectBox>& boxes,
                        Context& ctx) {
  const std::int64_t S = pixels.extent(1);
  LVGGT_CHECK(
      pixels.shape() == (Shape{static_cast<std::int64_t>(boxes.size()), S, S, std::int64_t{3}}),
      "clip_object_pixels: pixels are ", pixels.shape(), " but there are ", boxes.size(),
      " objects");
  parallel_rows(
      pixels.extent(0), 1,
      [&](std::int64_t begin, std::int64_t end) {
        Tensor<std::uint8_t, 3> resized(Shape{S, S, std::int64_t{3}});
        for (std::int64_t i = begin; i < end; ++i) {
          resize_linear_u8(resized, object_crop(rgb, labels, boxes[static_cast<std::size_t>(i)]));
          clip_normalize(pixels[i], resized);
        }
      },
      ctx);
}

}  // namespace lvggt
