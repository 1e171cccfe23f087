// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

#include "lvggt/train/decoder_batch.h"
#include "tests/support/random.h"
#include "tests/support/training.h"

namespace lvggt::test {

// A batch in float64.
struct ExactBatch {
  explicit ExactBatch(const OwnedBatch& data)
      : images(in_double(data.images)),
        mask(in_double(data.mask)),
        features(in_double(data.features)) {
    for (std::size_t i = 0; i < 4; ++i) taps[i] = in_double(data.taps[i]);
    batch = {data.batch.h, data.batch.w, {taps[0], taps[1], taps[2], taps[3]},
             images,       features,     mask};
  }
  std::array<Tensor<double, 3>, 4> taps;
  Tensor<double, 4> images, mask;
  Tensor<double, 5> features;
  BasicDecoderBatch<double> batch;
};

}  // namespace lvggt::test
