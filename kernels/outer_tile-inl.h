// SPDX-License-Identifier: Apache-2.0
// The inner loop of the weight gradient: a tile of the result, summed over pixels in registers.
#if defined(LVGGT_KERNELS_OUTER_TILE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LVGGT_KERNELS_OUTER_TILE_INL_H_
#undef LVGGT_KERNELS_OUTER_TILE_INL_H_
#else
#define LVGGT_KERNELS_OUTER_TILE_INL_H_
#endif

#include <algorithm>
#include <cstdint>

#include "kernels/tile-inl.h"
#include "kernels/weight_gradient_plan.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {

// Some channels of a rectangle of pixels, fetched into the second-level cache a few lines at a time
// while the rectangle before it is worked on: copying it would else wait for memory.
class Fetch {
 public:
  Fetch() = default;
  // Rows and columns are clipped to the map; `channels` from `first` on.
  Fetch(View<const float, 4> map, std::int64_t b, Range rows, Range columns, std::int64_t first,
        std::int64_t channels)
      : rows_(std::min(rows.end, map.extent(1)) - std::max<std::int64_t>(rows.begin, 0)),
        columns_(std::min(columns.end, map.extent(2)) - std::max<std::int64_t>(columns.begin, 0)),
        floats_(std::min(channels, map.extent(3) - first)),
        row_stride_(map.stride(1)),
        column_stride_(map.stride(2)),
        row_(map.data() + b * map.stride(0) +
             std::max<std::int64_t>(rows.begin, 0) * map.stride(1) +
             std::max<std::int64_t>(columns.begin, 0) * map.stride(2) + first) {}

  std::int64_t lines() const {
    return std::max<std::int64_t>(rows_, 0) * std::max<std::int64_t>(columns_, 0) *
           ceil_div(floats_, kLine);
  }

  HWY_INLINE void fetch(std::int64_t count) {
    for (; count > 0 && rows_ > 0 && columns_ > 0; --count) {
      __builtin_prefetch(row_ + column_ * column_stride_ + float_, 0, 2);
      float_ += kLine;
      if (float_ < floats_) continue;
      float_ = 0;
      if (++column_ < columns_) continue;
      column_ = 0;
      row_ += row_stride_;
      --rows_;
    }
  }

 private:
  static constexpr std::int64_t kLine = 16;  // floats
  std::int64_t rows_ = 0, columns_ = 0, floats_ = 0;
  std::int64_t row_stride_ = 0, column_stride_ = 0;
  const float* row_ = nullptr;
  std::int64_t column_ = 0, float_ = 0;
};

// What to fetch next, in equal shares for the rows of the tiles in between.
struct NextRectangle {
  Fetch dy, x;
  std::int64_t dy_lines = 0, x_lines = 0;

  HWY_INLINE void fetch() {
    dy.fetch(dy_lines);
    x.fetch(x_lines);
  }
};

// sums[r][n] += sum over rows i and columns j of x[i][j][r] dy[i][j][n], for r < kTileRows and n <
// 16 kPanels: the tile of every product (see tile-inl.h), with both operands advancing along the
// summed axis.
template <int kPanels>
HWY_NOINLINE void outer_tile(const float* HWY_RESTRICT x, std::int64_t x_row,
                             const float* HWY_RESTRICT dy, std::int64_t panel_stride,
                             std::int64_t rows, std::int64_t columns, float* HWY_RESTRICT sums,
                             std::int64_t sums_stride, NextRectangle& next) {
  constexpr int kVectors = kPanels * kPanelVectors;
  const Floats d;
  hn::Vec<Floats> sum[kTileRows][kVectors];
#pragma GCC unroll 8
  for (int r = 0; r < kTileRows; ++r) {
#pragma GCC unroll 8
    for (int v = 0; v < kVectors; ++v)
      sum[r][v] = hn::LoadU(d, sums + r * sums_stride + v * kLanes);
  }
  for (std::int64_t i = 0; i < rows; ++i) {
    next.fetch();
    const float* HWY_RESTRICT a = x + i * x_row;
#pragma GCC unroll 1
    for (std::int64_t j = 0; j < columns; ++j, a += kTileRows, dy += kPanelWidth) {
      hn::Vec<Floats> b[kVectors];
#pragma GCC unroll 8
      for (int v = 0; v < kVectors; ++v) {
        b[v] = hn::LoadU(d, dy + (v / kPanelVectors) * panel_stride + (v % kPanelVectors) * kLanes);
      }
#pragma GCC unroll 8
      for (int r = 0; r < kTileRows; ++r) {
        const auto value = hn::Set(d, a[r]);
#pragma GCC unroll 8
        for (int v = 0; v < kVectors; ++v) sum[r][v] = hn::MulAdd(value, b[v], sum[r][v]);
      }
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < kTileRows; ++r) {
#pragma GCC unroll 8
    for (int v = 0; v < kVectors; ++v)
      hn::StoreU(sum[r][v], d, sums + r * sums_stride + v * kLanes);
  }
}

HWY_INLINE void outer_tile_of(std::int64_t panels, const float* x, std::int64_t x_row,
                              const float* dy, std::int64_t panel_stride, std::int64_t rows,
                              std::int64_t columns, float* sums, std::int64_t sums_stride,
                              NextRectangle& next) {
  if constexpr (kTilePanels >= 3) {
    if (panels == 3)
      return outer_tile<3>(x, x_row, dy, panel_stride, rows, columns, sums, sums_stride, next);
    if (panels == 2)
      return outer_tile<2>(x, x_row, dy, panel_stride, rows, columns, sums, sums_stride, next);
  }
  outer_tile<1>(x, x_row, dy, panel_stride, rows, columns, sums, sums_stride, next);
}

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
