// SPDX-License-Identifier: Apache-2.0
// Private: how a product is cut into chunks, the unit of parallel work and of reuse.
#pragma once

#include <algorithm>
#include <cstdint>

#include "lvggt/kernels/packed_matrix.h"

namespace lvggt::kernels {

// At most kChunkRows rows times kChunkPanels panels.
//  - its inputs for one K block, 192 x 256 floats or 192 KiB, stay in a second-level cache of
//    512 KiB with the panels in use; they are read where they lie, since copying them closer cost
//    4 % and saved nothing;
//  - its sums, 192 x 512 floats, pass through once for each K block;
//  - a panel is read from the third level once for all 192 rows.
// Of 96 to 288 rows times 16 to 48 panels, from 192 x 32 on more made no difference (bench_gemm,
// 1 MiB); 96 x 24 with copied inputs is slower by 5 % of peak.
inline constexpr std::int64_t kChunkRows = 192;  // a multiple of every tile's rows
inline constexpr std::int64_t kChunkPanels = 32;

// A product's rows and panels in row_chunks x panel_chunks nearly equal parts; rows are cut at
// multiples of a tile's. Sums do not depend on the cut, so that it may follow the thread count.
struct Chunks {
  std::int64_t M = 0;
  std::int64_t tile_rows = 1;
  std::int64_t panels = 0;
  std::int64_t row_chunks = 1;
  std::int64_t panel_chunks = 1;

  struct Range {
    std::int64_t begin = 0, end = 0;
  };
  std::int64_t count() const { return row_chunks * panel_chunks; }
  // Chunks of the same rows follow each other, so that a thread finds the rows in its cache.
  Range rows_of(std::int64_t chunk) const {
    const std::int64_t i = chunk / panel_chunks, tiles = (M + tile_rows - 1) / tile_rows;
    return {tiles * i / row_chunks * tile_rows,
            std::min(M, tiles * (i + 1) / row_chunks * tile_rows)};
  }
  Range panels_of(std::int64_t chunk) const {
    const std::int64_t i = chunk % panel_chunks;
    return {panels * i / panel_chunks, panels * (i + 1) / panel_chunks};
  }
};

// The cut that ends first when `threads` threads take chunks in turn. In units of one tile times
// one panel, a chunk of u tiles and p panels costs u p to multiply, about 0.7 u for its rows and
// 0.5 p for its panels. Both were measured at K = 1024 when rows were still copied, on cores with
// 32 KiB and 512 KiB of cache: they rank the cuts, they do not predict times.
inline Chunks plan_chunks(std::int64_t M, std::int64_t panels, std::int64_t tile_rows,
                          std::int64_t threads) {
  const auto ceil_div = [](std::int64_t a, std::int64_t b) { return (a + b - 1) / b; };
  const std::int64_t tiles = ceil_div(M, tile_rows);
  Chunks best{M, tile_rows, panels, ceil_div(tiles, kChunkRows / tile_rows),
              ceil_div(panels, kChunkPanels)};
  if (threads == 1 || best.count() >= 64 * threads) return best;  // an uneven end does not show
  double shortest = 0;
  const Chunks coarsest = best;
  const std::int64_t most_rows = std::min(tiles, coarsest.row_chunks + 3);
  const std::int64_t most_panels = std::min(panels, 8 * coarsest.panel_chunks);
  for (std::int64_t r = coarsest.row_chunks; r <= most_rows; ++r) {
    for (std::int64_t c = coarsest.panel_chunks; c <= most_panels; ++c) {
      const auto u = static_cast<double>(ceil_div(tiles, r));
      const auto p = static_cast<double>(ceil_div(panels, c));
      const double time =
          static_cast<double>(ceil_div(r * c, threads)) * (u * p + 0.7 * u + 0.5 * p);
      if (shortest != 0 && time >= shortest) continue;
      shortest = time;
      best.row_chunks = r;
      best.panel_chunks = c;
    }
  }
  return best;
}

}  // namespace lvggt::kernels
