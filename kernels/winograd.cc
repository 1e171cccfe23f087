// SPDX-License-Identifier: Apache-2.0
// A tile of 2x2 outputs Y of one channel reads 4x4 inputs d. With the filter g,
//   Y = A^T [ sum over input channels of (G g G^T) * (B^T d B) ] A        (* element by element)
//   B^T = | 1  0 -1  0 |    G = |  1    0    0  |    A^T = | 1  1  1  0 |
//         | 0  1  1  0 |        | 1/2  1/2  1/2 |          | 0  1 -1 -1 |
//         | 0 -1  1  0 |        | 1/2 -1/2  1/2 |
//         | 0  1  0 -1 |        |  0    0    1  |
// so that each of the 16 positions of a tile is a product [tiles, Cin] x [Cin, Cout] of its own:
// 16 multiplications a tile and pair of channels instead of 36.
#include "kernels/winograd.h"

#include <algorithm>

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/winograd.cc"
#include "hwy/foreach_target.h"
//
#include "hwy/highway.h"
#include "kernels/epilogue-inl.h"
#include "kernels/prefetch-inl.h"
#include "kernels/simd-inl.h"
#include "kernels/storage-inl.h"
#include "kernels/tile-inl.h"

#ifndef LVGGT_WINOGRAD_ONCE
#define LVGGT_WINOGRAD_ONCE
namespace lvggt::kernels {

inline constexpr std::int64_t kPositions = 16;
// Tiles of a chunk, at most: the epilogue takes their pixels at once.
inline constexpr std::int64_t kMostTiles = 96;
// A tile's transformed inputs are this much longer than its channels, so that the rows do not
// compete for the same cache sets.
inline constexpr std::int64_t kInputGap = 16;
// Panels of one turn: their sums stay near while the 16 positions are computed.
inline constexpr std::int64_t kTurnPanels = 3;
inline constexpr std::int64_t kTurnPitch = kTurnPanels * kPanelWidth;

// Tiles of a chunk: their transformed inputs fill most of a second-level cache of 512 KiB, in
// multiples of 24 because every instruction set's tile of rows divides that.
constexpr std::int64_t chunk_tiles(std::int64_t Cin) {
  const std::int64_t fit = 416 * 1024 / (kPositions * 4 * (Cin + kInputGap));
  return std::clamp<std::int64_t>(fit / 24 * 24, 24, kMostTiles);
}

// One worker's scratch for a chunk of T tiles.
struct WinogradScratch {
  float* inputs;           // [16, T, Cin + kInputGap]: B^T d B
  float* products;         // [16, T, kTurnPitch]
  float* sums;             // [4 T, kSumPitch], pixels of the turn
  const float** rows;      // [16, T]
  float** y_rows;          // [4 T]
  const float** residual;  // [4 T]
  std::int64_t* pixels;    // [4 T]: which of a tile's sums each row of the table is
};

struct WinogradRun {
  Product product;         // the epilogue and the number of channels
  const float* weights;    // [panels, 16, Cin, 16]: G g G^T
  View<float, 4> y;        // [B, H, W, Cout]
  View<const float, 4> x;  // [B, H, W, Cin]
  View<const float, 4> residual;
  const float* zeros;  // [Cin], what lies beyond the border
  std::int64_t tiles_down, tiles_across;
};

}  // namespace lvggt::kernels
#endif

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// G g G^T of one panel.   lines: [9, Cin, 16]   out: [16, Cin, 16]
void transform_weights(float* HWY_RESTRICT out, const float* HWY_RESTRICT lines, std::int64_t Cin) {
  const Floats d;
  const std::int64_t pitch = Cin * kPanelWidth;
  const auto half = hn::Set(d, 0.5f);
  for (std::int64_t i = 0; i < pitch; i += kLanes) {
    hn::Vec<Floats> t[4][3];  // G g
    for (int x = 0; x < 3; ++x) {
      const auto g0 = hn::LoadU(d, lines + x * pitch + i);
      const auto g1 = hn::LoadU(d, lines + (3 + x) * pitch + i);
      const auto g2 = hn::LoadU(d, lines + (6 + x) * pitch + i);
      const auto ends = hn::Add(g0, g2);
      t[0][x] = g0;
      t[1][x] = hn::Mul(half, hn::Add(ends, g1));
      t[2][x] = hn::Mul(half, hn::Sub(ends, g1));
      t[3][x] = g2;
    }
    for (int y = 0; y < 4; ++y) {
      float* to = out + 4 * y * pitch + i;
      const auto ends = hn::Add(t[y][0], t[y][2]);
      hn::StoreU(t[y][0], d, to);
      hn::StoreU(hn::Mul(half, hn::Add(ends, t[y][1])), d, to + pitch);
      hn::StoreU(hn::Mul(half, hn::Sub(ends, t[y][1])), d, to + 2 * pitch);
      hn::StoreU(t[y][2], d, to + 3 * pitch);
    }
  }
}

