// SPDX-License-Identifier: Apache-2.0
// The training program in several processes, started by mpirun.
#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <string>
#include <thread>
#include <vector>

#include "lvggt/train/training_log.h"
#include "tests/support/paths.h"
#include "tests/support/training_scene.h"

namespace {

using namespace lvggt;
using test::TrainingScene;
using test::TrainResult;

constexpr int kSkipped = 77;  // exit status of run_ranks.sh without mpirun

std::vector<std::string> under_mpirun(int ranks, const std::vector<std::string>& command) {
  std::vector<std::string> argv{"/bin/bash", lvggt::test::test_data("mpi/run_ranks.sh"),
                                std::to_string(ranks)};
  argv.insert(argv.end(), command.begin(), command.end());
  return argv;
}

TrainResult train_ranks(int ranks, const std::vector<std::string>& command) {
  test::ChildProcess child(under_mpirun(ranks, command));
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

bool skipped(const TrainResult& result) {
  if (result.status != kSkipped) return false;
  MESSAGE("skipped: there is no mpirun");
  return true;
}

void wait_for_lines(test::ChildProcess& child, const std::string& log, std::size_t lines) {
  while (child.running() && read_log(log).size() < lines)
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
}

// The processes that mpirun started, by their parent in /proc/PID/stat.
std::vector<pid_t> children_of(pid_t parent) {
  std::vector<pid_t> children;
  for (const auto& entry : std::filesystem::directory_iterator("/proc")) {
    std::ifstream file(entry.path() / "stat");
    std::string line;
    if (!std::getline(file, line)) continue;
    // PID (NAME) STATE PARENT ...; the name may hold anything.
    std::istringstream rest(line.substr(line.rfind(')') + 1));
    std::string state;
    pid_t found = 0;
    if (rest >> state >> found && found == parent) children.push_back(std::stoi(line));
  }
  std::sort(children.begin(), children.end());
  return children;
}

}  // namespace

TEST_CASE("E21: two ranks with half a batch each train what one rank trains") {
  const TrainingScene scene;
  // Rounding differs between the two, and AdamW turns the sign of what is nothing but rounding into
  // whole steps, the more the larger the learning rate is.
  const std::vector<std::string> options{"--learning-rate", "4e-5"};
  REQUIRE(scene.train("one", options).status == 0);
  const TrainResult two = train_ranks(2, scene.command("two", options));
  if (skipped(two)) return;
  INFO(two.err);
  REQUIRE(two.status == 0);
  const auto one_log = read_log(scene / "one/log.jsonl"),
             two_log = read_log(scene / "two/log.jsonl");
  const auto a = log_curve(one_log, "loss"), b = log_curve(two_log, "loss");
  REQUIRE(a.size() == 12);
  REQUIRE(b.size() == 12);
  CHECK(std::abs(a[0][1] - b[0][1]) <= 1e-6 * a[0][1]);
  for (std::size_t i = 0; i < a.size(); ++i) {
    CAPTURE(i);
    CHECK(std::abs(a[i][1] - b[i][1]) <= 1e-4 * a[i][1]);
  }
  const double norm = log_curve(one_log, "grad_norm")[0][1];
  CHECK(std::abs(norm - log_curve(two_log, "grad_norm")[0][1]) <= 1e-5 * norm);
  CHECK(log_curve(two_log, "held_out_miou").size() == 2);
  // Each its own statistics is something else.
  const TrainResult per_rank =
      train_ranks(2, scene.command("per_rank", {"--batch-norm", "per-rank", "--steps", "2"}));
  INFO(per_rank.err);
  CHECK(per_rank.status == 0);
  CHECK(log_curve(read_log(scene / "per_rank/log.jsonl"), "grad_norm")[0][1] !=
        doctest::Approx(norm).epsilon(1e-4));
}

TEST_CASE("D16: a run of two ranks goes on with one, and says that bits may differ") {
  const TrainingScene scene;
  const TrainResult two = train_ranks(2, scene.command("out", {"--steps", "3"}));
  if (skipped(two)) return;
  REQUIRE(two.status == 0);
  const TrainResult one = scene.train("out", {"--steps", "6", "--resume"});
  INFO(one.err);
  CHECK(one.status == 0);
  CHECK(one.says("number of ranks was 2 and is 1"));
}

TEST_CASE("E19: ranks with different settings or data are refused at the start, naming them") {
  const TrainingScene scene;
  for (const auto& [option, value, message] : std::vector<std::array<std::string, 3>>{
           {"--learning-rate", "1e-2", "learning_rate is 0.001"},
           {"--seed", "5", "seed is 0 on rank 0 but 5 on rank 1"},
           {"--hidden", "4", "configuration"},
           {"--train-frames", "1-4", "data set"}}) {
    std::vector<std::string> command = scene.command("out", {"--force"});
    command.insert(command.end(), {":", "-n", "1"});
    const auto other = scene.command("out", {"--force", option, value});
    command.insert(command.end(), other.begin(), other.end());
    const TrainResult result = train_ranks(1, command);
    if (skipped(result)) return;
    INFO(result.err);
    CHECK(result.status == 3);
    CHECK(result.says("the ranks do not train the same"));
    CHECK(result.says(message));
  }
}

TEST_CASE("E16 E18: a signal to all ranks, or to one, stops them together with a checkpoint") {
  const TrainingScene scene;
  for (const bool all : {true, false}) {
    const std::string out = all ? "all" : "one";
    test::ChildProcess child(under_mpirun(2, scene.command(out, {"--steps", "100000"})));
    wait_for_lines(child, scene / (out + "/log.jsonl"), 4);
    if (!child.running() && child.wait() == kSkipped) return;
    if (all) {
      child.send(SIGUSR1);  // mpirun passes it on
    } else {
      const auto ranks = children_of(child.pid());
      REQUIRE(ranks.size() == 2);
      kill(ranks[1], SIGTERM);
    }
    const int status = child.wait();
    INFO(child.err());
    CHECK(status == 130);
    CHECK(scene.json(out + "/run.json").find("status")->as_string("") == "interrupted");
  }
}

TEST_CASE("E18: a rank that is killed ends the job with a message, and its checkpoint is usable") {
  const TrainingScene scene;
  test::ChildProcess child(
      under_mpirun(2, scene.command("out", {"--steps", "100000", "--checkpoint-every", "2"})));
  wait_for_lines(child, scene / "out/log.jsonl", 6);
  if (!child.running() && child.wait() == kSkipped) return;
  const auto ranks = children_of(child.pid());
  REQUIRE(ranks.size() == 2);
  kill(ranks[1], SIGKILL);
  CHECK(child.wait() != 0);
  INFO(child.out(), child.err());
  CHECK((child.out() + child.err()).find("signal 9") != std::string::npos);
  const TrainResult resumed =
      scene.train("out", {"--resume", "--steps", "8", "--checkpoint-every", "2"});
  INFO(resumed.err);
  CHECK(resumed.status == 0);
  CHECK(resumed.says("after step"));
}
