// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <algorithm>
#include <cstring>
#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/io/json.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/model/config.h"
#include "lvggt/train/checkpoint.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/temp_dir.h"

namespace {

namespace fs = std::filesystem;
using namespace lvggt;
using lvggt::test::outcome_of;

// A training whose tensors are a function of the step, with checkpoints in a folder of its own.
class Training {
 public:
  explicit Training(std::int64_t keep = 3, const std::string& version = "0.2.0")
      : checkpoints({dir_ / "checkpoints", keep, version}) {
    state.config = to_json(ModelConfig{});
    state.data_manifest = std::string(64, 'a');
    state.settings = {{"learning_rate", "0.001"}, {"batch", "4"}};
    state.surroundings = {{"threads", "2"}, {"ranks", "1"}};
  }

  std::vector<TrainingTensor> tensors() {
    return {{"lang_encoder.down1.0.weight", {4, 3}, weights_},
            {"train.first_moment", {4, 3}, moments_},
            {"scalar", {1}, scalar_}};
  }

  void at(std::int64_t step) {
    state.step = step;
    for (std::size_t i = 0; i < weights_.size(); ++i) {
      weights_[i] = static_cast<float>(step) + static_cast<float>(i) / 8;
      moments_[i] = -weights_[i];
    }
    scalar_[0] = static_cast<float>(step);
    state.values["position"] = "epoch 1, sample " + std::to_string(step);
  }

  void save(std::int64_t step, std::optional<std::int64_t> best = std::nullopt) {
    at(step);
    checkpoints.save(state, tensors(), best);
  }

  // The step the tensors and the state tell of, after loading into scrambled memory.
  std::optional<TrainingCheckpoints::Loaded> load(bool force = false) {
    std::fill(weights_.begin(), weights_.end(), 99.0F);
    std::fill(moments_.begin(), moments_.end(), 99.0F);
    auto loaded = checkpoints.load_newest(tensors(), state, force);
    if (loaded) {
      CHECK(weights_[0] == static_cast<float>(loaded->state.step));
      CHECK(moments_[11] == -static_cast<float>(loaded->state.step) - 11.0F / 8);
      CHECK(loaded->state.values.at("position") ==
            "epoch 1, sample " + std::to_string(loaded->state.step));
    }
    return loaded;
  }

  std::string bytes(std::int64_t step) const { return test::read_bytes(checkpoints.path(step)); }
  std::string mark(std::int64_t step) const {
    std::string path = checkpoints.path(step);
    return path.substr(0, path.rfind('.')) + ".done";
  }

  test::TempDir dir_;
  TrainingState state;
  TrainingCheckpoints checkpoints;

 private:
  std::vector<float> weights_ = std::vector<float>(12), moments_ = std::vector<float>(12),
                     scalar_ = std::vector<float>(1);
};

bool says(const std::vector<std::string>& sentences, const std::string& text) {
  return std::any_of(sentences.begin(), sentences.end(), [&](const std::string& sentence) {
    return sentence.find(text) != std::string::npos;
  });
}

}  // namespace

TEST_CASE("D13: checkpoints leave no other files, and the last K and the best are kept") {
  Training training(2);
  for (std::int64_t step = 10; step <= 60; step += 10) training.save(step, 20);
  CHECK(training.checkpoints.steps() == std::vector<std::int64_t>{20, 50, 60});
  std::size_t files = 0;
  for (const auto& file : fs::directory_iterator(training.dir_ / "checkpoints")) {
    CHECK(file.path().filename().string().starts_with("step_0000000"));
    ++files;
  }
  CHECK(files == 6);  // each with its mark
}

