// SPDX-License-Identifier: Apache-2.0
// Private: the pixels that a convolution reads, as rows of a product.
#pragma once

#include <algorithm>
#include <cstdint>

#include "kernels/product.h"
#include "lvggt/core/tensor.h"

namespace lvggt::kernels {

// One axis of a convolution: output o reads, through tap t, input o * stride + offset + t * step.
struct TapAxis {
  std::int64_t taps = 1;
  std::int64_t stride = 1;
  std::int64_t offset = 0;
  std::int64_t step = 1;
};

// Fills a product's row table for a convolution. Taps are in row-major order, output pixels in the
// order of y; where a tap lies beyond x it reads `zeros`.
//
// Windows: the taps of one kernel row are neighbouring pixels, so that for dense pixels they can be
// read as one, with fewer addresses and longer runs. The windows that cross a border are copied,
// with zeros beyond it.
class TapGather {
 public:
  // y, residual: [B, Ho, Wo, .], residual may be empty   x: [B, H, W, C]   zeros: [C]
  TapGather(View<float, 4> y, View<const float, 4> x, View<const float, 4> residual,
            const TapAxis& down, const TapAxis& across, const float* zeros)
      : y_(y), x_(x), residual_(residual), down_(down), across_(across), zeros_(zeros) {}

  // Reads the taps of a kernel row as one window.   windows: [workers, taps down, kChunkRows, taps
  // across * C], scratch for the copies   zeros: [taps across * C]
  void use_windows(View<float, 4> windows) {
    window_ = across_.taps;
    across_.taps = 1;
    windows_ = windows;
  }

  void operator()(const RowTable& table) const {
    const std::int64_t Ho = y_.extent(1), Wo = y_.extent(2);
    std::int64_t ox = table.begin % Wo;
    std::int64_t oy = table.begin / Wo % Ho;
    std::int64_t b = table.begin / Wo / Ho;
    for (std::int64_t r = 0; r < table.count;) {
      const std::int64_t run = std::min(table.count - r, Wo - ox);  // pixels of one output row
      for (std::int64_t i = 0; i < run; ++i) {
        table.y[r + i] = y_.data() + b * y_.stride(0) + oy * y_.stride(1) + (ox + i) * y_.stride(2);
      }
      for (std::int64_t i = 0; residual_ && i < run; ++i) {
        table.residual[r + i] = residual_.data() + b * residual_.stride(0) +
                                oy * residual_.stride(1) + (ox + i) * residual_.stride(2);
      }
      for (std::int64_t t = 0; t < down_.taps; ++t) {
        const std::int64_t iy = oy * down_.stride + down_.offset + t * down_.step;
        const float** to = table.x + t * across_.taps * table.capacity + r;
        if (window_ > 1) {
          gather_windows(to, windows_[table.worker][t].narrow(0, r, r + run), b, iy, ox);
        } else {
          gather_run(to, table.capacity, b, iy, ox, run);
        }
      }
      r += run;
      ox = 0;
      if (++oy == Ho) {
        oy = 0;
        ++b;
      }
    }
  }

 private:
  // The taps of one kernel row for `run` neighbouring output pixels.
  void gather_run(const float** to, std::int64_t capacity, std::int64_t b, std::int64_t iy,
                  std::int64_t ox, std::int64_t run) const {
    const bool inside = iy >= 0 && iy < x_.extent(1);
    const float* row = inside ? x_.data() + b * x_.stride(0) + iy * x_.stride(1) : nullptr;
    // One comparison for both ends: a negative index is a huge unsigned one.
    const auto W = static_cast<std::uint64_t>(inside ? x_.extent(2) : 0);
    const std::int64_t pitch = x_.stride(2);
    for (std::int64_t t = 0; t < across_.taps; ++t, to += capacity) {
      std::int64_t ix = ox * across_.stride + across_.offset + t * across_.step;
      for (std::int64_t i = 0; i < run; ++i, ix += across_.stride)
        to[i] = static_cast<std::uint64_t>(ix) < W ? row + ix * pitch : zeros_;
    }
  }

  // The windows of neighbouring output pixels; copies: [pixels, window * C]
  void gather_windows(const float** to, View<float, 2> copies, std::int64_t b, std::int64_t iy,
                      std::int64_t ox) const {
    const std::int64_t run = copies.extent(0), W = x_.extent(2), C = x_.extent(3);
    if (iy < 0 || iy >= x_.extent(1)) {
      std::fill_n(to, run, zeros_);
      return;
    }
    const float* row = x_.data() + b * x_.stride(0) + iy * x_.stride(1);
    std::int64_t ix = ox * across_.stride + across_.offset;
    for (std::int64_t i = 0; i < run; ++i, ix += across_.stride) {
      if (ix >= 0 && ix + window_ <= W) {
        to[i] = row + ix * C;
        continue;
      }
      float* copy = copies[i].data();
      for (std::int64_t t = 0; t < window_; ++t) {
        const bool inside = ix + t >= 0 && ix + t < W;
        std::copy_n(inside ? row + (ix + t) * C : zeros_, C, copy + t * C);
      }
      to[i] = copy;
    }
  }

  View<float, 4> y_;
  View<const float, 4> x_;
  View<const float, 4> residual_;
  TapAxis down_, across_;
  const float* zeros_;
  std::int64_t window_ = 1;
  View<float, 4> windows_;
};

}  // namespace lvggt::kernels
