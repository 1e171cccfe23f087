// SPDX-License-Identifier: Apache-2.0
// weights_init, weights_convert and weights_info as their users meet them.
#include <doctest/doctest.h>

#include <csignal>
#include <filesystem>
#include <iterator>
#include <string>
#include <vector>

#include "lvggt/io/hash.h"
#include "lvggt/io/json.h"
#include "lvggt/io/safetensors.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/temp_dir.h"

namespace {

namespace fs = std::filesystem;
using lvggt::test::ChildProcess;
using lvggt::test::TempDir;

const std::string kGolden = lvggt::test::test_data("golden/");
const std::string kTiny = kGolden + "config_tiny.json";

struct Result {
  int status = 0;
  std::string out, err;
};

Result run(const std::vector<std::string>& argv, rlim_t max_file_bytes = RLIM_INFINITY) {
  ChildProcess child(argv, max_file_bytes);
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

// The status, and one line on stderr that says this.
void check_fault(const Result& result, int status, const std::string& says) {
  CAPTURE(result.err);
  CHECK(result.status == status);
  CHECK(result.err.find(says) != std::string::npos);
  CHECK(result.err.find(": error: ") != std::string::npos);
}

std::ptrdiff_t num_files(const TempDir& dir) {
  return std::distance(fs::directory_iterator(dir.path()), fs::directory_iterator());
}

}  // namespace

TEST_CASE(
    "weights_init: writes one file or two, with the configuration, the same for the same seed") {
  const TempDir dir;
  REQUIRE(run({lvggt::test::program("weights_init"), "--config", kTiny, "--seed", "1", dir / "a"})
              .status == 0);
  REQUIRE(run({lvggt::test::program("weights_init"), "--config", kTiny, "--seed", "1", "--threads",
               "3", dir / "b"})
              .status == 0);
  CHECK(lvggt::sha256_file(dir / "a") == lvggt::sha256_file(dir / "b"));
  REQUIRE(run({lvggt::test::program("weights_init"), "--config", kTiny, "--decoder-out", dir / "d",
               dir / "g"})
              .status == 0);
  const auto all = lvggt::Safetensors::open(dir / "a");
  const auto geometry = lvggt::Safetensors::open(dir / "g");
  const auto decoder = lvggt::Safetensors::open(dir / "d");
  CHECK(geometry.entries().size() + decoder.entries().size() == all.entries().size());
  CHECK(lvggt::Json::parse(all.metadata().at("config"), "x").find("embed_dim")->as_int64("x") ==
        64);
}

TEST_CASE("weights_info: describes weights and checkpoints, as text and as JSON") {
  const TempDir dir;
  REQUIRE(run({lvggt::test::program("weights_init"), "--config", kTiny, dir / "a"}).status == 0);
  const Result text = run({lvggt::test::program("weights_info"), "--check", "--sha256", dir / "a"});
  CHECK(text.status == 0);
  CHECK(text.out.find("every tensor that it needs is there") != std::string::npos);
  CHECK(text.out.find(lvggt::sha256_file(dir / "a")) != std::string::npos);
  CHECK(text.out.find("all finite, none suspicious") != std::string::npos);
  const Result json =
      run({lvggt::test::program("weights_info"), "--json", kGolden + "checkpoint_nested.pth"});
  CHECK(json.status == 0);
  CHECK(lvggt::Json::parse(json.out, "x").find("tensors")->as_int64("x") == 7);
  check_fault(run({lvggt::test::program("weights_info"), dir / "missing"}), 3, "cannot open");
  check_fault(run({lvggt::test::program("weights_info"), kTiny}), 3, "it looks like JSON text");
}

TEST_CASE("weights_convert: a checkpoint is converted, and bad input ends with status 3") {
  const TempDir dir;
  const std::string in = kGolden + "checkpoint_nested.pth";
  const Result done = run({lvggt::test::program("weights_convert"), in, dir / "a"});
  CHECK(done.status == 0);
  CHECK(done.err.find("note: the weights are under 'model_state_dict'") != std::string::npos);
  CHECK(lvggt::Safetensors::open(dir / "a").entries().size() == 7);
  lvggt::test::write_bytes(dir / "cut.pth", lvggt::test::read_bytes(in).substr(0, 1000));
  check_fault(run({lvggt::test::program("weights_convert"), dir / "cut.pth", dir / "b"}), 3,
              "not a valid zip archive");
  check_fault(
      run({lvggt::test::program("weights_convert"), kGolden + "checkpoint_legacy.pth", dir / "b"}),
      3, "old PyTorch");
  check_fault(run({lvggt::test::program("weights_convert"), dir.path(), dir / "b"}), 3,
              "is a directory");
  CHECK(num_files(dir) == 2);
}

TEST_CASE("A60: weights_convert refuses a file whose SHA-256 sum is not the given one") {
  const TempDir dir;
  const std::string in = kGolden + "checkpoint_plain.pth";
  const std::string sum = lvggt::sha256_file(in);
  check_fault(run({lvggt::test::program("weights_convert"), "--sha256", std::string(64, '0'), in,
                   dir / "a"}),
              3, sum);
  CHECK(num_files(dir) == 0);
  CHECK(run({lvggt::test::program("weights_convert"), "--sha256", sum, in, dir / "a"}).status == 0);
}

TEST_CASE("D01: wrong options of the weights programs end with status 2") {
  const TempDir dir;
  for (const std::string& program :
       {lvggt::test::program("weights_init"), lvggt::test::program("weights_convert"),
        lvggt::test::program("weights_info")}) {
    CHECK(run({program}).status == 2);
    check_fault(run({program, "--no-such-option", "x"}), 2, "--no-such-option");
    CHECK(run({program, "--help"}).status == 0);
    CHECK(run({program, "--version"}).status == 0);
  }
  const std::string out = dir / "a";
  for (const std::vector<std::string>& options : {std::vector<std::string>{"--seed", "nan"},
                                                  {"--seed", "3x"},
                                                  {"--seed", "-1"},
                                                  {"--seed"},
                                                  {"--seed", "1e400"},
                                                  {"--seed", "1", "--seed", "1"},
                                                  {"--threads", "0"},
                                                  {"--threads", "-2"},
                                                  {"--threads", "1000000"},
                                                  {"--part", "half"},
                                                  {"--part", "decoder", "--decoder-out", dir / "b"},
                                                  {"--decoder-out", out}}) {
    std::vector<std::string> argv{lvggt::test::program("weights_init"), "--config", kTiny};
    argv.insert(argv.end(), options.begin(), options.end());
    argv.push_back(out);
    const Result result = run(argv);
    CAPTURE(options[1 % options.size()]);
    CAPTURE(result.err);
    CHECK(result.status == 2);
  }
  CHECK(num_files(dir) == 0);
}

TEST_CASE("D02: an existing output of the weights programs is kept unless --force is given") {
  const TempDir dir;
  lvggt::test::write_bytes(dir / "a", "precious");
  const std::string in = kGolden + "checkpoint_plain.pth";
  check_fault(run({lvggt::test::program("weights_init"), "--config", kTiny, dir / "a"}), 2,
              "--force");
  check_fault(run({lvggt::test::program("weights_convert"), in, dir / "a"}), 2, "--force");
  CHECK(lvggt::test::read_bytes(dir / "a") == "precious");
  check_fault(run({lvggt::test::program("weights_convert"), in, dir / "missing/a"}), 1,
              "No such file or directory");
  CHECK(run({lvggt::test::program("weights_convert"), "--force", in, dir / "a"}).status == 0);
  CHECK(lvggt::Safetensors::open(dir / "a").entries().size() == 11);
}

TEST_CASE("D09: a disk that fills up while weights are written leaves nothing behind") {
  const TempDir dir;
  check_fault(run({lvggt::test::program("weights_init"), "--config", kTiny, dir / "a"}, 1 << 20), 1,
              "cannot write");
  CHECK(num_files(dir) == 0);
}

TEST_CASE("D07: an interrupted weights_init removes what it wrote and ends with status 130") {
  const TempDir dir;
  ChildProcess child(
      {lvggt::test::program("weights_init"), "--threads", "1", dir / "large"});  // gigabytes
  while (child.running() && num_files(dir) == 0) {
  }
  child.send(SIGINT);
  const int status = child.wait();
  CAPTURE(child.err());
  CHECK(status == 130);
  CHECK(num_files(dir) == 0);
}
