// SPDX-License-Identifier: Apache-2.0
// The memory of a training step: the same allocations as in lvggt/train/, without the work.
#include <algorithm>
#include <array>
#include <vector>

#include "kernels/weight_gradient_plan.h"
#include "lvggt/kernels/conv2d.h"
#include "lvggt/model/tensor_list.h"
#include "lvggt/train/decoder_trainer.h"

namespace lvggt {
namespace {

// An arena that only counts, in floats and double: sizes of a mistaken configuration must not
// overflow.
class CountingArena {
 public:
  class Scope {
   public:
    explicit Scope(CountingArena& arena) : arena_(arena), live_(arena.live_) {}
    ~Scope() { arena_.live_ = live_; }
    Scope(const Scope&) = delete;
    Scope& operator=(const Scope&) = delete;

   private:
    CountingArena& arena_;
    double live_;
  };
  void alloc(double floats) {
    live_ += floats;
    peak_ = std::max(peak_, live_);
  }
  void scratch(double floats) { peak_ = std::max(peak_, live_ + floats); }
  double peak() const { return peak_; }

 private:
  double live_ = 0, peak_ = 0;
};

struct Map {
  std::int64_t B = 0, H = 0, W = 0, C = 0;
  double size() const {
    return static_cast<double>(B) * static_cast<double>(H) * static_cast<double>(W) *
           static_cast<double>(C);
  }
  Map with(std::int64_t channels) const { return {B, H, W, channels}; }
};

class TrainingPlan {
  using Scope = CountingArena::Scope;

 public:
  TrainingPlan(const ModelConfig& config, const TrainOptions& options)
      : c_(config), recompute_(options.activations == CheckpointActivations::kRecompute) {}

  double step(std::int64_t B, std::int64_t h, std::int64_t w, std::int64_t H, std::int64_t W) {
    const Map features{B, c_.patch_size * h, c_.patch_size * w, c_.sbd_features};
    target_ = {B, H, W, 0};
    alloc(features);
    alloc(features);  // their gradient
    const Map grid{B, h, w, 0};
    if (!c_.sbd_dpt) {
      branches(features);
      arena_.scratch(grid.with(c_.sbd_features).size());
    } else if (recompute_) {
      {
        Scope first(arena_);
        dpt_forward(grid);
      }
      branches(features);
      dpt_forward(grid);
      dpt_backward(grid);
    } else {
      dpt_forward(grid);
      branches(features);
      dpt_backward(grid);
    }
    return arena_.peak();
  }

 private:
  void alloc(const Map& map) { arena_.alloc(map.size()); }

  // Partial sums of a weight's gradient; dy and x as the kernel sees them.
  void weight_gradient(const Map& dy, const Map& x, std::int64_t kernel, std::int64_t stride,
                       std::int64_t padding) {
    constexpr std::int64_t kTileRows = 8;  // of most instruction sets
    const kernels::WeightGradientPlan plan({dy.B, dy.H, dy.W, dy.C}, {x.B, x.H, x.W, x.C}, kernel,
                                           stride, padding, kTileRows);
    arena_.scratch(static_cast<double>(plan.tasks()) * static_cast<double>(plan.sum_floats()) +
                   static_cast<double>(plan.x_floats() + plan.dy_floats()));
  }

  void branches(const Map& features) {
    branch(features, c_.sbd_levels, c_.lang_dim, false);
    if (c_.sbd_rgb) branch(features, 1, 3, true);
  }

  // again: the features' gradient has been started, so that the next is a map of its own.
  void branch(const Map& features, std::int64_t heads, std::int64_t channels, bool again) {
    Scope scope(arena_);
    const bool unet = c_.sbd_head == DecoderHead::kUnet;
    if (unet) encoder_forward(features);
    for (std::int64_t i = 0; i < heads; ++i) {
      Scope head(arena_);
      alloc(features.with(channels));
      if (unet) {
        decoder_forward();
      } else {
        alloc(features.with(4 * c_.sbd_hidden_dim));
      }
      const Map resized{target_.B, target_.H, target_.W, channels};
      const bool other_size = target_.H != features.H || target_.W != features.W;
      if (other_size) alloc(resized);
      alloc(resized);  // dy
      arena_.scratch(resized.size());
      if (other_size) alloc(features.with(channels));
      if (unet) {
        decoder_backward();
      } else {
        if (again || i > 0) alloc(features);
        alloc(features.with(4 * c_.sbd_hidden_dim));
      }
    }
    if (!unet) return;
    if (again) alloc(features);
    encoder_backward(features);
  }

