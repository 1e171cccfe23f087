// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <doctest/doctest.h>

#include <filesystem>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/io/json.h"
#include "lvggt/io/png.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/run_program.h"
#include "tests/support/temp_dir.h"

namespace lvggt::test {

// Waits for the program's end.
inline ProgramResult finish(ChildProcess& child) {
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

// A folder with a small model, in one file and in two, and with pictures of 84 x 56 pixels.
class LiftScene {
 public:
  explicit LiftScene(int num_frames = 3) {
    init({"--config", test_data("golden/config_tiny.json"), "--seed", "1",
          dir_ / "model.safetensors"});
    std::filesystem::create_directory(dir_ / "frames");
    for (int i = 0; i < num_frames; ++i) add_picture("img" + std::to_string(i) + ".png", 56, 84, i);
  }

  void init(std::vector<std::string> arguments) {
    const ProgramResult result = run_program(program("weights_init"), std::move(arguments));
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
    std::vector<std::string> argv{program("lift_video"),
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
  ProgramResult lift(const std::vector<std::string>& more = {}) const {
    ChildProcess child(command(more));
    return finish(child);
  }
  // With the whole argument list.
  ProgramResult run(std::vector<std::string> arguments) const {
    return run_program(program("lift_video"), std::move(arguments));
  }

  Json json(const std::string& name) const { return Json::read(dir_ / name); }
  std::string status() const {
    const Json record = json("out/run.json");
    return record.find("status")->as_string("status");
  }

 private:
  TempDir dir_;
};

// All files below a folder with their bytes, except the record of the run, which holds times.
inline std::map<std::string, std::string> contents(const std::string& folder) {
  std::map<std::string, std::string> files;
  for (const auto& entry : std::filesystem::recursive_directory_iterator(folder))
    if (entry.is_regular_file() && entry.path().filename() != "run.json")
      files[std::filesystem::relative(entry.path(), folder).string()] =
          read_bytes(entry.path().string());
  return files;
}

}  // namespace lvggt::test
