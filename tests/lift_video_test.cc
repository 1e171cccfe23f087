// SPDX-License-Identifier: Apache-2.0
// The program lift_video as its users meet it: what it writes, and what it says to bad input.
#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>
#include <map>
#include <string>
#include <thread>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/field/lifted_field.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/json.h"
#include "lvggt/io/png.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/temp_dir.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
namespace fs = std::filesystem;

namespace {

struct Result {
  int status = 0;
  std::string out, err;
  bool says(const std::string& text) const { return err.find(text) != std::string::npos; }
};

Result finish(test::ChildProcess& child) {
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

// A folder with a small model, in one file and in two, and with pictures of 84 x 56 pixels.
class Scene {
 public:
  explicit Scene(int num_frames = 3) {
    init({"--config", lvggt::test::test_data("golden/config_tiny.json"), "--seed", "1",
          dir_ / "model.safetensors"});
    fs::create_directory(dir_ / "frames");
    for (int i = 0; i < num_frames; ++i) add_picture("img" + std::to_string(i) + ".png", 56, 84, i);
  }

  void init(std::vector<std::string> arguments) {
    arguments.insert(arguments.begin(), lvggt::test::program("weights_init"));
    test::ChildProcess child(arguments);
    const Result result = finish(child);
    INFO(result.err);
    REQUIRE(result.status == 0);
  }

  void add_picture(const std::string& name, std::int64_t H, std::int64_t W, int seed) {
    Tensor<std::uint8_t, 3> pixels(Shape{H, W, std::int64_t{3}});
    for (std::int64_t y = 0; y < H; ++y)
      for (std::int64_t x = 0; x < W; ++x)
        for (std::int64_t c = 0; c < 3; ++c)
          pixels(y, x, c) = static_cast<std::uint8_t>((x * (c + 1) + 3 * y + 20 * seed) % 256);
    write_png(dir_ / ("frames/" + name), pixels);
  }

  std::string operator/(const std::string& name) const { return dir_ / name; }

  // The command: frames to "out" with the model in one file, and more options.
  std::vector<std::string> command(const std::vector<std::string>& more = {}) const {
    std::vector<std::string> argv{lvggt::test::program("lift_video"),
                                  dir_ / "frames",
                                  "--weights",
                                  dir_ / "model.safetensors",
                                  "--out",
                                  dir_ / "out",
                                  "--mode",
                                  "original",
                                  "--threads",
                                  "2"};
    argv.insert(argv.end(), more.begin(), more.end());
    return argv;
  }
  Result lift(const std::vector<std::string>& more = {}) const {
    test::ChildProcess child(command(more));
    return finish(child);
  }
  // With the whole argument list.
  Result run(std::vector<std::string> arguments) const {
    arguments.insert(arguments.begin(), lvggt::test::program("lift_video"));
    test::ChildProcess child(arguments);
    return finish(child);
  }

  Json json(const std::string& name) const { return Json::read(dir_ / name); }
  std::string status() const {
    const Json record = json("out/run.json");
    return record.find("status")->as_string("status");
  }

 private:
  test::TempDir dir_;
};

// All files below a folder with their bytes, except the record of the run, which holds times.
std::map<std::string, std::string> contents(const std::string& folder) {
  std::map<std::string, std::string> files;
  for (const auto& entry : fs::recursive_directory_iterator(folder))
    if (entry.is_regular_file() && entry.path().filename() != "run.json")
      files[fs::relative(entry.path(), folder).string()] = test::read_bytes(entry.path().string());
  return files;
}

}  // namespace

TEST_CASE("lift_video: writes every output of every frame, under its final name only") {
  const Scene scene;
  const Result result = scene.lift({"--images", "--summary", scene / "summary.json"});
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.says("3 frames in"));
  std::vector<std::string> expected{"cameras.json",        "contact_sheet.png",
                                    "field.json",          "sparse/0/cameras.txt",
                                    "sparse/0/images.txt", "sparse/0/points3D.txt"};
  for (const char* frame : {"000000", "000001", "000002"}) {
    for (const char* folder : {"depth", "depth_color", "confidence", "rgb", "semantics_small",
                               "semantics_middle", "semantics_large", "images", "frames"})
      expected.push_back(std::string(folder) + "/" + frame + ".png");
    for (const char* folder : {"depth", "confidence"})
      expected.push_back(std::string(folder) + "/" + frame + ".json");
    expected.push_back(std::string("points/") + frame + ".ply");
    expected.push_back(std::string("codes/") + frame + ".safetensors");
  }
  std::sort(expected.begin(), expected.end());
  std::vector<std::string> found;
  for (const auto& [name, bytes] : contents(scene / "out")) found.push_back(name);
  CHECK(found == expected);

