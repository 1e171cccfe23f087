// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <string>

#include "lvggt/kernels/elementwise.h"
#include "lvggt/lvggt.h"
#include "lvggt/train/decoder_batch.h"

namespace check_reference {

// The training batch of a reference file, planar there and channels last here, as T.
template <class T>
class TrainInputs {
 public:
  TrainInputs(const lvggt::Safetensors& file, const lvggt::ModelConfig& config,
              lvggt::Context& ctx) {
    using lvggt::Shape;
    const lvggt::Tensor<float, 5> planes = file.read<5>("in.features");
    const auto [B, levels, d, H, W] = planes.shape();
    lvggt::Tensor<float, 5> features(Shape{B, levels, H, W, d});
    lvggt::Tensor<float, 4> mask(Shape{B, levels, H, W});
    lvggt::Tensor<float, 4> images(Shape{B, H, W, std::int64_t{3}});
    const lvggt::Tensor<float, 4> image_planes = file.read<4>("in.images");
    for (std::int64_t b = 0; b < B; ++b) {
      lvggt::from_planes(images[b], image_planes[b], ctx);
      for (std::int64_t l = 0; l < levels; ++l)
        lvggt::from_planes(features[b][l], planes[b][l], ctx);
    }
    file.read_into("in.mask", {mask.data(), static_cast<std::size_t>(mask.size())});
    batch_.h = H / config.patch_size;
    batch_.w = W / config.patch_size;
    const std::int64_t patches = batch_.h * batch_.w, start = config.patch_start_idx();
    for (std::size_t i = 0; i < 4; ++i) {
      const lvggt::Tensor<float, 4> tokens = file.read<4>("in.tap" + std::to_string(i));
      lvggt::Tensor<float, 3> tap(Shape{B, patches, tokens.extent(3)});
      for (std::int64_t b = 0; b < B; ++b)
        lvggt::copy_rows(tap[b], tokens[0][b].narrow(0, start, start + patches), ctx);
      batch_.taps[i] = taps_[i] = converted(tap);
    }
    batch_.images = images_ = converted(images);
    batch_.features = features_ = converted(features);
    batch_.mask = mask_ = converted(mask);
  }

  const lvggt::BasicDecoderBatch<T>& batch() const { return batch_; }

 private:
  template <int R>
  static lvggt::Tensor<T, R> converted(const lvggt::Tensor<float, R>& x) {
    lvggt::Tensor<T, R> y(x.shape());
    std::copy_n(x.data(), x.size(), y.data());
    return y;
  }

  lvggt::BasicDecoderBatch<T> batch_;
  std::array<lvggt::Tensor<T, 3>, 4> taps_;
  lvggt::Tensor<T, 4> images_, mask_;
  lvggt::Tensor<T, 5> features_;
};

}  // namespace check_reference