  void double_conv_maps(const Map& y) {
    for (int i = 0; i < 3; ++i) alloc(y);
  }
  void double_conv_forward(const Map& y) {
    if (!recompute_) return double_conv_maps(y);
    Scope scope(arena_);
    double_conv_maps(y);
  }
  void double_conv_backward(const Map& x, const Map& y) {
    Scope scope(arena_);
    if (recompute_) double_conv_maps(y);
    alloc(y);
    alloc(y);
    weight_gradient(y, y, 3, 1, 1);
    weight_gradient(y, x, 3, 1, 1);
  }

  // levels_[i]: down{i+1}'s output.
  void encoder_forward(const Map& x) {
    levels_[0] = x.with(c_.sbd_hidden_dim);
    for (std::size_t i = 0; i < 4; ++i) {
      if (i > 0)
        levels_[i] = {x.B, levels_[i - 1].H / 2, levels_[i - 1].W / 2, 2 * levels_[i - 1].C};
      alloc(i < 3 ? levels_[i].with(2 * levels_[i].C) : levels_[i]);
      double_conv_forward(levels_[i]);
      if (i < 3) alloc({x.B, levels_[i].H / 2, levels_[i].W / 2, levels_[i].C});  // pooled
    }
    for (const Map& level : levels_) alloc(level);  // gradients
  }
  void encoder_backward(const Map& x) {
    for (std::size_t i = 3; i > 0; --i) {
      Scope scope(arena_);
      const Map pooled{x.B, levels_[i].H, levels_[i].W, levels_[i - 1].C};
      alloc(pooled);
      double_conv_backward(pooled, levels_[i]);
      arena_.scratch(levels_[i - 1].size());
      weight_gradient(pooled, levels_[i - 1], 2, 2, 0);
    }
    double_conv_backward(x, levels_[0]);
  }

  bool resized(std::size_t k) const {  // up{k+1}, onto levels_[2 - k]
    return 2 * levels_[3 - k].H != levels_[2 - k].H || 2 * levels_[3 - k].W != levels_[2 - k].W;
  }
  Map upsampled(std::size_t k) const {
    return {levels_[0].B, 2 * levels_[3 - k].H, 2 * levels_[3 - k].W, levels_[2 - k].C};
  }
  void decoder_forward() {
    for (std::size_t k = 0; k < 3; ++k) {
      if (resized(k)) arena_.scratch(upsampled(k).size());
      alloc(levels_[2 - k]);
      double_conv_forward(levels_[2 - k]);
    }
  }
  void decoder_backward() {
    Scope scope(arena_);
    alloc(levels_[0]);
    for (std::size_t k = 3; k-- > 0;) {
      const Map& y = levels_[2 - k];
      if (k > 0) alloc(levels_[3 - k]);
      Scope step(arena_);
      alloc(y.with(2 * y.C));
      double_conv_backward(y.with(2 * y.C), y);
      Scope up(arena_);
      if (k == 0) alloc(levels_[3]);
      if (resized(k)) alloc(upsampled(k));
      weight_gradient(levels_[3 - k], upsampled(k), 2, 2, 0);
    }
  }

