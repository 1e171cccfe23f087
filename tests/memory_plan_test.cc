// SPDX-License-Identifier: Apache-2.0
// What lift_video says it will need against what it takes, as the system measured it.
#include "lvggt/model/memory_plan.h"

#include <doctest/doctest.h>

#include <filesystem>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/io/json.h"
#include "lvggt/io/png.h"
#include "lvggt/model/config.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/sanitizer.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;
using namespace lvggt::test;
namespace fs = std::filesystem;

namespace {

struct Result {
  int status = 0;
  std::string out, err;
};

Result run(const std::vector<std::string>& argv) {
  ChildProcess child(argv);
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

// Models and folders of pictures, made once.
class Lab {
 public:
  Lab() {
    ModelConfig config = load_config(test_data("golden/config_tiny.json"));
    write_model("tiny", config);
    config.embed_dim = 384;  // 19 M weights in the blocks and the camera head
    config.dino_heads = config.agg_heads = config.cam_heads = 6;
    config.dino_depth = config.agg_depth = 2;
    config.taps = {0, 0, 1, 1};
    config.cam_trunk_depth = 1;
    write_model("wide", config);
    REQUIRE(run({program("weights_quantize"), path("wide"), path("int8")}).status == 0);
    write_pictures("small", 16, 196, 196);
    write_pictures("large", 2, 588, 784);
  }

  // Whether the run took what it said, within a tenth.
  void check(const std::string& model, const std::string& pictures,
             std::vector<std::string> options) const {
    options.insert(options.begin(),
                   {program("lift_video"), dir_ / pictures, "--weights", path(model), "--mode",
                    "original", "--out", dir_ / "out", "--force", "--summary", "-"});
    const Result result = run(options);
    CAPTURE(result.err);
    REQUIRE(result.status == 0);
    const Json record = Json::parse(result.out, "the summary");
    const auto bytes = [&](const char* field) {
      return static_cast<double>(record.find(field)->as_int64(field));
    };
    const double planned = bytes("planned_memory_bytes"), peak = bytes("peak_memory_bytes");
    CAPTURE(planned / 0x1p20);
    CAPTURE(peak / 0x1p20);
    CHECK(peak > 40 * 0x1p20);
    CHECK(planned > 0.9 * peak);
    CHECK(planned < 1.1 * peak);
    MESSAGE("planned ", planned / 0x1p20, " peak ", peak / 0x1p20, " ratio ", planned / peak);
  }

  Result dry_run(std::vector<std::string> options) const {
    options.insert(options.begin(), {program("lift_video"), dir_ / "small", "--weights",
                                     path("wide"), "--mode", "original", "--dry-run"});
    return run(options);
  }

 private:
  std::string path(const std::string& model) const { return dir_ / (model + ".safetensors"); }

  void write_model(const std::string& name, const ModelConfig& config) {
    write_bytes(dir_ / "config.json", to_json(config));
    REQUIRE(run({program("weights_init"), "--config", dir_ / "config.json", path(name)}).status ==
            0);
  }

  void write_pictures(const std::string& folder, int count, std::int64_t H, std::int64_t W) {
    fs::create_directory(dir_ / folder);
    Tensor<std::uint8_t, 3> pixels(Shape{H, W, std::int64_t{3}});
    for (int i = 0; i < count; ++i) {
      for (std::int64_t j = 0; j < pixels.size(); ++j)
        pixels.data()[j] = static_cast<std::uint8_t>(j * (i + 3) % 251);
      write_png(dir_ / (folder + "/" + std::to_string(100 + i) + ".png"), pixels);
    }
  }

  TempDir dir_;
};

}  // namespace

TEST_CASE("D39: the memory stated before a run is close to its peak, 12 configurations") {
  if (kSanitized) return;
  const Lab lab;
  SUBCASE("large frames: scratch and outputs") {
    lab.check("tiny", "large", {});
    lab.check("tiny", "large", {"--no-decoder"});
    lab.check("wide", "large", {"--no-ply", "--no-contact-sheet"});
  }
  SUBCASE("weights") {
    lab.check("wide", "small", {"--max-frames", "1"});
    lab.check("wide", "small", {"--max-frames", "1", "--weights-storage", "bf16"});
    lab.check("wide", "small", {"--max-frames", "1", "--weights-storage", "int8"});
    lab.check("int8", "small", {"--max-frames", "2"});
    lab.check("int8", "small", {"--max-frames", "1", "--weights-storage", "f16"});
  }
  SUBCASE("caches") {
    lab.check("wide", "small", {});
    lab.check("wide", "small", {"--max-past-frames", "4", "--threads", "4"});
    lab.check("wide", "small", {"--cache-storage", "bf16", "--camera-cache", "frame"});
    lab.check("int8", "small", {"--cache-storage", "int8"});
  }
}

TEST_CASE("D40: a run that does not fit is refused with the storage or the window that would") {
  const Lab lab;
  const auto refusal = [&](std::vector<std::string> options) {
    const Result result = lab.dry_run(options);
    CHECK(result.status == 4);
    return result.err;
  };
  const auto contains = [](const std::string& text, const std::string& part) {
    CAPTURE(text);
    CHECK(text.find(part) != std::string::npos);
  };
  const std::string nothing = refusal({"--memory-limit", "30M"});
  contains(nothing, "no smaller setting fits");
  const Result whole = lab.dry_run({});
  REQUIRE(whole.status == 0);
  contains(whole.out, "memory        about");
  contains(whole.out, "weights");
  contains(whole.out, "cache of past frames");
  contains(whole.out, "time          about");
  contains(whole.out, "15 past frames");
  // Half-way between what int8 needs and what float32 needs: the process itself is part of both.
  const auto planned = [](const Result& plan) {
    constexpr std::string_view kAbout = "memory        about ";
    const std::size_t at = plan.out.find(kAbout);
    REQUIRE(at != std::string::npos);
    REQUIRE(plan.out.find(" MiB", at) != std::string::npos);
    return std::stol(plan.out.substr(at + kAbout.size()));
  };
  const Result int8 = lab.dry_run({"--weights-storage", "int8"});
  REQUIRE(planned(int8) < planned(whole));
  const std::string narrower =
      refusal({"--memory-limit", std::to_string((planned(int8) + planned(whole)) / 2) + "M"});
  contains(narrower, "--memory-limit");
  contains(narrower, "--weights-storage");
  contains(narrower, "would fit");
}

TEST_CASE("plan_memory: a storage for each weight, and int8's scales and sums, count") {
  const ModelConfig config;
  StreamOptions options;
  options.max_past_frames = 1;
  const auto weights = [&](const StoragePolicy& policy) {
    return plan_memory(config, 294, 518, options, policy).weights;
  };
  StoragePolicy policy;
  const std::size_t f32 = weights(policy);
  policy.set("global.fc1", Storage::kBf16, "");
  CHECK(f32 - weights(policy) == 24u * 4096u * 1024u * 2u);
  policy.set("global.fc1", Storage::kI8, "");
  CHECK(f32 - weights(policy) == 24u * (4096u * 1024u * 3u - 4096u * 8u));
}
