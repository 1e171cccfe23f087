// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/field/label.h"

namespace lvggt {

// Averages an 8-bit picture down to at most max_width pixels in width; never enlarges.
//   pixels: [H, W, 3] -> [H', W', 3]
inline Tensor<std::uint8_t, 3> thumbnail(View<const std::uint8_t, 3> pixels,
                                         std::int64_t max_width) {
  const std::int64_t H = pixels.extent(0), W = pixels.extent(1), C = pixels.extent(2);
  const std::int64_t width = std::min(W, max_width);
  const std::int64_t height = std::max<std::int64_t>(1, (2 * H * width + W) / (2 * W));
  Tensor<std::uint8_t, 3> small(Shape{height, width, C});
  for (std::int64_t y = 0; y < height; ++y) {
    const std::int64_t top = y * H / height, bottom = std::max((y + 1) * H / height, top + 1);
    for (std::int64_t x = 0; x < width; ++x) {
      const std::int64_t left = x * W / width, right = std::max((x + 1) * W / width, left + 1);
      const std::int64_t count = (bottom - top) * (right - left);
      for (std::int64_t c = 0; c < C; ++c) {
        std::int64_t sum = 0;
        for (std::int64_t row = top; row < bottom; ++row)
          for (std::int64_t column = left; column < right; ++column) sum += pixels(row, column, c);
        small(y, x, c) = static_cast<std::uint8_t>((sum + count / 2) / count);
      }
    }
  }
  return small;
}

// One picture of a whole run: a column for each of some evenly spaced frames, a row for each kind
// of output. Frames come one by one and their number need not be known: every stride-th frame is
// kept, and when twice the columns are filled, every second one is dropped and the stride doubled.
// Memory is bounded by that.
class ContactSheet {
 public:
  struct Options {
    std::size_t max_columns = 8;
    std::int64_t cell_width = 176;  // pixels; larger frames are reduced to it
    int text_scale = 2;
    std::string title, footer;
  };

  // row_names label the rows from top to bottom.
  ContactSheet(std::vector<std::string> row_names, const Options& options)
      : row_names_(std::move(row_names)), options_(options) {
    LVGGT_CHECK(options.max_columns > 0 && options.cell_width > 0 && options.text_scale > 0 &&
                    !row_names_.empty(),
                "contact sheet: it needs at least one row and one column of at least one pixel");
  }

  // Whether the next frame will be kept; pictures need only be made for those.
  bool wants_next() const { return num_seen_ % stride_ == 0; }

  // Adds the next frame, with a caption and one picture for each row, empty where there is none.
  void add(const std::string& caption, const std::vector<View<const std::uint8_t, 3>>& pictures) {
    LVGGT_CHECK(pictures.size() == row_names_.size(), "contact sheet: there are ",
                row_names_.size(), " rows but ", pictures.size(), " pictures");
    if (wants_next()) {
      Column column{caption, {}};
      for (const auto& picture : pictures)
        column.cells.push_back(picture ? thumbnail(picture, options_.cell_width)
                                       : Tensor<std::uint8_t, 3>());
      columns_.push_back(std::move(column));
    }
    skip();
    if (columns_.size() == 2 * options_.max_columns) thin_out();
  }

  // Passes over a frame that is not wanted.
  void skip() { ++num_seen_; }

  bool empty() const { return columns_.empty(); }

  // The sheet so far, [H, W, 3]: at most max_columns of the kept frames, evenly chosen, from first
  // to last.
  Tensor<std::uint8_t, 3> render() const {
    LVGGT_CHECK(!columns_.empty(), "contact sheet: there are no frames");
    std::vector<const Column*> chosen;
    const std::size_t count = std::min(columns_.size(), options_.max_columns);
    for (std::size_t i = 0; i < count; ++i)
      chosen.push_back(
          &columns_[count == 1 ? 0 : (i * (columns_.size() - 1) + (count - 1) / 2) / (count - 1)]);

    const Layout layout = plan(chosen);
    Tensor<std::uint8_t, 3> sheet(Shape{layout.height, layout.width, std::int64_t{3}});
    std::fill_n(sheet.data(), sheet.size(), kBackground);
    draw_text(sheet, layout, chosen);
    for (std::size_t i = 0; i < chosen.size(); ++i)
      for (std::size_t row = 0; row < row_names_.size(); ++row)
        draw_cell(sheet, layout, i, row, chosen[i]->cells[row]);
    return sheet;
  }

