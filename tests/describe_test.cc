// SPDX-License-Identifier: Apache-2.0
#include "weights/describe.h"

#include <doctest/doctest.h>

#include <string>
#include <vector>

#include "lvggt/io/json.h"
#include "lvggt/model/tensor_list.h"
#include "tests/support/paths.h"
#include "tests/support/safetensors_bytes.h"

using lvggt::describe_weights;
using lvggt::ModelConfig;
using lvggt::WeightsDescription;
using lvggt::test::TempDir;

namespace {

// A model of a few kilobytes.
ModelConfig small_config() {
  ModelConfig config;
  config.img_size = 28;
  config.embed_dim = 16;
  config.dino_depth = 1;
  config.dino_heads = config.agg_heads = config.cam_heads = 2;
  config.agg_depth = 4;
  config.taps = {0, 1, 2, 3};
  config.cam_trunk_depth = 1;
  config.dpt_features = 8;
  config.dpt_out_channels = config.sbd_out_channels = {8, 8, 8, 8};
  config.dpt_head_features_2 = 8;
  config.sbd_features = 8;
  config.sbd_hidden_dim = 4;
  return config;
}

// Writes all tensors but `without`, zeros except for the first value; `odd` gets another shape.
void write_model(const std::string& path, const std::string& without, const std::string& odd) {
  const ModelConfig config = small_config();
  lvggt::SafetensorsWriter out(path);
  out.set_metadata("config", lvggt::to_json(config));
  out.set_metadata("odd\nkey", "a\x1b[2Jb");
  auto specs = lvggt::geometry_tensors(config);
  const auto decoder = lvggt::decoder_tensors(config);
  specs.insert(specs.end(), decoder.begin(), decoder.end());
  for (const auto& spec : specs) {
    if (spec.name == without) continue;
    const std::vector<std::int64_t> shape =
        spec.name == odd ? std::vector<std::int64_t>{3} : spec.shape;
    std::int64_t size = 1;
    for (const std::int64_t extent : shape) size *= extent;
    std::vector<float> values(static_cast<std::size_t>(size), 0.0f);
    if (spec.name != "camera_head.token_norm.bias") values[0] = 1;
    out.add(spec.name, shape, values);
  }
  out.finish();
}

}  // namespace

TEST_CASE("describe_weights: a whole model is recognised, with its configuration and parts") {
  const TempDir dir;
  write_model(dir / "m.safetensors", "", "");
  WeightsDescription d = describe_weights(dir / "m.safetensors");
  CHECK(d.format == "safetensors");
  CHECK(d.contents.find("StreamVGGT") != std::string::npos);
  CHECK(d.contents.find("Decoder") != std::string::npos);
  CHECK(d.config_from_metadata);
  CHECK(d.config->embed_dim == 16);
  CHECK(d.missing.empty());
  CHECK(d.misshapen.empty());
  CHECK(d.extra.empty());
  CHECK(d.parts.at("rgb_decoder").num_tensors > 0);
  lvggt::check_values(dir / "m.safetensors", d);
  CHECK(d.suspicious ==
        std::vector<std::string>{"camera_head.token_norm.bias: all values are zero"});
}

TEST_CASE("describe_weights: missing and misshapen tensors are named") {
  const TempDir dir;
  write_model(dir / "m.safetensors", "camera_head.token_norm.bias",
              "camera_head.token_norm.weight");
  const WeightsDescription d = describe_weights(dir / "m.safetensors");
  CHECK(d.missing == std::vector<std::string>{"camera_head.token_norm.bias"});
  CHECK(d.misshapen == std::vector<std::string>{"camera_head.token_norm.weight is [3], not [32]"});
}

TEST_CASE(
    "description_text, description_json: control characters of the file do not reach the "
    "terminal") {
  const TempDir dir;
  write_model(dir / "m.safetensors", "", "");
  const WeightsDescription d = describe_weights(dir / "m.safetensors");
  const std::string text = lvggt::description_text(d, std::string(64, 'a'));
  CHECK(text.find('\x1b') == std::string::npos);
  CHECK(text.find("odd\\x0akey = a\\x1b[2Jb") != std::string::npos);
  CHECK(text.find(std::string(64, 'a')) != std::string::npos);
  const std::string json_text = lvggt::description_json(d, "");
  CHECK(json_text.find('\x1b') == std::string::npos);
  const lvggt::Json json = lvggt::Json::parse(json_text, "x");
  CHECK(json.find("parameters")->as_int64("parameters") == d.num_values);
  CHECK(json.find("config_from")->as_string("config_from") == "metadata");
}

TEST_CASE("describe_weights: a checkpoint of something else is said to be unknown") {
  const WeightsDescription d =
      describe_weights(lvggt::test::test_data("golden/checkpoint_nested.pth"));
  CHECK(d.format == "PyTorch checkpoint");
  CHECK(d.contents.find("nothing lvggt knows") != std::string::npos);
  CHECK(d.notes.size() == 2);
  CHECK_FALSE(d.config.has_value());
}
