// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/data/scene.h"
#include "lvggt/data/token_cache.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/npy.h"
#include "lvggt/io/png.h"
#include "tests/support/temp_dir.h"
#include "tests/support/tiny_model.h"

namespace lvggt::test {

// A labelled scene of small pictures in a folder of its own. The label of a pixel, the same on all
// levels, is the row of the pixel's quarter of the picture: 0 and 1 above, 2 (no label) and 3
// below.
class TinyScene {
 public:
  static constexpr std::int64_t kHeight = 28, kWidth = 42;

  // Frames 1 to num_frames in the HyperNeRF layout, or 0 to num_frames - 1 in the Neu3D layout.
  explicit TinyScene(int num_frames, SceneLayout layout = SceneLayout::kHyperNerf,
                     const std::string& name = "scene")
      : layout_(layout), path_(dir_ / name) {
    std::filesystem::create_directories(images());
    for (const SupervisionSpec& spec : specs())
      std::filesystem::create_directories(path_ + "/" + spec.folder());
    for (int i = 0; i < num_frames; ++i) add_frame(i);
  }

  static std::vector<SupervisionSpec> specs() {
    return {{Supervision::kClip, 3}, {Supervision::kDynamic, 6}};
  }
  const std::string& path() const { return path_; }
  std::string operator/(const std::string& name) const { return path_ + "/" + name; }
  std::string images() const {
    return path_ + (layout_ == SceneLayout::kHyperNerf ? "/rgb/2x" : "/cam00/images");
  }
  std::string tokens() const { return path_ + "/lvggt_tokens"; }

  // The file name of frame i, counted from 0, without extension.
  std::string name(int i) const {
    const bool hyper_nerf = layout_ == SceneLayout::kHyperNerf;
    const std::string number = std::to_string(hyper_nerf ? i + 1 : i);
    return std::string((hyper_nerf ? 6 : 4) - number.size(), '0') + number;
  }
  // Its label map or features ("s", "f").
  std::string label_file(int i, const char* which, const SupervisionSpec& spec = {}) const {
    return path_ + "/" + spec.folder() + "/" +
           (layout_ == SceneLayout::kHyperNerf ? "" : "cam00-") + name(i) + "_" + which + ".npy";
  }

  void add_frame(int i) {
    add_picture(images() + "/" + name(i) + ".png", kHeight, kWidth, i);
    for (const SupervisionSpec& spec : specs()) add_labels(i, spec, kHeight, kWidth);
  }

  static void add_picture(const std::string& path, std::int64_t H, std::int64_t W, int seed) {
    Tensor<std::uint8_t, 3> pixels(Shape{H, W, std::int64_t{3}});
    for (std::int64_t y = 0; y < H; ++y)
      for (std::int64_t x = 0; x < W; ++x)
        for (std::int64_t c = 0; c < 3; ++c)
          pixels(y, x, c) = static_cast<std::uint8_t>((x * (c + 1) + 3 * y + 20 * seed) % 256);
    write_png(path, pixels);
  }

  void add_labels(int i, const SupervisionSpec& spec, std::int64_t H, std::int64_t W) {
    Tensor<std::int8_t, 3> rows(Shape{spec.file_levels(), H, W});
    for (std::int64_t level = 0; level < spec.file_levels(); ++level)
      for (std::int64_t y = 0; y < H; ++y)
        for (std::int64_t x = 0; x < W; ++x) rows(level, y, x) = label(y, x, H, W);
    write_npy(label_file(i, "s", spec), rows);
    // Row 3 of dynamic features stays zero: an object without a sentence.
    Tensor<float, 2> codes(Shape{std::int64_t{4}, spec.dim});
    for (std::int64_t row = 0; row < (spec.kind == Supervision::kClip ? 4 : 3); ++row)
      for (std::int64_t c = 0; c < spec.dim; ++c) codes(row, c) = code(i, row, c);
    write_npy(label_file(i, "f", spec), codes);
  }

  static std::int8_t label(std::int64_t y, std::int64_t x, std::int64_t H, std::int64_t W) {
    const int quarter = (y < H / 2 ? 0 : 2) + (x < W / 2 ? 0 : 1);
    return static_cast<std::int8_t>(quarter == 2 ? -1 : quarter);
  }
  static float code(int frame, std::int64_t row, std::int64_t c) {
    return static_cast<float>(frame) + 0.25f * static_cast<float>(row) +
           0.01f * static_cast<float>(c + 1);
  }

  // What make_tokens would leave for the pictures there are, but with made up values: element k of
  // tap t of frame i is token(i, t, k).
  TokenManifest make_tokens(Dtype storage = Dtype::kF32,
                            PreprocessOptions preprocess = {FrameMode::kOriginal, 518, false}) {
    TokenManifest manifest;
    manifest.tool_version = "test";
    manifest.weights = "none";
    manifest.source = images();
    manifest.settings.encoder_sha256 = std::string(64, 'e');
    manifest.settings.config = encoder_config(tiny_config());
    manifest.settings.preprocess = preprocess;
    manifest.settings.storage = storage;
    manifest.transform = plan_frame(kWidth, kHeight, preprocess);
    manifest.complete = true;
    std::filesystem::create_directories(tokens());
    const std::int64_t N = manifest.h() * manifest.w(), C = manifest.channels();
    std::string stream;
    const Scene scene = Scene::open(path_);
    for (std::size_t i = 0; i < scene.frames().size(); ++i) {
      const SceneFrame& frame = scene.frames()[i];
      const std::string image = sha256_file(frame.image);
      stream = next_stream_sha256(stream, manifest.settings, frame.name, image);
      manifest.frames.push_back(
          {frame.name, frame.name + ".png", static_cast<std::int64_t>(i), image, stream});
      std::array<Tensor<float, 2>, 4> values;
      std::array<View<const float, 2>, 4> taps;
      for (std::size_t t = 0; t < 4; ++t) {
        values[t] = Tensor<float, 2>(Shape{N, C});
        for (std::int64_t k = 0; k < N * C; ++k)
          values[t].data()[k] = token(static_cast<int>(i), static_cast<int>(t), k);
        taps[t] = values[t];
      }
      write_tokens(tokens(), manifest.frames.back(), taps, storage);
    }
    write_file(tokens() + "/" + kTokenManifest, to_json(manifest));
    return manifest;
  }
  // Exact in bf16.
  static float token(int frame, int tap, std::int64_t k) {
    return static_cast<float>((frame * 4 + tap + static_cast<int>(k % 61)) % 251 - 125);
  }

 private:
  SceneLayout layout_;
  TempDir dir_{TempDir::in_memory()};
  std::string path_;
};

}  // namespace lvggt::test
