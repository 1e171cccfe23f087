// SPDX-License-Identifier: Apache-2.0
// The one inner loop of every product: a tile of a few rows by a few panels, held in registers.
#if defined(LVGGT_KERNELS_TILE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LVGGT_KERNELS_TILE_INL_H_
#undef LVGGT_KERNELS_TILE_INL_H_
#else
#define LVGGT_KERNELS_TILE_INL_H_
#endif

#include <cstdint>

#include "kernels/prefetch-inl.h"
#include "kernels/simd-inl.h"
#include "lvggt/kernels/packed_matrix.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {

// Tile sizes. A step along K loads the panels' lines, broadcasts one value a row and does rows x
// vectors multiply-adds, so the accumulators should fill the register file:
//   32 registers of 16 lanes: 8 rows x 3 panels = 24 accumulators + 3 lines + 1 broadcast
//   16 registers of  8 lanes: 6 rows x 1 panel  = 12 accumulators + 2 vectors of the line + 1
//   broadcast 32 registers of  4 lanes: 6 rows x 1 panel  = 24 + 4 + 1 16 registers of  4 lanes: 2
//   rows x 1 panel  =  8 + 4 + 1
// Each hides the latency of a multiply-add (4 cycles, 2 a cycle: 8 accumulators at least), and
// loads less than one vector for each of them. All numbers of rows divide 24.
inline constexpr bool kManyRegisters =
    HWY_TARGET == HWY_AVX3 || HWY_TARGET == HWY_AVX3_DL || HWY_TARGET == HWY_NEON;
inline constexpr int kTileRows = kLanes == 16 ? 8 : (kLanes == 8 || kManyRegisters) ? 6 : 2;
inline constexpr int kTilePanels = kLanes == 16 ? 3 : 1;
inline constexpr int kPanelVectors = static_cast<int>(kPanelWidth) / kLanes;

// The operands of one column of tiles: num_rows rows times a few panels.
struct TileColumn {
  const float* const* rows;  // [taps, row_table_stride], addresses of at least k0 + K values
  std::int64_t num_rows;
  std::int64_t row_table_stride;
  std::int64_t taps;
  std::int64_t k0;
  std::int64_t K;
  const float* panels;        // lines of 16, taps * K a panel
  std::int64_t panel_stride;  // floats between two panels
  float* out;                 // [num_rows rounded up to kTileRows, out_stride]
  std::int64_t out_stride;
};

// out[r][n] (+)= sum over taps t and k < K of
//   rows[t * row_table_stride + r][k0 + k] * panels[n / 16][t * K + k][n % 16]
//   for r < num_rows and n < 16 kPanels. Rows are read in whole tiles: callers point the ones
//   beyond the matrix at any readable row and drop their sums.
// `next` is fetched meanwhile, from its part `part` on, one a tile.
// Not inlined: surrounded by other code, the row addresses no longer fit the registers, and
// reloading them at each step costs a fifth of the speed (measured with 16 registers).
template <int kPanels, bool kAccumulate>
HWY_NOINLINE void tile_column(const TileColumn& column, const Prefetch& next, std::int64_t part) {
  constexpr int kVectors = kPanels * kPanelVectors;
  const Floats d;
  const std::int64_t K = column.K, out_stride = column.out_stride;
  const std::int64_t panel_stride = column.panel_stride;
  float* HWY_RESTRICT out = column.out;
  for (std::int64_t first = 0; first < column.num_rows; first += kTileRows) {
    next.fetch_part(part++);
    hn::Vec<Floats> sum[kTileRows][kVectors];
#pragma GCC unroll 8
    for (int r = 0; r < kTileRows; ++r) {
#pragma GCC unroll 8
      for (int v = 0; v < kVectors; ++v) {
        sum[r][v] = kAccumulate ? hn::LoadU(d, out + r * out_stride + v * kLanes) : hn::Zero(d);
      }
    }
    for (std::int64_t t = 0; t < column.taps; ++t) {
      const float* HWY_RESTRICT row[kTileRows];
#pragma GCC unroll 8
      for (int r = 0; r < kTileRows; ++r) {
        row[r] = column.rows[t * column.row_table_stride + first + r] + column.k0;
      }
      const float* HWY_RESTRICT line = column.panels + t * K * kPanelWidth;
#pragma GCC unroll 1
      for (std::int64_t k = 0; k < K; ++k, line += kPanelWidth) {
        hn::Vec<Floats> b[kVectors];
#pragma GCC unroll 8
        for (int v = 0; v < kVectors; ++v) {
          b[v] = hn::LoadU(
              d, line + (v / kPanelVectors) * panel_stride + (v % kPanelVectors) * kLanes);
        }
#pragma GCC unroll 8
        for (int r = 0; r < kTileRows; ++r) {
          const auto a = hn::Set(d, row[r][k]);
#pragma GCC unroll 8
          for (int v = 0; v < kVectors; ++v) sum[r][v] = hn::MulAdd(a, b[v], sum[r][v]);
        }
      }
    }
#pragma GCC unroll 8
    for (int r = 0; r < kTileRows; ++r) {
#pragma GCC unroll 8
      for (int v = 0; v < kVectors; ++v)
        hn::StoreU(sum[r][v], d, out + r * out_stride + v * kLanes);
    }
    out += kTileRows * out_stride;
  }
}

constexpr std::int64_t num_panel_groups(std::int64_t num_panels) {
  return (num_panels + kTilePanels - 1) / kTilePanels;
}

// Splits num_panels into groups of at most kTilePanels, as even as possible, and calls group(first,
// count).
template <class Group>
HWY_INLINE void for_panel_groups(std::int64_t num_panels, const Group& group) {
  const std::int64_t groups = num_panel_groups(num_panels);
  std::int64_t first = 0;
  for (std::int64_t g = 0; g < groups; ++g) {
    const std::int64_t count = num_panels / groups + (g < num_panels % groups ? 1 : 0);
    group(first, count);
    first += count;
  }
}

// tile_column() for a number of panels known at run time, at most kTilePanels.
template <bool kAccumulate>
HWY_INLINE void tile_column_of(std::int64_t num_panels, const TileColumn& column,
                               const Prefetch& next, std::int64_t part) {
  if constexpr (kTilePanels >= 3) {
    if (num_panels == 3) return tile_column<3, kAccumulate>(column, next, part);
    if (num_panels == 2) return tile_column<2, kAccumulate>(column, next, part);
  }
  tile_column<1, kAccumulate>(column, next, part);
}

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