// B^T d B of one tile.   pixels: 4x4 addresses   out: 16 rows of Cin, `pitch` apart
void transform_inputs(float* HWY_RESTRICT out, std::int64_t pitch, const float* const* pixels,
                      std::int64_t Cin) {
  const Floats d;
  for (std::int64_t c = 0; c < Cin; c += kLanes) {
    const std::int64_t left = Cin - c;
    hn::Vec<Floats> t[4][4];  // B^T d
#pragma GCC unroll 4
    for (int x = 0; x < 4; ++x) {
      const auto d0 = load_first(d, pixels[x] + c, left);
      const auto d1 = load_first(d, pixels[4 + x] + c, left);
      const auto d2 = load_first(d, pixels[8 + x] + c, left);
      const auto d3 = load_first(d, pixels[12 + x] + c, left);
      t[0][x] = hn::Sub(d0, d2);
      t[1][x] = hn::Add(d1, d2);
      t[2][x] = hn::Sub(d2, d1);
      t[3][x] = hn::Sub(d1, d3);
    }
    // The gap behind a row takes what the last vector has too much.
#pragma GCC unroll 4
    for (int y = 0; y < 4; ++y) {
      float* to = out + 4 * y * pitch + c;
      hn::StoreU(hn::Sub(t[y][0], t[y][2]), d, to);
      hn::StoreU(hn::Add(t[y][1], t[y][2]), d, to + pitch);
      hn::StoreU(hn::Sub(t[y][2], t[y][1]), d, to + 2 * pitch);
      hn::StoreU(hn::Sub(t[y][1], t[y][3]), d, to + 3 * pitch);
    }
  }
}

// Transforms the inputs of tiles [begin, end), and lists the pixels they give.
void gather_tiles(const WinogradRun& run, std::int64_t begin, std::int64_t end, RowTable& table,
                  const WinogradScratch& scratch) {
  const auto [B, H, W, Cin] = run.x.shape();
  const std::int64_t pitch = Cin + kInputGap, T = chunk_tiles(Cin);
  table.count = 0;
  for (std::int64_t tile = begin; tile < end; ++tile) {
    const std::int64_t x0 = 2 * (tile % run.tiles_across), row = tile / run.tiles_across;
    const std::int64_t y0 = 2 * (row % run.tiles_down), b = row / run.tiles_down;
    const float* pixels[16];
    for (std::int64_t i = 0; i < 16; ++i) {
      const std::int64_t y = y0 - 1 + i / 4, x = x0 - 1 + i % 4;
      const bool inside = y >= 0 && y < H && x >= 0 && x < W;
      pixels[i] =
          inside ? run.x.data() + b * run.x.stride(0) + y * run.x.stride(1) + x * run.x.stride(2)
                 : run.zeros;
    }
    transform_inputs(scratch.inputs + (tile - begin) * pitch, T * pitch, pixels, Cin);
    for (std::int64_t i = 0; i < 4; ++i) {
      const std::int64_t y = y0 + i / 2, x = x0 + i % 2;
      if (y >= H || x >= W) continue;  // the last tile of an odd size
      table.y[table.count] =
          run.y.data() + b * run.y.stride(0) + y * run.y.stride(1) + x * run.y.stride(2);
      if (run.residual)
        table.residual[table.count] = run.residual.data() + b * run.residual.stride(0) +
                                      y * run.residual.stride(1) + x * run.residual.stride(2);
      scratch.pixels[table.count++] = 4 * (tile - begin) + i;
    }
  }
}

