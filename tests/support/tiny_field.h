// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/field/run_writer.h"
#include "lvggt/io/npy.h"
#include "lvggt/io/safetensors.h"
#include "tests/support/files.h"

namespace lvggt::test {

// A lifted field of small frames whose meaning is known: the left half is a cup, the right half a
// wall, and from frame `tilted_from` on the cup is tilted. The codes are the language itself: code
// and feature k is the k-th axis, so the autoencoders are identities.
class TinyField {
 public:
  static constexpr std::int64_t kHeight = 20, kWidth = 32, kAxes = 6;
  static constexpr int kCup = 0, kWall = 1;  // axes of the language
  static constexpr int kUpright = 0, kTilted = 1;

  explicit TinyField(std::string folder) : folder_(std::move(folder)) {}

  std::int64_t num_frames = 6, tilted_from = 3;
  bool language = true, states = true;
  RunOutputs outputs;

  // Writes the field into its folder, which is made.
  void write() const {
    Context ctx(1);
    std::filesystem::create_directory(folder_);
    RunFormat format;
    format.transform = {64,  40, 0, static_cast<int>(kWidth), static_cast<int>(kHeight), 0.5,
                        0.5, 0,  0};
    format.levels = language ? 3 : 0;
    format.lang_dim = language ? kAxes : 0;
    format.state_levels = states ? 1 : 0;
    format.state_dim = states ? 2 : 0;
    format.decoder_sha256 = "cup";
    format.state_sha256 = "tilt";
    format.expected_frames = num_frames;
    RunWriter writer(folder_, outputs, format, false);
    for (std::int64_t i = 0; i < num_frames; ++i) write_frame(writer, i, ctx);
    writer.finish();
  }

  // Depth, confidence and colour of a pixel.
  static float depth_at(std::int64_t y, std::int64_t x) {
    return 1 + 0.125F * static_cast<float>(x) + 0.25F * static_cast<float>(y);
  }
  static float confidence_at(std::int64_t x) { return 1 + 0.5F * static_cast<float>(x); }
  static float color_at(std::int64_t y, std::int64_t x) {
    return static_cast<float>((3 * x + y) % 256) / 255;
  }

 private:
  void write_frame(RunWriter& writer, std::int64_t index, Context& ctx) const {
    Tensor<float, 3> input(Shape{kHeight, kWidth, std::int64_t{3}});
    Tensor<float, 2> depth(Shape{kHeight, kWidth}), confidence(Shape{kHeight, kWidth});
    Tensor<float, 4> codes(Shape{std::int64_t{3}, kHeight, kWidth, kAxes});
    Tensor<float, 4> state_codes(Shape{std::int64_t{1}, kHeight, kWidth, std::int64_t{2}});
    const int state = index < tilted_from ? kUpright : kTilted;
    for (std::int64_t y = 0; y < kHeight; ++y) {
      for (std::int64_t x = 0; x < kWidth; ++x) {
        for (std::int64_t c = 0; c < 3; ++c) input(y, x, c) = color_at(y, x);
        depth(y, x) = depth_at(y, x);
        confidence(y, x) = confidence_at(x);
        for (std::int64_t level = 0; level < 3; ++level)
          codes(level, y, x, x < kWidth / 2 ? kCup : kWall) = 1;
        state_codes(0, y, x, state) = 1;
      }
    }
    Camera camera;
    camera.fx = camera.fy = 30;
    camera.cx = 16;
    camera.cy = 10;
    camera.cam_from_world(0, 3) = 0.1F * static_cast<float>(index);
    const CameraRecord record{index, 2 * index, "frame " + std::to_string(2 * index),
                              0.5 * static_cast<double>(index), camera};
    const Tensor<std::uint8_t, 3> original(
        Shape{std::int64_t{40}, std::int64_t{64}, std::int64_t{3}});
    const FrameMaps maps{input,
                         depth,
                         confidence,
                         {},
                         language ? codes.view() : View<const float, 4>(),
                         states ? state_codes.view() : View<const float, 4>()};
    writer.write(
        {record, original, maps}, [] { return false; }, ctx);
  }

  std::string folder_;
};

// An autoencoder whose decoder is the identity on `width` values.
inline void write_identity_autoencoder(const std::string& path, std::int64_t width) {
  std::vector<float> weight(static_cast<std::size_t>(width * width));
  for (std::int64_t i = 0; i < width; ++i) weight[static_cast<std::size_t>(i * width + i)] = 1;
  SafetensorsWriter out(path);
  out.add("decoder.0.weight", {width, width}, weight);
  const std::vector<float> zeros(static_cast<std::size_t>(width));
  out.add("decoder.0.bias", {width}, zeros);
  out.finish();
}

// Embeddings beside their phrases, NAME.npy and NAME.json: each phrase is one axis.
inline void write_axes(const std::string& name, std::int64_t width,
                       const std::vector<std::pair<std::string, std::int64_t>>& phrases) {
  Tensor<float, 2> rows(Shape{static_cast<std::int64_t>(phrases.size()), width});
  std::string list = "[";
  for (std::size_t i = 0; i < phrases.size(); ++i) {
    rows(static_cast<std::int64_t>(i), phrases[i].second) = 1;
    list += (i == 0 ? "" : ", ") + json_quote(phrases[i].first);
  }
  write_npy(name + ".npy", rows);
  write_bytes(name + ".json", list + "]");
}

}  // namespace lvggt::test