TEST_CASE("D14: a checkpoint carries tensors, state, hashes, version and checksums") {
  Training training;
  CHECK_FALSE(training.load());
  training.save(37);
  const Safetensors file = Safetensors::open(training.checkpoints.path(37));
  CHECK(file.read<2>("lang_encoder.down1.0.weight")(0, 1) == 37.125F);
  CHECK(parse_config(file.metadata().at("config"), "test") == ModelConfig{});
  const Json state = Json::parse(file.metadata().at("training"), "test");
  CHECK(state.find("step")->as_int64("") == 37);
  CHECK(state.find("tool_version")->as_string("") == "0.2.0");
  CHECK(state.find("data_manifest")->as_string("") == std::string(64, 'a'));
  CHECK(state.find("config_sha256")->as_string("").size() == 64);
  CHECK(Json::parse(file.metadata().at("tensor_sha256"), "test").as_object("").size() == 3);

  const auto loaded = training.load();
  REQUIRE(loaded);
  CHECK(loaded->state.step == 37);
  CHECK(loaded->state.settings == training.state.settings);
  CHECK(loaded->warnings.empty());
}

TEST_CASE("D16: another number of threads or ranks is allowed and said") {
  Training training;
  training.save(5);
  training.state.surroundings = {{"threads", "3"}, {"ranks", "1"}};
  const auto loaded = training.load();
  REQUIRE(loaded);
  REQUIRE(loaded->warnings.size() == 1);
  CHECK(says(loaded->warnings, "number of threads was 2 and is 3"));
}

TEST_CASE("D17: a newest checkpoint that is empty or cut short is passed over loudly") {
  Training training;
  training.save(1);
  training.save(2);
  const std::string whole = training.bytes(2);
  for (const std::size_t length :
       {std::size_t{0}, std::size_t{5}, std::size_t{200}, whole.size() / 2, whole.size() - 1}) {
    CAPTURE(length);
    test::write_bytes(training.checkpoints.path(2), whole.substr(0, length));
    const auto loaded = training.load();
    REQUIRE(loaded);
    CHECK(loaded->state.step == 1);
    CHECK(says(loaded->warnings, "step_000000002"));
  }
}

TEST_CASE("D17: any flipped bit sends training back to the checkpoint before") {
  Training training;
  training.save(1);
  training.save(2);
  const std::string whole = training.bytes(2);
  int passed_over = 0;
  for (std::size_t i = 0; i < whole.size(); i += 7) {
    std::string damaged = whole;
    damaged[i] = static_cast<char>(damaged[i] ^ (1 << (i % 8)));
    test::write_bytes(training.checkpoints.path(2), damaged);
    const auto loaded = training.load();
    REQUIRE(loaded);
    INFO("byte ", i, " of ", whole.size());
    REQUIRE(loaded->state.step == 1);
    REQUIRE(says(loaded->warnings, "DAMAGED"));
    ++passed_over;
  }
  CHECK(passed_over > 100);
}

TEST_CASE(
    "D17: without its mark a checkpoint is the second choice, and the only one still counts") {
  Training training;
  training.save(1);
  training.save(2);
  fs::remove(training.mark(2));
  auto loaded = training.load();
  REQUIRE(loaded);
  CHECK(loaded->state.step == 1);
  CHECK(says(loaded->warnings, "not marked as complete"));
  test::write_bytes(training.mark(1), "{");
  loaded = training.load();
  REQUIRE(loaded);
  CHECK(loaded->state.step == 2);
}

TEST_CASE("D18: when every checkpoint is damaged training stops instead of starting anew") {
  Training training;
  training.save(1);
  training.save(2);
  for (const std::int64_t step : {1, 2}) {
    std::string bytes = training.bytes(step);
    bytes.back() = static_cast<char>(bytes.back() ^ 1);
    test::write_bytes(training.checkpoints.path(step), bytes);
  }
  const auto outcome = outcome_of([&] { training.load(); });
  CHECK_FALSE(outcome.accepted);
  CHECK(outcome.kind == ErrorKind::kFormat);
  CHECK(outcome.says("none of its 2 checkpoints is intact"));
}

