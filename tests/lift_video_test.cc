// SPDX-License-Identifier: Apache-2.0
// The program lift_video as its users meet it: what it writes, and what it says to bad input.
#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>
#include <string>
#include <thread>
#include <vector>

#include "lvggt/io/hash.h"
#include "tests/support/lift_scene.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using test::contents;
using test::LiftScene;
using Result = test::ProgramResult;
namespace fs = std::filesystem;

TEST_CASE("lift_video: writes every output of every frame, under its final name only") {
  const LiftScene scene;
  const Result result = scene.lift({"--images", "--summary", scene / "summary.json"});
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.says("3 frames in"));
  std::vector<std::string> expected{
      "cameras.json",         "cloud.png",           "contact_sheet.png",    "field.json",
      "sparse/0/cameras.txt", "sparse/0/images.txt", "sparse/0/points3D.txt"};
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
  const LiftScene scene;
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
  LiftScene scene;
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

TEST_CASE(
    "D01: wrong options of lift_video are refused by name with status 2, and nothing is written") {
  const LiftScene scene(1);
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
  const LiftScene scene(1);
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
  const LiftScene scene(3);
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
  const LiftScene scene(1);
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
  const LiftScene scene(1);
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
  LiftScene scene(2);
  scene.add_picture("img2.png", 70, 84, 2);
  const Result result = scene.lift();
  CHECK(result.status == 3);
  CHECK(result.says("img2.png"));
  CHECK(scene.status() == "failed");
  CHECK(scene.json("out/cameras.json").find("frames")->as_array("frames").size() == 2);
  CHECK(fs::exists(scene / "out/points/000001.ply"));
}

TEST_CASE("D40: a run over --memory-limit is refused before it starts, with what would fit") {
  const LiftScene scene;
  const Result result = scene.lift({"--memory-limit", "1M"});
  CHECK(result.status == 4);
  CHECK(result.says("--memory-limit"));
  CHECK(result.says("of memory"));
  CHECK_FALSE(fs::exists(scene / "out"));
}

TEST_CASE("lift_video: --dry-run prints the plan and writes nothing") {
  const LiftScene scene;
  const Result result = scene.lift({"--dry-run"});
  CHECK(result.status == 0);
  CHECK(result.out.find("3 frames of 84 x 56") != std::string::npos);
  CHECK(result.out.find("memory ") != std::string::npos);
  CHECK_FALSE(fs::exists(scene / "out"));
}

TEST_CASE(
    "D07: SIGINT finishes the file at hand, exit 130; --resume gives what one run would have") {
  const LiftScene scene(24);
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
  const LiftScene scene(0);
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
  const LiftScene scene;
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
  const LiftScene scene(1);
  const Result wrong = scene.lift({"--sha256", std::string(64, 'a')});
  CHECK(wrong.status == 3);
  CHECK(wrong.says("model.safetensors"));
  CHECK_FALSE(std::filesystem::exists(scene / "out"));
  CHECK(scene.lift({"--sha256", "abc"}).status == 2);
  CHECK(scene.lift({"--sha256", sha256_file(scene / "model.safetensors")}).status == 0);
}

TEST_CASE("lift_video: kept frames are recorded in the settings of the run") {
  const LiftScene scene;
  REQUIRE(
      scene.lift({"--max-past-frames", "2", "--keep-first-frame", "--keep-every", "2"}).status ==
      0);
  const std::string run = test::read_bytes(scene / "out/run.json");
  CHECK(run.find("\"keep_first_frame\": \"yes\"") != std::string::npos);
  CHECK(run.find("\"keep_every\": \"2\"") != std::string::npos);
}
