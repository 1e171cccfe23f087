// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <filesystem>

#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/memory.h"
#include "lvggt/cli/program.h"
#include "lvggt/cli/progress.h"
#include "lvggt/cli/threads.h"
#include "tests/support/files.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;

namespace {

struct Outcome {
  int status = 0;
  std::string message;  // on stderr
  std::int64_t stride = 1;
  double percentile = 3;
  bool force = false;
};

// Runs a small program over the arguments, its stderr caught in a file.
Outcome run(
    std::vector<const char*> arguments, const std::function<int()>& body = [] { return 0; }) {
  const test::TempDir folder;
  Outcome outcome;
  cli::Program program("tool", "A tool", "1.2");
  std::string input;
  program.app().add_option("INPUT", input, "Input")->required();
  program.add_number<std::int64_t>("--stride", outcome.stride, "Stride", 1, 1000);
  program.add_number<double>("--percentile", outcome.percentile, "Percentile", 0, 100);
  program.app().add_flag("--force", outcome.force, "Force");
  arguments.insert(arguments.begin(), "tool");

  std::fflush(stderr);
  const int saved = dup(STDERR_FILENO);
  REQUIRE(std::freopen((folder / "stderr").c_str(), "w", stderr) != nullptr);
  outcome.status = program.run(static_cast<int>(arguments.size()), arguments.data(), body);
  std::fflush(stderr);
  dup2(saved, STDERR_FILENO);
  close(saved);
  outcome.message = test::read_bytes(folder / "stderr");
  return outcome;
}

bool contains(const Outcome& outcome, const std::string& text) {
  return outcome.message.find(text) != std::string::npos;
}

}  // namespace

TEST_CASE("D01: no arguments, an unknown option, a missing value are wrong usage, exit 2") {
  CHECK(run({}).status == 2);
  CHECK(contains(run({}), "INPUT"));
  CHECK(contains(run({}), "--help"));
  const Outcome unknown = run({"x", "--strid", "2"});
  CHECK(unknown.status == 2);
  CHECK(contains(unknown, "there is no option --strid (did you mean --stride?)"));
  CHECK(contains(run({"x", "--frobnicate"}), "there is no option --frobnicate\n"));
  CHECK(run({"x", "--stride"}).status == 2);
  CHECK(contains(run({"x", "--stride"}), "--stride"));
  CHECK(run({"x", "y"}).status == 2);
}

TEST_CASE("D01: an option given twice is refused by name, flags too") {
  for (const auto& outcome :
       {run({"x", "--stride", "2", "--stride", "2"}), run({"x", "--stride=2", "--stride", "3"})}) {
    CHECK(outcome.status == 2);
    CHECK(contains(outcome, "--stride is given more than once"));
  }
  CHECK(contains(run({"x", "--force", "--force"}), "--force is given more than once"));
  CHECK(run({"--force", "--", "--stride"}).status == 0);
}

TEST_CASE("D01: numbers with trailing text, out of range, nan, inf and 1e400 are refused by name") {
  for (const char* text :
       {"0", "-1", "1x", "1.5", "1001", "", " 1", "0x10", "nan", "99999999999999999999"}) {
    const Outcome outcome = run({"x", "--stride", text});
    CHECK(outcome.status == 2);
    CHECK(contains(outcome,
                   "--stride: '" + std::string(text) + "' is not a whole number from 1 to 1000"));
  }
  for (const char* text : {"-0.1", "100.1", "nan", "-nan", "inf", "1e400", "3,5", "3 "}) {
    const Outcome outcome = run({"x", "--percentile", text});
    CHECK(outcome.status == 2);
    CHECK(contains(outcome,
                   "--percentile: '" + std::string(text) + "' is not a number from 0 to 100"));
  }
  const Outcome good = run({"x", "--stride", "12", "--percentile", "2.5", "--force"});
  CHECK(good.status == 0);
  CHECK(good.stride == 12);
  CHECK(good.percentile == 2.5);
  CHECK(good.force);
  CHECK(good.message.empty());
}

TEST_CASE("Program: every error becomes one sentence and the documented exit status") {
  const auto outcome_of = [](ErrorKind kind) {
    return run({"x"}, [kind]() -> int { fail(kind, "the sentence"); });
  };
  CHECK(outcome_of(ErrorKind::kUsage).status == 2);
  CHECK(outcome_of(ErrorKind::kFormat).status == 3);
  CHECK(outcome_of(ErrorKind::kMemory).status == 4);
  CHECK(outcome_of(ErrorKind::kWrite).status == 1);
  CHECK(outcome_of(ErrorKind::kInterrupted).status == 130);
  CHECK(outcome_of(ErrorKind::kNumeric).message == "tool: error: the sentence\n");
  const Outcome memory = run({"x"}, []() -> int { throw std::bad_alloc(); });
  CHECK(memory.status == 4);
  CHECK(contains(memory, "not enough memory"));
  CHECK(run({"x"}, []() -> int { throw std::runtime_error("other"); }).status == 1);
  CHECK(run({"x"}, [] { return 5; }).status == 5);
}

