// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/config.h"

#include <doctest/doctest.h>

#include <fstream>
#include <iterator>
#include <map>
#include <string>

#include "lvggt/core/error.h"
#include "lvggt/model/tensor_list.h"
#include "tests/support/paths.h"

namespace {

using lvggt::ErrorKind;
using lvggt::ModelConfig;

std::string message_of(const std::string& json, ErrorKind kind) {
  try {
    lvggt::parse_config(json, "c.json");
  } catch (const lvggt::Error& e) {
    CHECK(e.kind() == kind);
    return e.what();
  }
  FAIL("accepted: ", json);
  return {};
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

std::int64_t total_values(const ModelConfig& config) {
  std::int64_t total = 0;
  for (const auto& spec : lvggt::geometry_tensors(config)) total += spec.volume();
  for (const auto& spec : lvggt::decoder_tensors(config)) total += spec.volume();
  return total;
}

ModelConfig tiny() { return lvggt::load_config(lvggt::test::test_data("golden/config_tiny.json")); }

}  // namespace

TEST_CASE("parse_config: an empty object is the published configuration") {
  CHECK(lvggt::parse_config("{}", "c.json") == ModelConfig{});
}

TEST_CASE("parse_config: every key of the reference configuration is understood") {
  const ModelConfig config = tiny();
  CHECK(config.embed_dim == 64);
  CHECK(config.taps == std::array<std::int64_t, 4>{0, 1, 2, 3});
  CHECK(config.dino_ln_eps == 1e-6);
  CHECK(config.sbd_levels == 3);
}

TEST_CASE("to_json: parses back to the same configuration") {
  ModelConfig config = tiny();
  config.sbd_head = lvggt::DecoderHead::kMlp;
  config.sbd_rgb = false;
  config.dpt_ln_eps = 1.2345678901234567e-5;
  CHECK(lvggt::parse_config(lvggt::to_json(config), "c.json") == config);
}

TEST_CASE("B24: an unknown key is refused with the nearest known one") {
  CHECK(contains(message_of(R"({"embed_dims": 64})", ErrorKind::kFormat), "\"embed_dim\""));
}

TEST_CASE("B24: configurations that are not a flat JSON object of the right types are refused") {
  CHECK(contains(message_of("[1]", ErrorKind::kFormat), "array"));
  message_of("", ErrorKind::kFormat);
  message_of(R"({"embed_dim": 64,})", ErrorKind::kFormat);
  message_of(R"({"embed_dim": 64} // comment)", ErrorKind::kFormat);
  CHECK(contains(message_of(R"({"embed_dim": "64"})", ErrorKind::kFormat), "an integer"));
  message_of(R"({"embed_dim": 64.5})", ErrorKind::kFormat);
  message_of(R"({"embed_dim": 18446744073709551615})", ErrorKind::kFormat);
  message_of(R"({"taps": [1, 2, 3]})", ErrorKind::kFormat);
  message_of(R"({"sbd_head": "cnn"})", ErrorKind::kFormat);
  CHECK(contains(message_of(R"({"seed": 1, "seed": 2})", ErrorKind::kFormat), "twice"));
  message_of(std::string(100000, '['), ErrorKind::kLimit);
  message_of("\xEF\xBB\xBF{}", ErrorKind::kFormat);
  message_of(R"({"embed_dim": true})", ErrorKind::kFormat);
  message_of(R"({"sbd_rgb": 1})", ErrorKind::kFormat);
  CHECK(
      lvggt::parse_config("{\r\n\"embed_dim\": 64,\r\n\"agg_heads\": 4\r\n}", "c.json").embed_dim ==
      64);
  message_of(std::string(2000000, ' '), ErrorKind::kLimit);
}

TEST_CASE("B24: values out of range or at odds with each other are refused") {
  for (const char* json :
       {R"({"embed_dim": 0})", R"({"embed_dim": -64})", R"({"embed_dim": 1099511627776})",
        R"({"embed_dim": 65})", R"({"img_size": 519})", R"({"taps": [4, 11, 17, 24]})",
        R"({"taps": [11, 4, 17, 23]})", R"({"dino_ln_eps": 0})", R"({"image_std": [1, 0, 1]})",
        R"({"sbd_levels": 2})", R"({"mlp_ratio": 1e300})", R"({"dpt_features": 12})"})
    message_of(json, ErrorKind::kMismatch);
}

TEST_CASE(
    "parse_config: options of the release with another value than implemented are unsupported") {
  message_of(R"({"depth_activation": "relu"})", ErrorKind::kUnsupported);
  message_of(R"({"interpolate_antialias": false})", ErrorKind::kUnsupported);
}

TEST_CASE("load_config: a missing file and a directory are refused") {
  CHECK_THROWS_AS(lvggt::load_config("/nonexistent/config.json"), lvggt::Error);
  CHECK_THROWS_AS(lvggt::load_config("/tmp"), lvggt::Error);
}

TEST_CASE("tensor_list: the published configuration has 1,219,050,724 values") {
  CHECK(total_values(ModelConfig{}) == 1219050724);
}

TEST_CASE("tensor_list: names and shapes of the reference checkpoint, no more and no fewer") {
  std::ifstream file(
      lvggt::test::test_data("golden/tensors_tiny.txt"));  // one `name extent,extent,...` a line
  std::map<std::string, std::string> expected;
  for (std::string name, shape; file >> name >> shape;) expected[name] = shape;
  REQUIRE(expected.size() == 689);
  std::size_t found = 0;
  const auto check = [&](const std::vector<lvggt::TensorSpec>& specs) {
    for (const auto& spec : specs) {
      std::string shape;
      for (const auto extent : spec.shape)
        shape += (shape.empty() ? "" : ",") + std::to_string(extent);
      INFO(spec.name);
      CHECK(expected[spec.name] == shape);
      ++found;
    }
  };
  check(lvggt::geometry_tensors(tiny()));
  check(lvggt::decoder_tensors(tiny()));
  CHECK(found == 689);
}

TEST_CASE("tensor_list: ablations leave out what they do not use") {
  ModelConfig config = tiny();
  config.sbd_rgb = false;
  config.sbd_levels = 1;
  for (const auto& spec : lvggt::decoder_tensors(config))
    CHECK_FALSE(spec.name.starts_with("rgb_"));
  CHECK(lvggt::language_decoder_names(config) == std::vector<std::string>{"lang_decoder"});
  config.sbd_head = lvggt::DecoderHead::kMlp;
  config.sbd_dpt = false;
  CHECK(lvggt::decoder_tensors(config).size() == 6);
}

TEST_CASE("known_unused_tensor: the track head, the mask token and batch counters") {
  CHECK(lvggt::known_unused_tensor("track_head.feature_extractor.norm.weight"));
  CHECK(lvggt::known_unused_tensor("aggregator.patch_embed.mask_token"));
  CHECK(lvggt::known_unused_tensor("lang_encoder.down1.1.num_batches_tracked"));
  CHECK_FALSE(lvggt::known_unused_tensor("aggregator.camera_token"));
}
