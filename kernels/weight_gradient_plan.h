// SPDX-License-Identifier: Apache-2.0
// Private: how a weight gradient is split into tasks and blocks of pixels.
#pragma once

#include <algorithm>
#include <cstdint>

#include "lvggt/core/tensor.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt::kernels {

constexpr std::int64_t ceil_div(std::int64_t a, std::int64_t b) { return (a + b - 1) / b; }

// Part i of n when [0, count) is cut into n parts as even as possible.
struct Range {
  std::int64_t begin, end;
  std::int64_t size() const { return end - begin; }
};
constexpr Range part_of(std::int64_t count, std::int64_t i, std::int64_t n) {
  return {count * i / n, count * (i + 1) / n};
}

// The part that i lies in.
constexpr std::int64_t part_with(std::int64_t count, std::int64_t i, std::int64_t n) {
  return ((i + 1) * n - 1) / count;
}

// The weight gradient is a product whose summed axis is the pixels of dy. A task owns a block of
// its result (some input channels, all taps, some output channels) and a share of the pixels, which
// it walks in small rectangles: the rectangle of dy and the pixels of x under it are copied side by
// side, then every tile of the result adds the rectangle's contribution in registers.
//
// Sizes. A copied value of x takes part in taps * 16 panels multiply-adds, one of dy in taps *
// inputs: with 576 / taps input channels and up to 9 panels, copying is 2 % of the instructions,
// but more of the time, because it waits for memory. For a 3x3 kernel that makes, in floats,
//   result  9 x 64 x 144      324 KiB, passed through once a rectangle
//   dy      384 pixels x 144  216 KiB
//   x       1.35 x 384 x 64   130 KiB
// for the second-level cache, of which a tile reads 3 panels of dy (72 KiB) and 8 channels of x (16
// KiB). Measured with 1 MiB: half the channels or half the pixels lose 3 to 8 % of the speed.
struct WeightGradientPlan {
  static constexpr std::int64_t kBlockPanels = 9;
  static constexpr std::int64_t kRowsPerTapSum = 576;
  static constexpr std::int64_t kBlockPixels = 384;
  static constexpr std::int64_t kBlockWidth = 64;
  // Tasks to balance dozens of threads; more shares of the pixels than needed for that would only
  // be more partial sums.
  static constexpr std::int64_t kTasks = 64;

  Shape<4> dy, x;  // [B, Ho, Wo, Cout], [B, H, W, Cin]
  std::int64_t kernel = 0, stride = 0, padding = 0;
  std::int64_t tile_rows = 0;  // of the instruction set

  std::int64_t input_groups = 0;                   // of tile_rows input channels
  std::int64_t input_blocks = 0;                   // of groups
  std::int64_t output_panels = 0;                  // of 16 output channels
  std::int64_t output_blocks = 0;                  // of panels
  std::int64_t block_height = 0, block_width = 0;  // of a rectangle of dy, at most
  std::int64_t down = 0, across = 0;               // rectangles of an image
  std::int64_t shares = 0;                         // of the pixels

  WeightGradientPlan(Shape<4> dy_shape, Shape<4> x_shape, std::int64_t kernel_size,
                     std::int64_t stride_size, std::int64_t padding_size, std::int64_t rows)
      : dy(dy_shape),
        x(x_shape),
        kernel(kernel_size),
        stride(stride_size),
        padding(padding_size),
        tile_rows(rows) {
    const std::int64_t taps = kernel * kernel;
    input_groups = ceil_div(x[3], tile_rows);
    const std::int64_t groups = std::max<std::int64_t>(1, kRowsPerTapSum / taps / tile_rows);
    input_blocks = ceil_div(input_groups, groups);
    output_panels = num_panels(dy[3]);
    output_blocks = ceil_div(output_panels, kBlockPanels);
    across = ceil_div(dy[2], kBlockWidth);
    block_width = ceil_div(dy[2], across);
    down = ceil_div(dy[1], std::max<std::int64_t>(1, kBlockPixels / block_width));
    block_height = ceil_div(dy[1], down);
    shares = std::clamp<std::int64_t>(ceil_div(kTasks, input_blocks * output_blocks), 1,
                                      std::max<std::int64_t>(1, rectangles() / 4));
  }

  std::int64_t rectangles() const { return dy[0] * down * across; }
  std::int64_t tasks() const { return shares * input_blocks * output_blocks; }
  std::int64_t taps() const { return kernel * kernel; }
  std::int64_t max_groups() const { return ceil_div(input_groups, input_blocks); }
  std::int64_t max_panels() const { return ceil_div(output_panels, output_blocks); }

  // Rows (or columns) of x that rows (or columns) of dy read; some may lie beyond the border.
  Range inputs_of(Range outputs) const {
    return {outputs.begin * stride - padding, (outputs.end - 1) * stride - padding + kernel};
  }

  // Pixels of x under a rectangle: rows one below the other; in a row, the columns of equal residue
  // modulo the stride lie side by side, so that one tap reads neighbours for neighbouring outputs.
  std::int64_t x_rows(std::int64_t height) const { return (height - 1) * stride + kernel; }
  std::int64_t x_columns(std::int64_t width) const { return width + (kernel - 1) / stride; }
  // The last pixel's values are copied by whole vectors, which may be wider than a tile has rows.
  std::int64_t x_floats() const {
    return kPanelWidth +
           max_groups() * tile_rows * x_rows(block_height) * stride * x_columns(block_width);
  }
  std::int64_t dy_floats() const { return max_panels() * kPanelWidth * block_height * block_width; }
  // [taps, groups, tile_rows, 16 panels]
  std::int64_t sum_floats() const {
    return taps() * max_groups() * tile_rows * max_panels() * kPanelWidth;
  }
  std::int64_t total_floats() const { return taps() * tile_rows * kPanelWidth; }
};

}  // namespace lvggt::kernels