// The 16 products of one turn: panels [first, first + count).
void multiply(const WinogradRun& run, std::int64_t first, std::int64_t count,
              std::int64_t num_tiles, const WinogradScratch& scratch) {
  const std::int64_t Cin = run.x.extent(3), T = chunk_tiles(Cin);
  const std::int64_t blocks = (Cin + kBlockK - 1) / kBlockK;
  const std::int64_t panel_size = kPositions * Cin * kPanelWidth;
  const std::int64_t tiles = (num_tiles + kTileRows - 1) / kTileRows;
  for_panel_groups(count, [&](std::int64_t group, std::int64_t width) HWY_ATTR {
    const float* panels = run.weights + (first + group) * panel_size;
    for (std::int64_t p = 0; p < kPositions; ++p) {
      for (std::int64_t block = 0; block < blocks; ++block) {
        const std::int64_t k0 = Cin * block / blocks, k1 = Cin * (block + 1) / blocks;
        const float* lines = panels + (p * Cin + k0) * kPanelWidth;
        const TileColumn column{scratch.rows + p * T,
                                num_tiles,
                                T,
                                1,
                                k0,
                                k1 - k0,
                                lines,
                                panel_size,
                                scratch.products + p * T * kTurnPitch + group * kPanelWidth,
                                kTurnPitch};
        // What follows in memory is what comes next, within these panels.
        Prefetch next;
        if (p + 1 < kPositions || block + 1 < blocks)
          next = Prefetch(reinterpret_cast<const std::byte*>(lines + (k1 - k0) * kPanelWidth),
                          (k1 - k0) * kPanelWidth * 4, width, panel_size * 4, tiles);
        if (block == 0) {
          tile_column_of<false>(width, column, next, 0);
        } else {
          tile_column_of<true>(width, column, next, 0);
        }
      }
    }
  });
}

// A^T m A of `width` channels of every listed pixel, as rows of sums.
void transform_products(const RowTable& table, std::int64_t width, std::int64_t T,
                        const WinogradScratch& scratch) {
  const Floats d;
  const std::int64_t pitch = T * kTurnPitch;
  std::int64_t row = 0;
  while (row < table.count) {
    const std::int64_t tile = scratch.pixels[row] / 4;
    float* to[4] = {nullptr, nullptr, nullptr, nullptr};
    for (; row < table.count && scratch.pixels[row] / 4 == tile; ++row)
      to[scratch.pixels[row] % 4] = scratch.sums + row * kSumPitch;
    const float* HWY_RESTRICT from = scratch.products + tile * kTurnPitch;
    for (std::int64_t n = 0; n < width; n += kLanes) {
      hn::Vec<Floats> t[2][4];  // A^T m
#pragma GCC unroll 4
      for (int x = 0; x < 4; ++x) {
        const auto m0 = hn::LoadU(d, from + x * pitch + n);
        const auto m1 = hn::LoadU(d, from + (4 + x) * pitch + n);
        const auto m2 = hn::LoadU(d, from + (8 + x) * pitch + n);
        const auto m3 = hn::LoadU(d, from + (12 + x) * pitch + n);
        t[0][x] = hn::Add(m0, hn::Add(m1, m2));
        t[1][x] = hn::Sub(hn::Sub(m1, m2), m3);
      }
#pragma GCC unroll 2
      for (int y = 0; y < 2; ++y) {
        if (to[2 * y]) hn::StoreU(hn::Add(t[y][0], hn::Add(t[y][1], t[y][2])), d, to[2 * y] + n);
        if (to[2 * y + 1])
          hn::StoreU(hn::Sub(hn::Sub(t[y][1], t[y][2]), t[y][3]), d, to[2 * y + 1] + n);
      }
    }
  }
}

void run_tiles(const WinogradRun& run, std::int64_t begin, std::int64_t end,
               const WinogradScratch& scratch) {
  const std::int64_t Cin = run.x.extent(3), T = chunk_tiles(Cin), pitch = Cin + kInputGap;
  const std::int64_t num_tiles = end - begin;
  RowTable table;
  table.capacity = 4 * T;
  table.y = scratch.y_rows;
  table.residual = scratch.residual;
  gather_tiles(run, begin, end, table, scratch);
  for (std::int64_t p = 0; p < kPositions; ++p) {
    // Tiles are read whole: what lies beyond the last one repeats it.
    for (std::int64_t t = 0; t < T; ++t)
      scratch.rows[p * T + t] = scratch.inputs + (p * T + std::min(t, num_tiles - 1)) * pitch;
  }
  const std::int64_t panels = num_panels(run.product.w.N);
  for (std::int64_t first = 0; first < panels; first += kTurnPanels) {
    const std::int64_t count = std::min(kTurnPanels, panels - first);
    multiply(run, first, count, num_tiles, scratch);
    transform_products(table, count * kPanelWidth, T, scratch);
    const std::int64_t n0 = first * kPanelWidth;
    finish_any(run.product, table, scratch.sums, 0, table.count, n0,
               std::min(run.product.w.N, n0 + count * kPanelWidth));
  }
}

