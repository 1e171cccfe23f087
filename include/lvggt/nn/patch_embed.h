// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lvggt/core/parallel.h"
#include "lvggt/kernels/interpolate.h"
#include "lvggt/nn/params.h"

namespace lvggt {

// Image to patch tokens: a convolution whose stride is its kernel, after normalising the colours.
struct PatchEmbed {
  Conv2d proj;                // [C, 3, patch, patch]
  std::array<float, 3> mean;  // of RGB in [0, 1]
  std::array<float, 3> std;
};

// tokens = conv((pixels - mean) / std) + position.
//   tokens: [h*w, C]   pixels: [h*patch, w*patch, 3], RGB in [0, 1]   position: [h*w, C]
inline void patch_embed_forward(View<float, 2> tokens, View<const float, 3> pixels,
                                const PatchEmbed& layer, View<const float, 2> position,
                                Context& ctx) {
  const std::int64_t H = pixels.extent(0), W = pixels.extent(1);
  const Shape<3> grid = conv2d_shape(layer.proj, H, W);
  LVGGT_CHECK(tokens.shape() == (Shape{grid[0] * grid[1], grid[2]}), "patch_embed: tokens are ",
              tokens.shape(), " but the pixels ", pixels.shape(), " give ", grid);
  Arena::Scope scope(ctx.arena());
  const View<float, 3> normalised = ctx.arena().alloc(pixels.shape());
  parallel_rows(
      H, 16,
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t y = begin; y < end; ++y) {
          for (std::int64_t x = 0; x < W; ++x) {
            const float* in = pixels.data() + y * pixels.stride(0) + x * pixels.stride(1);
            float* out = normalised.data() + (y * W + x) * 3;
            for (std::size_t c = 0; c < 3; ++c) out[c] = (in[c] - layer.mean[c]) / layer.std[c];
          }
        }
      },
      ctx);
  const auto as_map = [&](auto rows) {
    using T = std::remove_pointer_t<decltype(rows.data())>;
    return View<T, 3>(rows.data(), grid, {grid[1] * rows.stride(0), rows.stride(0), 1});
  };
  conv2d_forward(as_map(tokens), normalised, layer.proj, {.residual = as_map(position)}, ctx);
}

// The position table resized from its own square grid to h x w patches by antialiased bicubic
// interpolation; as it is when the grids are equal. Row 0 belongs to the class token and is copied.
//   y: [1 + h*w, C]   table: [1 + side*side, C]
inline void resize_pos_embed(View<float, 2> y, View<const float, 2> table, std::int64_t h,
                             std::int64_t w, std::int64_t side, Context& ctx) {
  const std::int64_t C = table.extent(1);
  LVGGT_CHECK(table.extent(0) == 1 + side * side && y.shape() == (Shape{1 + h * w, C}),
              "resize_pos_embed: table ", table.shape(), " of side ", side, " cannot become ",
              y.shape());
  if (h == side && w == side) {
    std::copy_n(table.data(), table.size(), y.data());
    return;
  }
  std::copy_n(table.data(), C, y.data());
  bicubic_antialias_forward(View<float, 3>(y.data() + C, Shape{h, w, C}),
                            View<const float, 3>(table.data() + C, Shape{side, side, C}), ctx);
}

}  // namespace lvggt
