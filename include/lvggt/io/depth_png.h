// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <string>

#include "lvggt/core/tensor.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/png.h"

namespace lvggt {

// How a map of positive numbers is stored in 16 bits: number = value * scale.
struct Quantized16 {
  Tensor<std::uint16_t, 2> values;  // [H, W]; 0 where there is no number
  double scale = 1;                 // a power of two, so that the product is exact
};

// The smallest power-of-two scale that holds the largest number, and every number rounded to it.
// What is not finite or not positive becomes 0; a positive number never does.
inline Quantized16 quantize_16bit(View<const float, 2> numbers) {
  constexpr double kMaxValue = 65535;
  const auto [H, W] = numbers.shape();
  double largest = 0;
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t x = 0; x < W; ++x)
      if (std::isfinite(numbers(y, x))) largest = std::max<double>(largest, numbers(y, x));

  Quantized16 quantized{Tensor<std::uint16_t, 2>(Shape{H, W}), 1};
  if (largest > 0) quantized.scale = std::exp2(std::ceil(std::log2(largest / kMaxValue)));
  for (std::int64_t y = 0; y < H; ++y) {
    for (std::int64_t x = 0; x < W; ++x) {
      const double number = numbers(y, x);
      if (!std::isfinite(number) || number <= 0) continue;
      quantized.values(y, x) = static_cast<std::uint16_t>(
          std::clamp(std::nearbyint(number / quantized.scale), 1.0, kMaxValue));
    }
  }
  return quantized;
}

// Writes `numbers` as a 16-bit PNG and beside it a JSON file that says how to get the numbers back.
// `quantity` names them ("depth"), `meaning` is a sentence on what they are. Returns the scale.
inline double write_depth_png(const std::string& png_path, const std::string& json_path,
                              View<const float, 2> numbers, const std::string& quantity,
                              const std::string& meaning) {
  const Quantized16 quantized = quantize_16bit(numbers);
  JsonWriter json;
  json.begin_object();
  json.field("format_version", 1);
  json.field("quantity", quantity);
  json.field("formula", quantity + " = value * scale; value 0 means none");
  json.field("scale", quantized.scale);
  json.field("meaning", meaning);
  json.field("width", numbers.extent(1));
  json.field("height", numbers.extent(0));
  json.end_object();
  // The sidecar first: whoever sees the picture can read it.
  write_file(json_path, json.take());
  write_png(png_path, quantized.values);
  return quantized.scale;
}

}  // namespace lvggt