  // Feature map i: resized projection, then F channels.
  Map tap_map(const Map& grid, std::size_t i) const {
    Map map = grid.with(c_.sbd_out_channels[i]);
    if (i < 2) map = {map.B, map.H << (2 - i), map.W << (2 - i), map.C};
    if (i == 3) map = {map.B, conv2d_extent(map.H, 3, 2, 1), conv2d_extent(map.W, 3, 2, 1), map.C};
    return map;
  }
  Map layer(const Map& grid, std::size_t i) const { return tap_map(grid, i).with(c_.sbd_features); }
  Map fused(const Map& grid) const {
    const Map finest = layer(grid, 0);
    return {finest.B, 2 * finest.H, 2 * finest.W, finest.C};
  }
  void dpt_forward(const Map& grid) {
    const Map tokens = grid.with(2 * c_.embed_dim);
    for (std::size_t i = 0; i < 4; ++i) {
      alloc(layer(grid, i));
      alloc(tokens);
      alloc(grid.with(2));  // mean, rstd
      alloc(grid.with(c_.sbd_out_channels[i]));
      if (i != 2) alloc(tap_map(grid, i));
    }
    for (std::size_t i = 4; i-- > 0;) {
      const Map x = layer(grid, i);
      alloc(i == 0 ? fused(grid) : layer(grid, i - 1));
      alloc(x);             // refined
      if (i < 3) alloc(x);  // hidden of the skip's unit
      alloc(x);             // hidden of the other
      arena_.scratch(x.size());
    }
    arena_.scratch(fused(grid).size());
  }
  void unit_backward(const Map& x) {
    Scope scope(arena_);
    alloc(x);
    weight_gradient(x, x, 3, 1, 1);
  }
  void dpt_backward(const Map& grid) {
    Scope scope(arena_);
    for (std::size_t i = 0; i < 4; ++i) alloc(layer(grid, i));
    {
      Scope maps(arena_);
      alloc(fused(grid));
      arena_.scratch(fused(grid).size());
      for (std::size_t i = 0; i < 4; ++i) {
        const Map x = layer(grid, i);
        if (i < 3) alloc(x);
        Scope block(arena_);
        alloc(x);
        alloc(x);
        unit_backward(x);
      }
    }
    for (std::size_t i = 4; i-- > 0;) {
      Scope tap(arena_);
      const Map map = tap_map(grid, i), projected = grid.with(map.C);
      const Map tokens = grid.with(2 * c_.embed_dim);
      alloc(map);
      weight_gradient(layer(grid, i), map, 3, 1, 1);
      if (i != 2) alloc(projected);
      if (i < 2) weight_gradient(projected, map, std::int64_t{4} >> i, std::int64_t{4} >> i, 0);
      if (i == 3) weight_gradient(map, projected, 3, 2, 1);
      alloc(tokens);
      const std::int64_t pixels = grid.B * grid.H * grid.W;
      weight_gradient({1, 1, pixels, projected.C}, {1, 1, pixels, tokens.C}, 1, 1, 0);
    }
  }

  const ModelConfig& c_;
  bool recompute_;
  CountingArena arena_;
  Map target_;
  std::array<Map, 4> levels_;
};

}  // namespace

TrainingMemory plan_training(const ModelConfig& config, const TrainOptions& options,
                             std::int64_t batch_size, std::int64_t h, std::int64_t w,
                             std::int64_t H, std::int64_t W) {
  LVGGT_CHECK(batch_size >= 1 && h >= 1 && w >= 1 && H >= 1 && W >= 1, "plan_training: a batch of ",
              batch_size, " frames of ", h, " x ", w, " patches and ", H, " x ", W, " pixels");
  double parameters = 0;
  const double copies = options.ema_decay > 0 ? 5 : 4;  // weights, gradients, m, v, average
  for (const TensorSpec& spec : decoder_tensors(config)) {
    const bool buffer = spec.name.ends_with(".running_mean") || spec.name.ends_with(".running_var");
    parameters += static_cast<double>(spec.volume()) * (buffer ? 2 : copies);
  }
  const std::int64_t parts = std::min(options.accumulate, batch_size);
  const double activations =
      TrainingPlan(config, options).step((batch_size + parts - 1) / parts, h, w, H, W);
  const double taps = 4 * 2 * static_cast<double>(config.embed_dim) * static_cast<double>(h * w);
  const double pixels = static_cast<double>(H) * static_cast<double>(W);
  const double targets = pixels * static_cast<double>(config.sbd_levels * (config.lang_dim + 1) +
                                                      (config.sbd_rgb ? 3 : 0));
  const auto bytes = [](double floats) {
    return static_cast<std::size_t>(std::min(floats * sizeof(float), 0x1p62));
  };
  TrainingMemory memory{bytes(parameters), bytes(activations),
                        bytes(static_cast<double>(batch_size) * (taps + targets)), 0};
  memory.total = memory.parameters + memory.activations + memory.batch;
  return memory;
}

}  // namespace lvggt
