// SPDX-License-Identifier: Apache-2.0
// lift_video over a list of videos, by one process and by several.
#include <doctest/doctest.h>

#include <chrono>
#include <filesystem>
#include <map>
#include <string>
#include <thread>
#include <vector>

#include "lvggt/model/tensor_list.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/tiny_scene.h"

using namespace lvggt;
namespace fs = std::filesystem;

namespace {

struct Result {
  int status = 0;
  std::string err;
  bool says(const std::string& text) const { return err.find(text) != std::string::npos; }
};

// Folders of pictures, the list of them, and a small model.
class Videos {
 public:
  explicit Videos(int num_videos) {
    const ModelConfig config = test::tiny_config();
    test::write_tensors(dir_ / "model.safetensors", test::all_tensors(config), &config);
    std::string list;
    for (int i = 0; i < num_videos; ++i) {
      const std::string folder = dir_ / ("video" + std::to_string(i));
      fs::create_directory(folder);
      for (int frame = 0; frame < 2; ++frame)
        test::TinyScene::add_picture(folder + "/" + std::to_string(frame) + ".png", 56, 84,
                                     10 * i + frame);
      list += folder + "\n";
    }
    test::write_bytes(dir_ / "list.txt", list);
  }

  std::string operator/(const std::string& name) const { return dir_ / name; }

  std::vector<std::string> command(const std::string& out,
                                   const std::vector<std::string>& more = {}) const {
    std::vector<std::string> argv{lvggt::test::program("lift_video"),
                                  "--list",
                                  dir_ / "list.txt",
                                  "--weights",
                                  dir_ / "model.safetensors",
                                  "--mode",
                                  "original",
                                  "--threads",
                                  "1",
                                  "--no-ply",
                                  "--out",
                                  dir_ / out};
    argv.insert(argv.end(), more.begin(), more.end());
    return argv;
  }
  Result run(const std::string& out, const std::vector<std::string>& more = {}) const {
    test::ChildProcess child(command(out, more));
    const int status = child.wait();
    return {status, child.err()};
  }

  // All results below a folder, without the records, which hold times.
  std::map<std::string, std::string> contents(const std::string& out) const {
    std::map<std::string, std::string> files;
    for (const auto& entry : fs::recursive_directory_iterator(dir_ / out))
      if (entry.is_regular_file() && entry.path().filename() != "run.json")
        files[fs::relative(entry.path(), dir_ / out).string()] =
            test::read_bytes(entry.path().string());
    return files;
  }

 private:
  test::TempDir dir_{test::TempDir::in_memory()};
};

}  // namespace

TEST_CASE("lift_video: a list gives a folder for each video; done ones are left alone") {
  const Videos videos(3);
  const Result result = videos.run("out");
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.says("3 of 3 inputs done"));
  CHECK(fs::exists(videos / "out/video1/contact_sheet.png"));
  const auto before = videos.contents("out");
  CHECK(videos.run("out").says("0 of 3 inputs done, 3 done before"));
  CHECK(videos.contents("out") == before);
  CHECK(videos.run("out", {"--percentile", "10"}).status == 2);
  CHECK(videos.run("out", {"--force"}).status == 2);
  CHECK(videos.run("out", {"--shard", "4/3"}).status == 2);
}

TEST_CASE("E11: lift_video processes killed at a list leave what one clean run would") {
  const Videos videos(3);
  REQUIRE(videos.run("clean").status == 0);
  for (int round = 0; round < 2; ++round) {
    test::ChildProcess child(videos.command("out"));
    std::this_thread::sleep_for(std::chrono::milliseconds(60 + 100 * round));
    child.send(SIGKILL);
    child.wait();
  }
  test::ChildProcess a(videos.command("out")), b(videos.command("out"));
  CHECK(a.wait() == 0);
  CHECK(b.wait() == 0);
  CHECK(videos.run("out").says("3 done before"));
  const auto out = videos.contents("out"), clean = videos.contents("clean");
  for (const auto& [name, bytes] : clean) {
    CAPTURE(name);
    CHECK(out.count(name) == 1);
    CHECK((out.count(name) == 1 && out.at(name) == bytes));
  }
  for (const auto& [name, bytes] : out) {
    CAPTURE(name);
    CHECK(clean.count(name) == 1);
  }
}

TEST_CASE("E15: lift_video reports a poison video of a list and finishes the others, status 5") {
  const Videos videos(3);
  test::write_bytes(videos / "video1/0.png", "no picture");
  const Result result = videos.run("out");
  INFO(result.err);
  CHECK(result.status == 5);
  CHECK(result.says("2 of 3 inputs done, 1 failed"));
  CHECK(fs::exists(videos / "out/video2/cameras.json"));
  CHECK(fs::exists(videos / "out/video1.failed"));
}
