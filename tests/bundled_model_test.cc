// SPDX-License-Identifier: Apache-2.0
// The small model that comes with lvggt: used when no weights are named, and never silently
// something else.
#include <doctest/doctest.h>

#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/io/png.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/small_model.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;
namespace fs = std::filesystem;

namespace {

// Where lift_video looks, seen from the program.
constexpr const char* kShare = "../share/lvggt";

std::string bundled_path() {
  return (fs::path(test::program("lift_video")).parent_path() / kShare / kSmallModel.name)
      .lexically_normal()
      .string();
}

struct Result {
  int status = 0;
  std::string err;
};

// An installed lift_video with whatever lies in its share folder, and a picture to lift.
class Installed {
 public:
  Installed() {
    fs::create_directories(dir_ / "bin");
    fs::create_directories(dir_ / "share/lvggt");
    fs::create_directories(dir_ / "frames");
    fs::copy_file(test::program("lift_video"), dir_ / "bin/lift_video");
    Tensor<std::uint8_t, 3> pixels(Shape{std::int64_t{60}, std::int64_t{80}, std::int64_t{3}});
    for (std::int64_t i = 0; i < pixels.size(); ++i)
      pixels.data()[i] = static_cast<std::uint8_t>(i % 251);
    write_png(dir_ / "frames/0.png", pixels);
  }

  std::string model() const { return dir_ / ("share/lvggt/" + std::string(kSmallModel.name)); }
  std::string operator/(const std::string& name) const { return dir_ / name; }

  Result lift(const std::vector<std::string>& more = {}) const {
    std::vector<std::string> argv{dir_ / "bin/lift_video", dir_ / "frames", "--out", dir_ / "out"};
    argv.insert(argv.end(), more.begin(), more.end());
    test::ChildProcess child(argv);
    const int status = child.wait();
    return {status, child.err()};
  }

 private:
  test::TempDir dir_;
};

void check_refused(const Installed& installed) {
  const Result result = installed.lift();
  CAPTURE(result.err);
  CHECK(result.status == 3);
  CHECK(result.err.find(installed.model()) != std::string::npos);
  CHECK(result.err.find(std::string(kSmallModel.sha256)) != std::string::npos);
  CHECK_FALSE(fs::exists(installed / "out"));
}

}  // namespace

TEST_CASE("small model: the file in the tree is the one the programs know") {
  CHECK_NOTHROW(check_bundled_file(kSmallModel, bundled_path()));
  CHECK(fs::file_size(bundled_path()) <= 12'000'000);
  const Checkpoint checkpoint({.weights = bundled_path(), .strict = true});
  CHECK(checkpoint.config().name == "lvggt-small");
}

TEST_CASE("lift_video: without --weights the bundled small model is used, and it is said") {
  const Installed installed;
  fs::copy_file(bundled_path(), installed.model());
  const Result result = installed.lift();
  CAPTURE(result.err);
  CHECK(result.status == 0);
  CHECK(result.err.find("bundled small model") != std::string::npos);
  CHECK(result.err.find("weights/README.md") != std::string::npos);
  CHECK(fs::exists(installed / "out/depth/000000.png"));
  const std::string record = test::read_bytes(installed / "out/run.json");
  CHECK(record.find(kSmallModel.name) != std::string::npos);
}

TEST_CASE("lift_video: a damaged, foreign or missing small model is an error that names it") {
  const Installed installed;
  check_refused(installed);  // missing

  std::string bytes = test::read_bytes(bundled_path());
  bytes[bytes.size() / 2] = static_cast<char>(bytes[bytes.size() / 2] ^ 1);
  test::write_bytes(installed.model(), bytes);
  check_refused(installed);  // one bit of a weight

  bytes.resize(bytes.size() / 2);
  test::write_bytes(installed.model(), bytes);
  check_refused(installed);  // cut short

  SafetensorsWriter foreign(installed.model());
  foreign.add("a", {1}, std::vector<float>{1});
  foreign.finish();
  check_refused(installed);  // a valid file, but another
}