void widen(Storage storage, const std::byte* from, std::int64_t num_lines, float* to) {
  widen_lines(storage, from, num_lines, to);
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt::kernels {

HWY_EXPORT(transform_weights);
HWY_EXPORT(run_tiles);
HWY_EXPORT(widen);

namespace {

// G g G^T of every panel, in the arena's current scope.
View<float, 4> transformed_weights(const PackedPanels& w, std::int64_t Cin, Context& ctx) {
  const std::int64_t panels = num_panels(w.N), lines = 9 * Cin;
  const View<float, 4> out = ctx.arena().alloc(Shape{panels, kPositions, Cin, kPanelWidth});
  Arena::Scope scope(ctx.arena());
  const bool narrow = w.storage != Storage::kF32;
  const auto widened =
      ctx.arena().alloc(Shape{std::int64_t{ctx.num_threads()}, narrow ? lines : 0, kPanelWidth});
  const auto transform = HWY_DYNAMIC_DISPATCH(transform_weights);
  const auto widen_panel = HWY_DYNAMIC_DISPATCH(widen);
  parallel_chunks(
      panels,
      [&](std::int64_t panel, int worker) {
        const std::byte* from = w.panels + panel * lines * kPanelWidth *
                                               static_cast<std::int64_t>(storage_bytes(w.storage));
        const float* values = reinterpret_cast<const float*>(from);
        if (narrow) {
          widen_panel(w.storage, from, lines, widened[worker].data());
          values = widened[worker].data();
        }
        transform(out[panel].data(), values, Cin);
      },
      ctx);
  return out;
}

}  // namespace

bool winograd_pays(const Shape<4>& x, const ConvGeometry& geometry, std::int64_t out_channels) {
  return geometry.kernel == 3 && geometry.stride == 1 && geometry.padding == 1 && x[3] >= 32 &&
         out_channels >= 32 && x[1] * x[2] >= 1024;
}

void run_winograd(View<float, 4> y, View<const float, 4> x, const PackedPanels& w,
                  const Epilogue<4>& epilogue, Context& ctx) {
  const auto [B, H, W, Cin] = x.shape();
  if (x.size() == 0) return;
  Arena& arena = ctx.arena();
  Arena::Scope scope(arena);
  const std::int64_t T = chunk_tiles(Cin);
  const std::int64_t workers = ctx.num_threads();
  const View<float, 1> zeros = arena.alloc(Shape{Cin});
  std::fill_n(zeros.data(), Cin, 0.0f);
  const Product product{0,
                        w,
                        1,
                        Cin,
                        epilogue.bias.data(),
                        epilogue.activation,
                        epilogue.gamma.data(),
                        !epilogue.residual.empty()};
  const WinogradRun run{product,
                        transformed_weights(w, Cin, ctx).data(),
                        y,
                        x,
                        epilogue.residual,
                        zeros.data(),
                        (H + 1) / 2,
                        (W + 1) / 2};
  const auto inputs = arena.alloc(Shape{workers, kPositions, T, Cin + kInputGap});
  const auto products = arena.alloc(Shape{workers, kPositions, T, kTurnPitch});
  const auto sums = arena.alloc(Shape{workers, 4 * T, kSumPitch});
  const auto rows = arena.alloc<const float*>(Shape{workers, kPositions, T});
  const auto y_rows = arena.alloc<float*>(Shape{workers, 4 * T});
  const auto residual = arena.alloc<const float*>(Shape{workers, 4 * T});
  const auto pixels = arena.alloc<std::int64_t>(Shape{workers, 4 * T});
  const std::int64_t tiles = B * run.tiles_down * run.tiles_across;
  const std::int64_t chunks = (tiles + T - 1) / T;
  const auto run_chunk = HWY_DYNAMIC_DISPATCH(run_tiles);
  parallel_chunks(
      chunks,
      [&](std::int64_t chunk, int worker) {
        run_chunk(run, tiles * chunk / chunks, tiles * (chunk + 1) / chunks,
                  {inputs[worker].data(), products[worker].data(), sums[worker].data(),
                   rows[worker].data(), y_rows[worker].data(), residual[worker].data(),
                   pixels[worker].data()});
      },
      ctx);
}

}  // namespace lvggt::kernels
#endif
