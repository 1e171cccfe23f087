// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "lvggt/io/dtype.h"
#include "lvggt/language/autoencoder.h"
#include "weights/weight_source.h"

namespace lvggt {

// An autoencoder from safetensors or from a PyTorch checkpoint (.pth, .ckpt), told apart by
// content. Errors: those of both readers and of Autoencoder.
inline Autoencoder load_autoencoder(const std::string& path) {
  const auto source = WeightSource::open(path);
  if (source->format() == "safetensors") return Autoencoder::load(path);
  std::vector<TensorSpec> specs;
  for (const TensorEntry& entry : source->tensors()) specs.push_back({entry.name, entry.shape});
  const AutoencoderShape shape = infer_autoencoder_shape(specs, path);
  return Autoencoder(shape, [&](const TensorSpec& spec, std::span<float> values) {
    const auto found = std::ranges::find_if(
        specs, [&](const TensorSpec& other) { return other.name == spec.name; });
    LVGGT_CHECK(found != specs.end() && found->shape == spec.shape, path, ": not an autoencoder ",
                to_text(shape), ": ", spec.name, " is missing or of another shape than ",
                shape_text(spec.shape));
    const auto i = static_cast<std::size_t>(found - specs.begin());
    const TensorEntry& entry = source->tensors()[i];
    std::vector<std::byte> bytes(static_cast<std::size_t>(entry.num_bytes));
    source->read(i, bytes);
    to_float32(entry.dtype, bytes, values);
    for (const float value : values)
      if (!std::isfinite(value)) fail(ErrorKind::kFormat, path, ": ", spec.name, " holds ", value);
  });
}

}  // namespace lvggt
