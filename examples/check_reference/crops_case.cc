// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <utility>

#include "examples/check_reference/encoder_cases.h"
#include "lvggt/language/crops.h"

namespace check_reference {
namespace {

using namespace lvggt;

constexpr std::int64_t kSize = 224;        // what the reference resizes to
constexpr std::int64_t kStride = 37;       // of the values it keeps
constexpr std::int64_t kPickStride = 294;  // of the values that stand for an encoding
constexpr std::int64_t kPicked = 512;

Tensor<std::uint8_t, 3> read_picture(const Safetensors& file, const std::string& name) {
  const TensorEntry& entry = file.at(name);
  LVGGT_CHECK(entry.shape.size() == 3, file.path(), ": ", name, " is no picture");
  Tensor<std::uint8_t, 3> picture(Shape{entry.shape[0], entry.shape[1], entry.shape[2]});
  file.read_bytes(entry, std::as_writable_bytes(std::span(picture.data(), picture.num_bytes())));
  return picture;
}

std::vector<std::int64_t> numbers(View<const std::uint8_t, 3> picture) {
  return {picture.data(), picture.data() + picture.size()};
}

// Value i of a square picture taken plane by plane.
template <class T>
T planar(const Tensor<T, 3>& picture, std::int64_t i) {
  const std::int64_t plane = picture.extent(0) * picture.extent(1);
  return picture.data()[i % plane * 3 + i / plane];
}

std::vector<std::int64_t> every37(const Tensor<std::uint8_t, 3>& picture) {
  std::vector<std::int64_t> values;
  for (std::int64_t i = 0; i < picture.size(); i += kStride) values.push_back(planar(picture, i));
  return values;
}

// One object's crop, its resized form and its normalised values; the picked values as the features
// are stored: of length 1, rounded to half precision.
void check_object(Comparison& comparison, const std::string& prefix,
                  View<const std::uint8_t, 3> rgb, View<const std::int32_t, 2> labels,
                  const ObjectBox& box, std::vector<float>& features) {
  const Tensor<std::uint8_t, 3> crop = object_crop(rgb, labels, box);
  comparison.compare(prefix + ".crop", numbers(crop));
  Tensor<std::uint8_t, 3> resized(Shape{kSize, kSize, std::int64_t{3}});
  resize_linear_u8(resized, crop);
  comparison.compare(prefix + ".resized", numbers(resized));
  comparison.compare(prefix + ".resized_every37", every37(resized));
  Tensor<float, 3> pixels(resized.shape());
  clip_normalize(pixels, resized);
  std::vector<float> kept;
  double sum = 0, squares = 0;
  float low = pixels.data()[0], high = low;
  for (std::int64_t i = 0; i < pixels.size(); ++i) {
    const float value = planar(pixels, i);
    if (i % kStride == 0) kept.push_back(value);
    sum += value;
    squares += double{value} * value;
    low = std::min(low, value);
    high = std::max(high, value);
  }
  comparison.compare_within(prefix + ".tensor_every37", kept, 0);
  comparison.compare_within(
      prefix + ".stats",
      std::vector<float>{static_cast<float>(sum), static_cast<float>(squares), low, high}, 1e-6);
  double length = 0;
  for (std::int64_t k = 0; k < kPicked; ++k)
    length += std::pow(double{planar(pixels, k * kPickStride)}, 2);
  length = std::sqrt(length);
  for (std::int64_t k = 0; k < kPicked; ++k)
    features.push_back(
        to_float(to_float16(static_cast<float>(planar(pixels, k * kPickStride) / length))));
}

void check_image(Comparison& comparison, const std::string& prefix) {
  const Safetensors& file = comparison.file();
  const Tensor<std::uint8_t, 3> rgb = read_picture(file, prefix + ".rgb");
  const Tensor<std::uint8_t, 3> maps = read_picture(file, prefix + ".labels");
  comparison.accept(prefix + ".rgb");
  comparison.accept(prefix + ".labels");
  const auto [levels, H, W] = maps.shape();
  std::vector<std::int64_t> objects, rows_plus1(static_cast<std::size_t>(maps.size()), 0);
  std::vector<float> features;
  std::int64_t next_row = 0;
  for (std::int64_t level = 0; level < levels; ++level) {
    Tensor<std::int32_t, 2> labels(Shape{H, W});
    for (std::int64_t i = 0; i < H * W; ++i) labels.data()[i] = maps.data()[level * H * W + i];
    for (const ObjectBox& box : find_objects(labels)) {
      const std::int64_t row = box.dropped() ? -1 : next_row++;
      objects.insert(objects.end(), {level, box.label, row, box.x, box.y, box.width, box.height});
      if (row < 0) continue;
      for (std::int64_t i = 0; i < H * W; ++i)
        if (labels.data()[i] == box.label)
          rows_plus1[static_cast<std::size_t>(level * H * W + i)] = row + 1;
      check_object(comparison, concat(prefix, ".object", row), rgb, labels, box, features);
    }
  }
  comparison.compare(prefix + ".objects", objects);
  comparison.compare(prefix + ".s_plus1", rows_plus1);
  comparison.compare_within(prefix + ".f", features, 0);
}

// An N x N picture of noise over blocks of 4 x 4.
Tensor<std::uint8_t, 3> noise(std::int64_t N) {
  Tensor<std::uint8_t, 3> picture(Shape{N, N, std::int64_t{3}});
  const std::int64_t blocks = (N + 3) / 4;
  const std::string block = concat("crop.block.", N), pixel = concat("crop.pixel.", N);
  const auto byte = [](const std::string& name, std::int64_t i) {
    return deterministic_bits(name, 0, static_cast<std::uint64_t>(i)) >> 56;
  };
  for (std::int64_t y = 0; y < N; ++y)
    for (std::int64_t x = 0; x < N; ++x)
      for (std::int64_t c = 0; c < 3; ++c)
        picture(y, x, c) = static_cast<std::uint8_t>(
            (7 * byte(block, (y / 4 * blocks + x / 4) * 3 + c) + byte(pixel, (y * N + x) * 3 + c)) /
            8);
  return picture;
}

void check_resize(Comparison& comparison, const std::string& name) {
  const std::int64_t N = std::stoll(name.substr(std::string("resize").size()));
  const Tensor<std::uint8_t, 3> input = noise(N);
  comparison.compare(name + ".input", numbers(input));
  Tensor<std::uint8_t, 3> resized(Shape{kSize, kSize, std::int64_t{3}});
  resize_linear_u8(resized, input);
  comparison.compare(name + ".every37", every37(resized));
  std::int64_t sum = 0;
  for (const std::int64_t value : numbers(resized)) sum += value;
  comparison.compare(name + ".sum", std::vector<std::int64_t>{sum});
}

}  // namespace

void check_crops(Comparison& comparison) {
  for (int i = 0; comparison.wants(concat("image", i, ".rgb")); ++i)
    check_image(comparison, concat("image", i));
  for (const TensorEntry& entry : comparison.file().entries())
    if (entry.name.starts_with("resize") && entry.name.ends_with(".every37"))
      check_resize(comparison, entry.name.substr(0, entry.name.find('.')));
}

}  // namespace check_reference
