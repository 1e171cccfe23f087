// SPDX-License-Identifier: Apache-2.0
// The programs on lesser instruction sets than this CPU has.
#include <doctest/doctest.h>

#include <string>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/core/simd.h"
#include "lvggt/io/png.h"
#include "tests/support/child_process.h"
#include "tests/support/paths.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Result {
  int status = 0;
  std::string out, err;
};

// Runs a program with LVGGT_SIMD set.
Result run(const std::string& target, std::vector<std::string> argv) {
  argv.insert(argv.begin(), {"/usr/bin/env", "LVGGT_SIMD=" + target});
  ChildProcess child(argv);
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

}  // namespace

TEST_CASE(
    "D48: with any instruction set, also without AVX2, the reference is met and videos lifted") {
  const TempDir dir;
  const std::string golden = test_data("golden/"), model = dir / "model.safetensors";
  const std::vector<std::string> targets = simd_targets();
  REQUIRE(run(targets.back(), {program("weights_init"), "--config", golden + "config_tiny.json",
                               "--seed", "1", model})
              .status == 0);
  Tensor<std::uint8_t, 3> pixels(Shape{std::int64_t{56}, std::int64_t{84}, std::int64_t{3}});
  write_png(dir / "picture.png", pixels);
  for (const std::string& target : targets) {
    CAPTURE(target);
    const Result check = run(target, {program("check_reference"), "--weights", model,
                                      golden + "square56_tiny_seed1.safetensors"});
    CAPTURE(check.err);
    CHECK(check.status == 0);
    const Result lift = run(target, {program("lift_video"), dir / "picture.png", "--weights", model,
                                     "--mode", "original", "--weights-storage", "int8",
                                     "--cache-storage", "int8", "--out", dir / "out", "--force"});
    CAPTURE(lift.err);
    CHECK(lift.status == 0);
  }
}

TEST_CASE("D48: with any instruction set the decoder's training meets its reference") {
  const TempDir dir;
  const std::string golden = test_data("golden/"), model = dir / "model.safetensors";
  const std::vector<std::string> targets = simd_targets();
  REQUIRE(run(targets.back(), {program("weights_init"), "--config", golden + "config_tiny.json",
                               "--seed", "1", model})
              .status == 0);
  for (const std::string& target : targets) {
    CAPTURE(target);
    // train has ReLU inputs near zero, which each set rounds its own way, and takes 2 s: once.
    const std::string name = target == "AVX2" ? "train" : "train_small";
    const Result check = run(target, {program("check_reference"), "--weights", model,
                                      golden + name + "_tiny_seed1.safetensors"});
    CAPTURE(check.err);
    CHECK(check.status == 0);
  }
}

TEST_CASE("LVGGT_SIMD: a name that is none is refused with those that there are") {
  const Result result = run("AVX9", {program("weights_info"), "x"});
  CHECK(result.status == 2);
  CHECK(result.err.find("'AVX9'") != std::string::npos);
  CHECK(result.err.find(simd_targets().back()) != std::string::npos);
}