TEST_CASE("choose_threads: the option, our variable, OpenMP's variable, then what is available") {
  CHECK(cli::choose_threads(3, "5", "7").threads == 3);
  CHECK(cli::choose_threads(0, "5", "7").threads == 5);
  CHECK(cli::choose_threads(0, "5", "7").reason == "LVGGT_NUM_THREADS");
  CHECK(cli::choose_threads(0, nullptr, "7,2").threads == 7);
  CHECK(cli::choose_threads(0, nullptr, nullptr).threads == available_threads());
  CHECK_FALSE(cli::choose_threads(0, nullptr, nullptr).reason.empty());
  for (const char* wrong : {"0", "-2", "", "two", "4x", "1000000"}) {
    CHECK_THROWS_WITH_AS(cli::choose_threads(0, wrong, nullptr),
                         doctest::Contains("LVGGT_NUM_THREADS"), Error);
    CHECK(cli::choose_threads(0, nullptr, wrong).threads == available_threads());  // D43 for "0"
  }
}

TEST_CASE("parse_bytes: powers of 1024, fractions, and nothing else") {
  std::size_t bytes = 0;
  CHECK(cli::parse_bytes("4096", bytes));
  CHECK(bytes == 4096);
  CHECK(cli::parse_bytes("1.5G", bytes));
  CHECK(bytes == std::size_t{3} << 29);
  CHECK(cli::parse_bytes("2kB", bytes));
  CHECK(bytes == 2048);
  CHECK(cli::parse_bytes("1TiB", bytes));
  for (const char* wrong : {"", "G", "0", "-1G", "1X", "1GX", "1..5G", "nan", "9999999T", "1 G"})
    CHECK_FALSE(cli::parse_bytes(wrong, bytes));
  CHECK(cli::bytes_text(std::size_t{3} << 29) == "1.5 GiB");
  CHECK(cli::bytes_text(17) == "17 bytes");
}

TEST_CASE("memory: what this process uses is within what it may use") {
  CHECK(cli::resident_bytes() > 1 << 20);
  CHECK(cli::peak_resident_bytes() >= cli::resident_bytes());
  CHECK(cli::available_memory().bytes > 1 << 20);
  CHECK_FALSE(cli::available_memory().reason.empty());
}

TEST_CASE("memory: the limits of a control group and of those above it count") {
  const test::TempDir root;
  std::filesystem::create_directories(root / "a/b");
  test::write_bytes(root / "a/memory.max", "5000\n");
  test::write_bytes(root / "a/memory.current", "1000\n");
  test::write_bytes(root / "a/b/memory.max", "max\n");
  test::write_bytes(root / "a/b/memory.current", "900\n");
  const auto left = [&](const char* path) {
    return cli::memory_detail::cgroup_left(root.path(), path, "memory.max", "memory.current");
  };
  CHECK(left("/a/b") == 4000);
  CHECK(left("/") == std::numeric_limits<std::size_t>::max());
  test::write_bytes(root / "a/memory.current", "6000\n");
  CHECK(left("/a/b") == 0);
}

TEST_CASE("progress_text: rate and time left, also when the total is unknown") {
  CHECK(cli::progress_text(0, 217, 0) == "0/217 frames");
  CHECK(cli::progress_text(50, 217, 25) == "50/217 frames, 2.00 frames/s, 1:24 left");
  CHECK(cli::progress_text(217, 217, 10) == "217/217 frames, 22 frames/s");
  CHECK(cli::progress_text(5, -1, 10) == "5 frames, 0.50 frames/s");
  CHECK(cli::duration_text(3723) == "1:02:03");
  CHECK(cli::progress_bar(5, 10, 10) == "[#####.....]");
  CHECK(cli::progress_bar(12, 10, 4) == "[####]");
  CHECK(cli::progress_bar(3, -1, 10).empty());
}

TEST_CASE("D07: the first SIGINT or SIGTERM only asks, and handlers are put back") {
  const int saved = dup(STDERR_FILENO);
  REQUIRE(std::freopen("/dev/null", "w", stderr) != nullptr);
  for (const int number : {SIGINT, SIGTERM, SIGHUP}) {
    const cli::InterruptGuard guard;
    CHECK_FALSE(guard.requested());
    std::raise(number);
    CHECK(guard.requested());
  }
  std::fflush(stderr);
  dup2(saved, STDERR_FILENO);
  close(saved);
  struct sigaction now {};
  sigaction(SIGINT, nullptr, &now);
  CHECK((now.sa_handler != lvggt::cli::interrupt_detail::handle));
}