  const Json cameras = scene.json("out/cameras.json");
  CHECK(cameras.find("frames")->as_array("frames").size() == 3);
  const Json record = scene.json("out/run.json");
  CHECK(record.find("status")->as_string("status") == "complete");
  CHECK(record.find("peak_memory_bytes")->as_int64("peak") > 0);
  const Json summary = scene.json("summary.json");
  CHECK(summary.find("seconds")->find("depth_head")->as_double("s") > 0);
}

TEST_CASE("lift_video: outputs can be left out, and every n-th frame chosen") {
  const Scene scene;
  const Result result = scene.lift({"--no-ply", "--no-depth", "--no-confidence", "--no-rgb",
                                    "--no-contact-sheet", "--no-frames", "--every", "2"});
  REQUIRE(result.status == 0);
  std::vector<std::string> found;
  for (const auto& [name, bytes] : contents(scene / "out")) found.push_back(name);
  CHECK(found == std::vector<std::string>{
                     "cameras.json", "codes/000000.safetensors", "codes/000002.safetensors",
                     "field.json", "semantics_large/000000.png", "semantics_large/000002.png",
                     "semantics_middle/000000.png", "semantics_middle/000002.png",
                     "semantics_small/000000.png", "semantics_small/000002.png",
                     "sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"});
  CHECK(scene.json("out/cameras.json").find("frames")->as_array("frames").size() == 3);
  const std::string images = test::read_bytes(scene / "out/sparse/0/images.txt");
  CHECK(images.find(" 1 img0.png\n") != std::string::npos);
  CHECK(images.find(" 2 img2.png\n") != std::string::npos);
}

TEST_CASE(
    "lift_video: one file or two, one thread or three give the same bytes; geometry alone is "
    "said") {
  Scene scene;
  scene.init({"--config", lvggt::test::test_data("golden/config_tiny.json"), "--seed", "1",
              "--decoder-out", scene / "decoder.safetensors", scene / "geometry.safetensors"});
  REQUIRE(scene.lift().status == 0);
  const auto lift = [&](const std::string& out, std::vector<std::string> more) {
    more.insert(more.begin(),
                {scene / "frames", "--mode", "original", "--out", scene / out, "--weights"});
    return scene.run(more);
  };
  const Result two = lift("two", {scene / "geometry.safetensors", "--decoder",
                                  scene / "decoder.safetensors", "--threads", "1"});
  INFO(two.err);
  REQUIRE(two.status == 0);
  CHECK(contents(scene / "two") == contents(scene / "out"));
  CHECK(lift("three", {scene / "model.safetensors", "--threads", "3"}).status == 0);
  CHECK(contents(scene / "three") == contents(scene / "out"));

  const Result geometry = lift("geometry", {scene / "geometry.safetensors"});
  CHECK(geometry.status == 0);
  CHECK(geometry.says("geometry only"));
  const auto files = contents(scene / "geometry");
  CHECK(files.count("points/000000.ply") == 1);
  CHECK(files.count("rgb/000000.png") == 0);
  CHECK(files.at("depth/000001.png") == contents(scene / "out").at("depth/000001.png"));
}

