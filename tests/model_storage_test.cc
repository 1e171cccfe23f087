// SPDX-License-Identifier: Apache-2.0
// What narrow weights and caches change in the outputs of the small model, against float32
// everywhere.
#include <doctest/doctest.h>

#include <array>
#include <cmath>
#include <vector>

#include "lvggt/model/storage_policy.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// Outputs of the frames of the reference stream, one after the other: pose encoding, depth,
// confidence, language.
struct Outputs {
  std::array<std::vector<float>, 4> values;
};

Outputs run(const StoragePolicy& weights, Storage cache) {
  const TempDir dir;
  const std::string path = dir / "model.safetensors";
  const ModelConfig config = tiny_config();
  write_tensors(path, all_tensors(config), &config);
  Context ctx(2);
  LoadOptions load;
  load.weights = path;
  load.storage = weights;
  const LangVggt model = LangVggt::load(load, ctx);
  StreamOptions options;
  options.cache_storage = cache;
  Stream stream(model, ctx, options);
  const Tensor<float, 4> images = deterministic_images(1, 4, 56, 84);
  Outputs outputs;
  for (std::int64_t i = 0; i < images.extent(0); ++i) {
    const Frame frame = stream.push(images[i]);
    const auto append = [](std::vector<float>& to, auto view) {
      to.insert(to.end(), view.data(), view.data() + view.size());
    };
    append(outputs.values[0], frame.pose_encoding);
    append(outputs.values[1], frame.depth);
    append(outputs.values[2], frame.depth_confidence);
    append(outputs.values[3], frame.language);
  }
  return outputs;
}

// The largest of |a - b| / |b| over the outputs, Euclidean norms.
double difference(const Outputs& a, const Outputs& b) {
  double worst = 0;
  for (std::size_t i = 0; i < b.values.size(); ++i) {
    double error = 0, norm = 0;
    for (std::size_t j = 0; j < b.values[i].size(); ++j) {
      error += std::pow(double{a.values[i][j]} - b.values[i][j], 2);
      norm += std::pow(double{b.values[i][j]}, 2);
    }
    worst = std::max(worst, std::sqrt(error / norm));
  }
  return worst;
}

}  // namespace

TEST_CASE(
    "StoragePolicy: int8 is for the transformer's linear layers, everything else keeps bf16") {
  const StoragePolicy policy = StoragePolicy::of(Storage::kI8);
  CHECK(policy.of_weight("aggregator.patch_embed.blocks.0.mlp.fc1.weight") == Storage::kI8);
  CHECK(policy.of_weight("aggregator.global_blocks.3.attn.qkv") == Storage::kI8);
  CHECK(policy.of_weight("aggregator.patch_embed.patch_embed.proj.weight") == Storage::kBf16);
  CHECK(policy.of_weight("aggregator.patch_embed.blocks.1.attn.proj.weight") == Storage::kBf16);
  CHECK(policy.of_weight("aggregator.frame_blocks.1.attn.proj.weight") == Storage::kI8);
  CHECK(policy.of_weight("camera_head.trunk.0.attn.qkv.weight") == Storage::kBf16);
  CHECK(policy.of_weight("camera_head.pose_branch.fc1.weight") == Storage::kBf16);
  CHECK(policy.of_weight("depth_head.projects.0.weight") == Storage::kBf16);
  CHECK(policy.of_weight("lang_encoder.down1.0.weight") == Storage::kF32);
  CHECK(StoragePolicy::of(Storage::kF32) == StoragePolicy{});
}

TEST_CASE("layer_kind: every weight of the model has the kind that its name says") {
  const std::pair<const char*, const char*> kinds[] = {
      {"aggregator.patch_embed.blocks.23.attn.qkv.weight", "dino.qkv"},
      {"aggregator.patch_embed.blocks.0.mlp.fc2.weight", "dino.fc2"},
      {"aggregator.frame_blocks.7.attn.proj.weight", "frame.proj"},
      {"aggregator.global_blocks.7.mlp.fc1.weight", "global.fc1"},
      {"camera_head.trunk.3.mlp.fc2.weight", "camera.fc2"},
      {"camera_head.pose_branch.fc2.weight", "camera.pose"},
      {"camera_head.poseLN_modulation.1.weight", "camera.pose"},
      {"aggregator.patch_embed.patch_embed.proj.weight", "patch_embed"},
      {"depth_head.scratch.layer1_rn.weight", "depth"},
      {"point_head.projects.0.weight", "points"},
      {"feature_extractor.resize_layers.0.weight", "decoder.dpt"},
      {"rgb_decoder.0.final_conv.weight", "decoder.unet"},
      {"lang_decoder_small.up1.weight", "decoder.unet"}};
  for (const auto& [name, kind] : kinds) CHECK(kLayerKinds[layer_kind(name)] == kind);
}

TEST_CASE("StoragePolicy: kinds are chosen by module, by layer or by both; others are refused") {
  StoragePolicy policy;
  policy.set("fc2", Storage::kI8, "--kind");
  CHECK(policy.of_weight("camera_head.trunk.0.mlp.fc2") == Storage::kI8);
  CHECK(policy.of_weight("camera_head.trunk.0.mlp.fc1") == Storage::kF32);
  policy.set("dino", Storage::kBf16, "--kind");
  CHECK(policy.of_weight("aggregator.patch_embed.blocks.0.mlp.fc2") == Storage::kBf16);
  policy.set("decoder.dpt", Storage::kF16, "--kind");
  CHECK(policy.of_weight("feature_extractor.projects.0") == Storage::kF16);
  CHECK(policy.of_weight("lang_encoder.pool1") == Storage::kF32);
  CHECK_THROWS_WITH_AS(policy.set("depth", Storage::kI8, "--kind"),
                       doctest::Contains("--kind: depth cannot be int8"), Error);
  CHECK_THROWS_WITH_AS(policy.set("dino.fc3", Storage::kI8, "--kind"),
                       doctest::Contains("dino.fc3"), Error);
}

TEST_CASE(
    "narrow storage: bf16 changes the outputs by at most 1%, f16 0.3%, int8 3%, but does change "
    "them") {
  const Outputs exact = run({}, Storage::kF32);
  CHECK(difference(run({}, Storage::kF32), exact) == 0);
  const auto within = [&](Storage weights, Storage cache, double limit) {
    CAPTURE(storage_name(weights));
    CAPTURE(storage_name(cache));
    const double changed = difference(run(StoragePolicy::of(weights), cache), exact);
    CHECK(changed > 0);
    CHECK(changed <= limit);
  };
  within(Storage::kF16, Storage::kF32, 0.003);
  within(Storage::kBf16, Storage::kBf16, 0.01);
  within(Storage::kF32, Storage::kBf16, 0.003);
  within(Storage::kF32, Storage::kI8, 0.01);
  within(Storage::kI8, Storage::kI8, 0.03);
}

TEST_CASE("narrow storage: f16 for the cache is refused by name") {
  TinyModel tiny;
  StreamOptions options;
  options.cache_storage = Storage::kF16;
  CHECK_THROWS_WITH_AS(Stream(tiny.model, tiny.ctx, options), doctest::Contains("not f16"), Error);
}