TEST_CASE("D19: another configuration, data set or setting is refused with every difference") {
  Training training;
  training.save(3);
  ModelConfig config;
  config.sbd_hidden_dim = 16;
  config.sbd_rgb = false;
  training.state.config = to_json(config);
  training.state.data_manifest = std::string(64, 'b');
  training.state.settings = {{"learning_rate", "0.002"}, {"ema", "0.99"}};
  const auto outcome = outcome_of([&] { training.load(); });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  for (const char* text : {"sbd_hidden_dim was 32 and is 16", "sbd_rgb was true and is false",
                           "data set", "learning_rate was 0.001 and is 0.002",
                           "ema was absent and is 0.99", "batch was 4 and is absent", "--force"}) {
    CAPTURE(text);
    CHECK(outcome.says(text));
  }
  const auto forced = training.load(true);
  REQUIRE(forced);
  CHECK(forced->state.step == 3);
  CHECK(says(forced->warnings, "learning_rate was 0.001"));
}

TEST_CASE("D19: a checkpoint of other tensors is refused even by force") {
  Training training;
  training.save(3);
  std::vector<float> values(6);
  const std::vector<TrainingTensor> other{{"lang_encoder.down1.0.weight", {2, 3}, values}};
  const auto outcome =
      outcome_of([&] { training.checkpoints.load_newest(other, training.state, true); });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("is [4,3], not [2,3]"));
}

TEST_CASE("D20: a checkpoint of a newer version is refused by name, an older one is read") {
  Training training(3, "0.10.0");
  training.save(3);
  const auto load_as = [&](const std::string& version) {
    const TrainingCheckpoints reader({training.dir_ / "checkpoints", 3, version});
    return outcome_of([&] { reader.load_newest(training.tensors(), training.state, true); });
  };
  const auto outcome = load_as("0.9.7");
  CHECK(outcome.kind == ErrorKind::kUnsupported);
  CHECK(outcome.says("version 0.10.0"));
  CHECK(outcome.says("newer than this one, 0.9.7"));
  CHECK(load_as("0.10.0").accepted);
  CHECK(load_as("1.0.0").accepted);
}

TEST_CASE("D21: too little space is found before anything is written") {
  Training training;
  training.save(1);
  CHECK(training.checkpoints.free_bytes() > 0);
  CHECK(TrainingCheckpoints::file_bytes(training.tensors()) >=
        static_cast<std::int64_t>(training.bytes(1).size()));
  training.checkpoints.check_space(training.tensors(), 2);
  const auto outcome = outcome_of(
      [&] { training.checkpoints.check_space(training.tensors(), std::int64_t{1} << 44); });
  CHECK(outcome.kind == ErrorKind::kWrite);
  CHECK(outcome.says("are free on that disk"));
}

TEST_CASE("D09: a disk that fills up while a checkpoint is written leaves the one before valid") {
  Training training;
  training.save(1);
  const pid_t child = fork();
  REQUIRE(child >= 0);
  if (child == 0) {
    // A file limit of half a checkpoint stands for the full disk.
    const rlim_t half = training.bytes(1).size() / 2;
    const rlimit limit{half, half};
    setrlimit(RLIMIT_FSIZE, &limit);
    ::signal(SIGXFSZ, SIG_IGN);
    const auto outcome = outcome_of([&] { training.save(2); });
    _exit(!outcome.accepted && outcome.kind == ErrorKind::kWrite ? 0 : 1);
  }
  int status = -1;
  REQUIRE(waitpid(child, &status, 0) == child);
  CHECK(status == 0);
  CHECK(training.checkpoints.steps() == std::vector<std::int64_t>{1});
  const auto loaded = training.load();
  REQUIRE(loaded);
  CHECK(loaded->state.step == 1);
  CHECK(loaded->warnings.empty());
}

TEST_CASE(
    "TrainingCheckpoints: a fresh start removes checkpoints, marks and unfinished files only") {
  Training training;
  training.save(1);
  const std::string folder = training.dir_ / "checkpoints";
  test::write_bytes(folder + "/.step_000000002.safetensors.0123456789abcdef.tmp", "x");
  test::write_bytes(folder + "/notes.txt", "mine");
  training.checkpoints.remove_all();
  CHECK(training.checkpoints.steps().empty());
  CHECK(std::distance(fs::directory_iterator(folder), {}) == 1);
  CHECK(test::read_bytes(folder + "/notes.txt") == "mine");
}