 private:
  struct Column {
    std::string caption;
    std::vector<Tensor<std::uint8_t, 3>> cells;
  };
  struct Layout {
    std::int64_t line = 0;  // height of a line of text
    std::int64_t left = 0;  // width of the row names
    std::int64_t top = 0;   // height of title and captions
    std::int64_t cell_width = 0, cell_height = 0;
    std::int64_t width = 0, height = 0;
  };
  static constexpr std::int64_t kGap = 6;
  static constexpr std::uint8_t kBackground = 24;
  static constexpr Rgb8 kText{230, 230, 230}, kDimText{150, 150, 150};

  void thin_out() {
    std::vector<Column> kept;
    for (std::size_t i = 0; i < columns_.size(); i += 2) kept.push_back(std::move(columns_[i]));
    columns_ = std::move(kept);
    stride_ *= 2;
  }

  Layout plan(const std::vector<const Column*>& chosen) const {
    Layout layout;
    layout.line = kLabelHeight * options_.text_scale;
    for (const std::string& name : row_names_)
      layout.left = std::max<std::int64_t>(layout.left, label_width(name, options_.text_scale));
    layout.left += 2 * kGap;
    for (const Column* column : chosen) {
      for (const auto& cell : column->cells) {
        layout.cell_width = std::max(layout.cell_width, cell.extent(1));
        layout.cell_height = std::max(layout.cell_height, cell.extent(0));
      }
      layout.cell_width = std::max<std::int64_t>(layout.cell_width,
                                                 label_width(column->caption, options_.text_scale));
    }
    layout.top = 2 * layout.line + 2 * kGap;
    layout.width =
        layout.left + static_cast<std::int64_t>(chosen.size()) * (layout.cell_width + kGap);
    for (const std::string& text : {options_.title, options_.footer})
      layout.width =
          std::max<std::int64_t>(layout.width, label_width(text, options_.text_scale) + 2 * kGap);
    layout.height = layout.top +
                    static_cast<std::int64_t>(row_names_.size()) * (layout.cell_height + kGap) +
                    layout.line + kGap;
    return layout;
  }

  static std::int64_t cell_x(const Layout& layout, std::size_t column) {
    return layout.left + static_cast<std::int64_t>(column) * (layout.cell_width + kGap);
  }
  static std::int64_t cell_y(const Layout& layout, std::size_t row) {
    return layout.top + static_cast<std::int64_t>(row) * (layout.cell_height + kGap);
  }

  void draw_text(View<std::uint8_t, 3> sheet, const Layout& layout,
                 const std::vector<const Column*>& chosen) const {
    const int scale = options_.text_scale;
    draw_label(sheet, kGap, kGap, options_.title, scale, kText);
    for (std::size_t i = 0; i < chosen.size(); ++i)
      draw_label(sheet, cell_x(layout, i), kGap + layout.line, chosen[i]->caption, scale, kDimText);
    for (std::size_t row = 0; row < row_names_.size(); ++row)
      draw_label(sheet, kGap, cell_y(layout, row) + (layout.cell_height - layout.line) / 2,
                 row_names_[row], scale, kText);
    draw_label(sheet, kGap, layout.height - layout.line, options_.footer, scale, kDimText);
  }

  static void draw_cell(View<std::uint8_t, 3> sheet, const Layout& layout, std::size_t column,
                        std::size_t row, View<const std::uint8_t, 3> cell) {
    for (std::int64_t y = 0; y < cell.extent(0); ++y)
      std::copy_n(cell[y].data(), cell.extent(1) * 3,
                  sheet[cell_y(layout, row) + y][cell_x(layout, column)].data());
  }

  std::vector<std::string> row_names_;
  Options options_;
  std::vector<Column> columns_;
  std::int64_t num_seen_ = 0;
  std::int64_t stride_ = 1;
};

}  // namespace lvggt
