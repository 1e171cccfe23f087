// SPDX-License-Identifier: Apache-2.0
// The program lift_video with a semantic decoder, a state decoder or both.
#include <doctest/doctest.h>

#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/field/lifted_field.h"
#include "tests/support/lift_scene.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using test::contents;
using test::LiftScene;
using Result = test::ProgramResult;
namespace fs = std::filesystem;

TEST_CASE("lift_video: a decoder, a state decoder or both run on one pass of the geometry") {
  LiftScene scene(2);
  ModelConfig config = load_config(lvggt::test::test_data("golden/config_tiny.json"));
  scene.init({"--config", lvggt::test::test_data("golden/config_tiny.json"), "--seed", "1",
              "--decoder-out", scene / "decoder.safetensors", scene / "geometry.safetensors"});
  config.sbd_levels = 1;
  config.lang_dim = 6;
  test::write_tensors(scene / "states.safetensors", decoder_tensors(config), &config);
  const auto lift = [&](const std::string& out, std::vector<std::string> more) {
    more.insert(more.begin(), {scene / "frames", "--mode", "original", "--out", scene / out,
                               "--weights", scene / "geometry.safetensors"});
    return scene.run(more);
  };
  const std::string decoder = scene / "decoder.safetensors", states = scene / "states.safetensors";
  const Result both = lift("both", {"--decoder", decoder, "--state-decoder", states});
  INFO(both.err);
  REQUIRE(both.status == 0);
  REQUIRE(lift("decoder", {"--decoder", decoder}).status == 0);
  REQUIRE(lift("states", {"--state-decoder", states}).status == 0);
  const auto all = contents(scene / "both"), one = contents(scene / "decoder"),
             other = contents(scene / "states");
  for (const char* name : {"codes/000001.safetensors", "depth/000001.png", "points/000001.ply",
                           "semantics_large/000001.png", "rgb/000001.png"})
    CHECK_MESSAGE(all.at(name) == one.at(name), name);
  for (const char* name : {"state_codes/000001.safetensors", "semantics_state/000001.png"})
    CHECK_MESSAGE(all.at(name) == other.at(name), name);
  CHECK(one.count("state_codes/000001.safetensors") == 0);
  CHECK(other.count("codes/000001.safetensors") == 0);
  CHECK(other.count("rgb/000001.png") == 1);  // of the state decoder
  const LiftedField field = LiftedField::open(scene / "both");
  CHECK(field.codes(CodesKind::kState).dim == 6);
  CHECK(field.codes(CodesKind::kLanguage).decoder_sha256.size() == 64);
  CHECK(test::read_bytes(scene / "both/run.json").find("\"role\": \"state_decoder\"") !=
        std::string::npos);

  REQUIRE(lift("none", {"--decoder", decoder, "--state-decoder", states, "--no-codes"}).status ==
          0);
  CHECK(contents(scene / "none").count("codes/000000.safetensors") == 0);
  CHECK_FALSE(LiftedField::open(scene / "none").has_codes(CodesKind::kState));
  const Result plan = lift("none", {"--state-decoder", states, "--dry-run"});
  CHECK(plan.out.find("the state decoder (1 x 6)") != std::string::npos);
  CHECK(plan.out.find("a frame, for queries") != std::string::npos);
}

TEST_CASE("lift_video: a state decoder of another model, or none, is refused by name") {
  LiftScene scene(1);
  ModelConfig config = load_config(lvggt::test::test_data("golden/config_tiny.json"));
  config.sbd_levels = 1;
  config.taps[3] -= 1;
  test::write_tensors(scene / "other.safetensors", decoder_tensors(config), &config);
  const Result other = scene.lift({"--state-decoder", scene / "other.safetensors"});
  CHECK(other.status == 3);
  CHECK(other.says("other.safetensors: was made for another geometry model"));
  const Result model = scene.lift({"--state-decoder", scene / "missing.safetensors"});
  CHECK(model.status == 3);
  CHECK(model.says("missing.safetensors"));
  CHECK_FALSE(fs::exists(scene / "out"));
}
