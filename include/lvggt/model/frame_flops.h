// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>

#include "lvggt/model/config.h"

namespace lvggt {

// Floating-point operations of products, attention and convolutions in one streamed frame, by
// stage; a multiply-add is two. Everything else is left out.
struct FrameFlops {
  double dino = 0, frame_blocks = 0, global_blocks = 0, camera = 0, depth = 0, decoder = 0;
  double total() const { return dino + frame_blocks + global_blocks + camera + depth + decoder; }
};

// A block's four products (12 C^2 weights for an MLP ratio of 4) over N tokens, and attention over
// num_keys.
inline double block_flops(double N, double C, double mlp_ratio, double num_keys) {
  return 2 * N * C * C * (4 + 2 * mlp_ratio) + 4 * N * num_keys * C;
}

inline double conv_flops(double pixels, double taps, double Cin, double Cout) {
  return 2 * pixels * taps * Cin * Cout;
}

// The DPT up to and with output_conv1, whose Cout is `last`, over h x w patches; out_conv runs
// before the resize.
inline double dpt_flops(const ModelConfig& c, const std::array<std::int64_t, 4>& out_channels,
                        std::int64_t features, std::int64_t last, double h, double w) {
  const auto F = static_cast<double>(features);
  const double pixels[4] = {16 * h * w, 4 * h * w, h * w, (h + 1) / 2 * ((w + 1) / 2)};
  double flops = 0;
  for (std::size_t i = 0; i < 4; ++i) {
    const auto Ci = static_cast<double>(out_channels[i]);
    flops += conv_flops(h * w, 1, 2 * static_cast<double>(c.embed_dim), Ci);
    if (i != 2) flops += conv_flops(i == 3 ? pixels[3] : pixels[i], i == 3 ? 9 : 1, Ci, Ci);
    flops += conv_flops(pixels[i], 9, Ci, F);
    // Residual units: two convolutions each, one unit for the coarsest map and two for the others;
    // out_conv.
    flops += (i == 3 ? 2 : 4) * conv_flops(pixels[i], 9, F, F) + conv_flops(pixels[i], 1, F, F);
  }
  return flops + conv_flops(4 * pixels[0], 9, F, static_cast<double>(last));
}

// One UNet encoder (half 0) or decoder (half 1) over H x W pixels.
inline double unet_flops(const ModelConfig& c, bool is_decoder, double outputs, double H,
                         double W) {
  const auto hidden = static_cast<double>(c.sbd_hidden_dim),
             F = static_cast<double>(c.sbd_features);
  double flops = is_decoder ? conv_flops(H * W, 9, hidden, outputs) : 0;
  for (int level = 0; level < 4; ++level) {
    const double scale = 1 << level, pixels = H * W / (scale * scale), C = hidden * scale;
    if (!is_decoder) {
      flops += conv_flops(pixels, 9, level == 0 ? F : C / 2, C) + conv_flops(pixels, 9, C, C);
      if (level < 3) flops += conv_flops(pixels / 4, 4, C, C);
    } else if (level < 3) {
      flops +=
          conv_flops(pixels, 1, 2 * C, C);  // transposed: each output pixel reads one input pixel
      flops += conv_flops(pixels, 9, 2 * C, C) + conv_flops(pixels, 9, C, C);
    }
  }
  return flops;
}

// The frame that attends to `frames` frames, itself included.
inline FrameFlops frame_flops(const ModelConfig& c, std::int64_t H, std::int64_t W,
                              std::int64_t frames) {
  const double h = static_cast<double>(H / c.patch_size), w = static_cast<double>(W / c.patch_size);
  const double pixels = static_cast<double>(H * W), C = static_cast<double>(c.embed_dim);
  const double P = h * w + static_cast<double>(c.patch_start_idx());
  FrameFlops flops;
  flops.dino = conv_flops(h * w, static_cast<double>(c.patch_size * c.patch_size), 3, C) +
               static_cast<double>(c.dino_depth) * block_flops(P, C, c.mlp_ratio, P);
  const auto depth = static_cast<double>(c.agg_depth);
  flops.frame_blocks = depth * block_flops(P, C, c.mlp_ratio, P);
  flops.global_blocks = depth * block_flops(P, C, c.mlp_ratio, P * static_cast<double>(frames));
  flops.camera = static_cast<double>(c.cam_iterations * c.cam_trunk_depth) *
                 block_flops(1, 2 * C, c.mlp_ratio, 1);
  const auto half = static_cast<double>(c.dpt_features) / 2;
  flops.depth = dpt_flops(c, c.dpt_out_channels, c.dpt_features, c.dpt_features / 2, h, w) +
                conv_flops(pixels, 9, half, static_cast<double>(c.dpt_head_features_2)) +
                conv_flops(pixels, 1, static_cast<double>(c.dpt_head_features_2), 2);
  const double Hd = static_cast<double>(H), Wd = static_cast<double>(W);
  const double encoders = c.sbd_rgb ? 2 : 1;
  flops.decoder = dpt_flops(c, c.sbd_out_channels, c.sbd_features, c.sbd_features, h, w) +
                  encoders * unet_flops(c, false, 0, Hd, Wd) +
                  static_cast<double>(c.sbd_levels) *
                      unet_flops(c, true, static_cast<double>(c.lang_dim), Hd, Wd) +
                  (c.sbd_rgb ? unet_flops(c, true, 3, Hd, Wd) : 0);
  return flops;
}

}  // namespace lvggt