TEST_CASE("lift_video: a decoder, a state decoder or both run on one pass of the geometry") {
  Scene scene(2);
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
  Scene scene(1);
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

TEST_CASE(
    "D01: wrong options of lift_video are refused by name with status 2, and nothing is written") {
  const Scene scene(1);
  CHECK(scene.run({}).status == 2);
  CHECK(scene.run({"--help"}).status == 0);
  CHECK(scene.run({"--version"}).out.find("lift_video") == 0);
  const std::vector<std::pair<std::vector<std::string>, std::string>> wrong{
      {{"--strid", "2"}, "--stride"},
      {{"--stride", "0"}, "--stride: '0'"},
      {{"--stride", "-3"}, "--stride: '-3'"},
      {{"--max-frames", "0"}, "--max-frames: '0'"},
      {{"--start", "-1"}, "--start: '-1'"},
      {{"--every", "1x"}, "--every: '1x'"},
      {{"--threads", "0"}, "--threads"},
      {{"--threads", "1000000"}, "--threads"},
      {{"--threads", "-1"}, "--threads"},
      {{"--percentile", "nan"}, "--percentile: 'nan'"},
      {{"--percentile", "1e400"}, "1e400"},
      {{"--size", "100"}, "--size: 100 is not a multiple of 14"},
      {{"--mode", "crop"}, "--mode is given more than once"},
      {{"--camera-cache", "none"}, "--camera-cache"},
      {{"--memory-limit", "lots"}, "--memory-limit"},
      {{"--max-past-frames", "0"}, "--max-past-frames: '0'"},
      {{"--force", "--resume"}, "exclude each other"},
      {{"--start", "5"}, "5"}};
  for (const auto& one : wrong) {
    const auto& options = one.first;
    const std::string& message = one.second;
    const Result result = scene.lift(options);
    INFO(options[0], ": ", result.err);
    CHECK(result.status == 2);
    CHECK(result.says(message));
    CHECK(std::count(result.err.begin(), result.err.end(), '\n') <= 2);
  }
  CHECK(scene.run({scene / "frames", "--weights", scene / "model.safetensors"})
            .says("--out is required"));
  CHECK_FALSE(fs::exists(scene / "out"));
}

TEST_CASE("D02: an output folder that is not free is refused and stays as it was") {
  const Scene scene(1);
  const auto lift_to = [&](const std::string& out, std::vector<std::string> more = {}) {
    more.insert(more.begin(), {scene / "frames", "--weights", scene / "model.safetensors", "--mode",
                               "original", "--out", out});
    return scene.run(more);
  };
  test::write_bytes(scene / "file", "mine");
  CHECK(lift_to(scene / "file").status == 1);
  CHECK(lift_to(scene / "file", {"--force"}).says("is a file"));
  CHECK(test::read_bytes(scene / "file") == "mine");

  CHECK(lift_to(scene / "no/such/parent").says("there is no folder"));
  CHECK(lift_to("/proc/lvggt_out").status == 1);
  CHECK(lift_to("").status == 2);

  fs::create_directory(scene / "foreign");
  test::write_bytes(scene / "foreign/cameras.json", "mine");
  CHECK(lift_to(scene / "foreign").status == 2);
  const Result forced = lift_to(scene / "foreign", {"--force"});
  CHECK(forced.status == 2);
  CHECK(forced.says("holds no earlier run"));
  CHECK(test::read_bytes(scene / "foreign/cameras.json") == "mine");

  fs::create_directory(scene / "empty dir");
  CHECK(lift_to(scene / "empty dir/").status == 0);
  const auto before = contents(scene / "empty dir");
  const Result again = lift_to(scene / "empty dir");
  CHECK(again.status == 2);
  CHECK(again.says("--force replaces it"));
  CHECK(contents(scene / "empty dir") == before);
}

TEST_CASE("D02: --force replaces an earlier run and leaves foreign files alone") {
  const Scene scene(3);
  REQUIRE(scene.lift().status == 0);
  test::write_bytes(scene / "out/depth/notes.txt", "mine");
  test::write_bytes(scene / "out/notes.txt", "mine");
  REQUIRE(scene.lift({"--force", "--max-frames", "1", "--no-ply"}).status == 0);
  const auto files = contents(scene / "out");
  CHECK(files.count("depth/000000.png") == 1);
  CHECK(files.count("depth/000002.png") == 0);
  CHECK(files.count("points/000000.ply") == 0);
  CHECK(files.at("depth/notes.txt") == "mine");
  CHECK(files.at("notes.txt") == "mine");
}

TEST_CASE(
    "lift_video: weights that are missing, empty, cut short or none are bad input, status 3") {
  const Scene scene(1);
  test::write_bytes(scene / "empty.safetensors", "");
  const std::string model = test::read_bytes(scene / "model.safetensors");
  test::write_bytes(scene / "cut.safetensors", model.substr(0, model.size() / 2));
  test::write_bytes(scene / "page.safetensors", "<!DOCTYPE html><html>404</html>");
  for (const char* name :
       {"no.safetensors", "empty.safetensors", "cut.safetensors", "page.safetensors", "frames"}) {
    const Result result = scene.run({scene / "frames", "--weights", scene / name, "--out",
                                     scene / "out", "--mode", "original"});
    INFO(name, ": ", result.err);
    CHECK(result.status == 3);
    CHECK(result.says(name));
  }
  CHECK_FALSE(fs::exists(scene / "out"));
}

TEST_CASE("lift_video: input that is missing, empty or without frames is status 3") {
  const Scene scene(1);
  fs::create_directory(scene / "nothing");
  test::write_bytes(scene / "empty.mp4", "");
  test::write_bytes(scene / "text.mp4", "this is no video");
  test::write_bytes(scene / "text.png", "this is no picture");
  for (const char* name : {"missing.mp4", "nothing", "empty.mp4", "text.mp4", "text.png"}) {
    const Result result = scene.run({scene / name, "--weights", scene / "model.safetensors",
                                     "--out", scene / "out", "--mode", "original"});
    INFO(name, ": ", result.err);
    CHECK(result.status == 3);
    CHECK(result.says(name));
  }
  CHECK_FALSE(fs::exists(scene / "out"));
}

TEST_CASE(
    "C17: a frame of another size ends the run, is named, and what is complete stays usable") {
  Scene scene(2);
  scene.add_picture("img2.png", 70, 84, 2);
  const Result result = scene.lift();
  CHECK(result.status == 3);
  CHECK(result.says("img2.png"));
  CHECK(scene.status() == "failed");
  CHECK(scene.json("out/cameras.json").find("frames")->as_array("frames").size() == 2);
  CHECK(fs::exists(scene / "out/points/000001.ply"));
}

TEST_CASE("D40: a run over --memory-limit is refused before it starts, with what would fit") {
  const Scene scene;
  const Result result = scene.lift({"--memory-limit", "1M"});
  CHECK(result.status == 4);
  CHECK(result.says("--memory-limit"));
  CHECK(result.says("of memory"));
  CHECK_FALSE(fs::exists(scene / "out"));
}

TEST_CASE("lift_video: --dry-run prints the plan and writes nothing") {
  const Scene scene;
  const Result result = scene.lift({"--dry-run"});
  CHECK(result.status == 0);
  CHECK(result.out.find("3 frames of 84 x 56") != std::string::npos);
  CHECK(result.out.find("memory ") != std::string::npos);
  CHECK_FALSE(fs::exists(scene / "out"));
}

TEST_CASE(
    "D07: SIGINT finishes the file at hand, exit 130; --resume gives what one run would have") {
  const Scene scene(24);
  const Result uninterrupted =
      scene.run({scene / "frames", "--weights", scene / "model.safetensors", "--mode", "original",
                 "--out", scene / "whole"});
  INFO(uninterrupted.err);
  REQUIRE(uninterrupted.status == 0);
  {
    test::ChildProcess child(scene.command());
    while (child.running() && !fs::exists(scene / "out/points/000001.ply"))
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    child.send(SIGINT);
    const Result result = finish(child);
    INFO(result.err);
    REQUIRE(result.status == 130);
    CHECK(result.says("--resume continues"));
  }
  CHECK(scene.status() == "interrupted");
  const auto frames = scene.json("out/cameras.json").find("frames")->as_array("frames").size();
  CHECK(frames >= 2);
  CHECK(frames < 24);
  const auto whole = contents(scene / "whole");
  for (const auto& [name, bytes] : contents(scene / "out"))
    if (name.find('/') != std::string::npos && !name.starts_with("sparse"))
      CHECK(whole.at(name) == bytes);

  const Result other = scene.lift({"--resume", "--percentile", "10"});
  CHECK(other.status == 2);
  CHECK(other.says("percentile was 3 and is 10"));
  const Result resumed = scene.lift({"--resume"});
  INFO(resumed.err);
  REQUIRE(resumed.status == 0);
  CHECK(resumed.says("were there already"));
  CHECK(contents(scene / "out") == whole);
  CHECK(scene.lift({"--resume"}).says("complete already"));
}

TEST_CASE("C21: a video that ends early gives the frames there are, status 5, and says so") {
  const Scene scene(0);
  const std::string clip = test::read_bytes(lvggt::test::test_data("../examples/data/cup_24.mp4"));
  test::write_bytes(scene / "cut.mp4", clip.substr(0, clip.size() / 3));
  const Result result = scene.run({scene / "cut.mp4", "--weights", scene / "model.safetensors",
                                   "--out", scene / "out", "--size", "84", "--no-ply", "--no-depth",
                                   "--no-confidence", "--no-rgb"});
  INFO(result.err);
  CHECK(result.status == 5);
  CHECK(result.says("warning: "));
  CHECK(scene.status() == "partial");
  const auto frames = scene.json("out/cameras.json").find("frames")->as_array("frames").size();
  CHECK(frames >= 1);
  CHECK(frames < 24);
  CHECK(fs::exists(scene / "out/contact_sheet.png"));
}

TEST_CASE("D09: a disk that is full ends the run with status 1 and leaves no cut file") {
  const Scene scene;
  test::ChildProcess child(scene.command({"--no-codes"}), 60'000);  // a point cloud has more
  const Result result = finish(child);
  INFO(result.err);
  CHECK(result.status == 1);
  CHECK(result.says("points/000000.ply"));
  CHECK(scene.status() == "failed");
  for (const auto& [name, bytes] : contents(scene / "out"))
    CHECK(name.find("000000.ply") == std::string::npos);
}

TEST_CASE("A60: weights whose SHA-256 is not the one given are refused, and nothing is written") {
  const Scene scene(1);
  const Result wrong = scene.lift({"--sha256", std::string(64, 'a')});
  CHECK(wrong.status == 3);
  CHECK(wrong.says("model.safetensors"));
  CHECK_FALSE(std::filesystem::exists(scene / "out"));
  CHECK(scene.lift({"--sha256", "abc"}).status == 2);
  CHECK(scene.lift({"--sha256", sha256_file(scene / "model.safetensors")}).status == 0);
}

TEST_CASE("lift_video: kept frames are recorded in the settings of the run") {
  const Scene scene;
  REQUIRE(
      scene.lift({"--max-past-frames", "2", "--keep-first-frame", "--keep-every", "2"}).status ==
      0);
  const std::string run = test::read_bytes(scene / "out/run.json");
  CHECK(run.find("\"keep_first_frame\": \"yes\"") != std::string::npos);
  CHECK(run.find("\"keep_every\": \"2\"") != std::string::npos);
}
