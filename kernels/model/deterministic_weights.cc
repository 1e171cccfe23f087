// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/deterministic_weights.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <initializer_list>
#include <string>

#include "lvggt/core/parallel.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/safetensors.h"

namespace lvggt {
namespace {

constexpr std::uint64_t kStep = 0x9E3779B97F4A7C15u;  // 2^64 / golden ratio, splitmix64's increment

constexpr std::string_view kPoseBias = "camera_head.pose_branch.fc2.bias";

// Elements a thread makes at a time: large against the cost of a task, small enough to share out
// one tensor.
constexpr std::int64_t kGrain = 1 << 16;

std::uint64_t mix(std::uint64_t z) {
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return z ^ (z >> 31);
}

// In [-1, 1), a multiple of 2^-23.
double unit_value(std::uint64_t bits) {
  return 2 * (static_cast<double>(bits >> 40) * 0x1p-24) - 1;
}

// Whether the dotted name is `components` or ends in "." + components.
bool ends_in(std::string_view name, std::string_view components) {
  if (!name.ends_with(components)) return false;
  const std::size_t before = name.size() - components.size();
  return before == 0 || name[before - 1] == '.';
}

bool is_one_of(std::string_view text, std::initializer_list<std::string_view> list) {
  return std::find(list.begin(), list.end(), text) != list.end();
}

bool in_unet(std::string_view name) {
  for (const std::string_view prefix :
       {"lang_encoder.", "rgb_encoder.", "lang_decoder_small.", "lang_decoder_middle.",
        "lang_decoder_large.", "rgb_decoder."})
    if (name.starts_with(prefix)) return true;
  return false;
}

bool is_transposed_convolution(std::string_view name) {
  for (const std::string_view end : {"resize_layers.0.weight", "resize_layers.1.weight",
                                     "up1.weight", "up2.weight", "up3.weight"})
    if (ends_in(name, end)) return true;
  return false;
}

// Scale of a weight of rank 2 or more.
double weight_scale(std::string_view name, std::span<const std::int64_t> shape) {
  const auto fan_volume = checked_volume(shape.subspan(1));
  LVGGT_CHECK(fan_volume && *fan_volume > 0 && shape[0] > 0, "deterministic weights: ", name,
              " has no elements, its shape is ", shape_text(shape));
  const auto fan = static_cast<double>(*fan_volume);
  if (is_transposed_convolution(name)) return std::sqrt(3 / static_cast<double>(shape[0]));
  if (name == "camera_head.pose_branch.fc2.weight") return 0.1 * std::sqrt(3 / fan);
  if (is_one_of(name, {"depth_head.scratch.output_conv2.2.weight",
                       "point_head.scratch.output_conv2.2.weight"}))
    return 0.5 * std::sqrt(3 / fan);
  return std::sqrt((in_unet(name) ? 6 : 3) / fan);
}

void fill(std::uint64_t start, DeterministicScale scale, std::int64_t first, std::span<float> out) {
  std::uint64_t counter = start + static_cast<std::uint64_t>(first) * kStep;
  for (float& value : out) {
    value = static_cast<float>(scale.base + scale.scale * unit_value(mix(counter)));
    counter += kStep;
  }
}

void check_size(std::string_view name, std::span<const std::int64_t> shape, std::span<float> out) {
  LVGGT_CHECK(checked_volume(shape) == static_cast<std::int64_t>(out.size()),
              "deterministic weights: ", name, " has shape ", shape_text(shape), ", but ",
              out.size(), " values are expected");
}

// The one tensor whose base depends on the index: small, so element by element.
void fill_pose_bias(std::span<const std::int64_t> shape, std::uint64_t seed, std::span<float> out) {
  for (std::size_t i = 0; i < out.size(); ++i) {
    const auto index = static_cast<std::int64_t>(i);
    fill(fnv1a64(kPoseBias) ^ seed, deterministic_scale(kPoseBias, shape, index), index,
         out.subspan(i, 1));
  }
}

}  // namespace

std::uint64_t fnv1a64(std::string_view text) {
  std::uint64_t hash = 0xCBF29CE484222325u;
  for (const char c : text) hash = (hash ^ static_cast<unsigned char>(c)) * 0x100000001B3u;
  return hash;
}

std::uint64_t deterministic_bits(std::string_view name, std::uint64_t seed, std::uint64_t i) {
  return mix((fnv1a64(name) ^ seed) + i * kStep);
}

DeterministicScale deterministic_scale(std::string_view name, std::span<const std::int64_t> shape,
                                       std::int64_t index) {
  // 0 for the translation and the quaternion's x, y, z; then w and the two fields of view.
  if (name == kPoseBias) return {index >= 6 ? 0.25 : 0.0, 0.01};
  const std::string_view last = name.substr(name.rfind('.') + 1);
  if (last == "running_mean") return {0, 0.1};
  if (last == "running_var") return {1, 0.3};
  if (last == "gamma") return {0.5, 0.1};
  if (last == "pos_embed") return {0, 0.3};
  if (is_one_of(last, {"cls_token", "register_tokens", "camera_token", "register_token",
                       "mask_token", "empty_pose_tokens"}))
    return {0, 0.5};
  if (last == "bias") return {0, 0.02};
  if (last == "weight" && shape.size() == 1) return {1, 0.1};
  LVGGT_CHECK(last == "weight" && shape.size() >= 2,
              "deterministic weights: no rule for the tensor ", name, " of shape ",
              shape_text(shape));
  return {0, weight_scale(name, shape)};
}

void deterministic_values(std::string_view name, std::span<const std::int64_t> shape,
                          std::uint64_t seed, std::span<float> out) {
  check_size(name, shape, out);
  if (name == kPoseBias) return fill_pose_bias(shape, seed, out);
  fill(fnv1a64(name) ^ seed, deterministic_scale(name, shape), 0, out);
}

void deterministic_values(std::string_view name, std::span<const std::int64_t> shape,
                          std::uint64_t seed, std::span<float> out, Context& ctx) {
  check_size(name, shape, out);
  if (name == kPoseBias) return fill_pose_bias(shape, seed, out);
  const DeterministicScale scale = deterministic_scale(name, shape);
  const std::uint64_t start = fnv1a64(name) ^ seed;
  parallel_rows(
      static_cast<std::int64_t>(out.size()), kGrain,
      [&](std::int64_t begin, std::int64_t end) {
        fill(start, scale, begin,
             out.subspan(static_cast<std::size_t>(begin), static_cast<std::size_t>(end - begin)));
      },
      ctx);
}

void deterministic_uniform(std::string_view name, std::uint64_t seed, double lo, double hi,
                           std::span<float> out) {
  const std::uint64_t start = fnv1a64(name) ^ seed;
  for (std::size_t i = 0; i < out.size(); ++i)
    out[i] = static_cast<float>(lo + (hi - lo) * ((unit_value(mix(start + i * kStep)) + 1) * 0.5));
}

Tensor<float, 4> deterministic_images(std::uint64_t seed, std::int64_t S, std::int64_t H,
                                      std::int64_t W) {
  constexpr std::int64_t kBlock = 16;
  const std::uint64_t pixel = fnv1a64("image.pixel") ^ seed;
  const std::uint64_t block = fnv1a64("image.block") ^ seed;
  const std::int64_t block_rows = (H + kBlock - 1) / kBlock;
  const std::int64_t block_columns = (W + kBlock - 1) / kBlock;
  Tensor<float, 4> images(Shape{S, H, W, std::int64_t{3}});
  float* out = images.data();
  for (std::int64_t f = 0; f < S; ++f)
    for (std::int64_t y = 0; y < H; ++y)
      for (std::int64_t x = 0; x < W; ++x)
        for (std::int64_t c = 0; c < 3; ++c) {
          // The rule numbers elements by planes [S, 3, H, W].
          const auto plane = f * 3 + c;
          const auto i = static_cast<std::uint64_t>((plane * H + y) * W + x);
          const auto j = static_cast<std::uint64_t>(
              (plane * block_rows + y / kBlock) * block_columns + x / kBlock);
          const std::uint64_t k =
              (3 * (mix(block + j * kStep) >> 56) + (mix(pixel + i * kStep) >> 56)) / 4;
          *out++ = static_cast<float>(k) / 255.0f;
        }
  return images;
}

}  // namespace lvggt
