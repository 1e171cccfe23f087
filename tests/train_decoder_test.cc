// SPDX-License-Identifier: Apache-2.0
// The training program as its users meet it.
#include <doctest/doctest.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <filesystem>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "lvggt/io/image.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/deterministic_weights.h"
#include "lvggt/train/training_log.h"
#include "tests/support/paths.h"
#include "tests/support/training_scene.h"

namespace {

namespace fs = std::filesystem;
using namespace lvggt;
using test::TrainingScene;
using test::TrainResult;

// Loss, scores and the like of every line of a log, without the times.
std::vector<std::string> course(const std::string& path) {
  std::vector<std::string> lines;
  for (const Json& line : read_log(path)) {
    std::string text;
    for (const auto& [key, value] : line.as_object("line")) {
      if (key == "seconds") continue;
      text += key + "=";
      if (value.is_integer())
        text += std::to_string(value.as_int64(key));
      else if (value.is_number())
        append_number(text, value.as_double(key));
      else if (value.is_string())
        text += value.as_string(key);
      text += " ";
    }
    lines.push_back(text);
  }
  return lines;
}

double last_loss(const std::string& path) { return log_curve(read_log(path), "loss").back()[1]; }

}  // namespace

TEST_CASE("train_decoder: from a scene to a decoder, with log, pictures and scores") {
  const TrainingScene scene;
  const TrainResult result = scene.train("out", {"--csv"});
  INFO(result.err);
  REQUIRE(result.status == 0);
  const auto lines = read_log(scene / "out/log.jsonl");
  const auto losses = log_curve(lines, "loss");
  REQUIRE(losses.size() == 12);
  CHECK(losses.back()[1] < losses.front()[1]);
  CHECK(log_curve(lines, "held_out_miou").size() == 2);
  CHECK(log_curve(lines, "learning_rate")[0][1] == doctest::Approx(1e-3 / 3));
  for (const char* name : {"decoder.safetensors", "best.safetensors", "held_out_000006.png",
                           "held_out_000012.png", "held_out.json", "loss.png", "log.csv"})
    CHECK(fs::exists(scene / ("out/" + std::string(name))));
  CHECK(load_image(scene / "out/loss.png").width() > 400);
  const Json record = scene.json("out/run.json");
  CHECK(record.find("status")->as_string("") == "complete");
  CHECK(record.find("steps")->as_int64("") == 12);
  const Json held_out = scene.json("out/held_out.json");
  CHECK(held_out.find("classes")->as_array("").size() == 12);  // four codes on three levels
  for (const char* text : {"8 frames to train on, 4 held out", "bytes)", "best so far"})
    CHECK(result.says(text));
}

TEST_CASE("train_decoder: its decoder and its checkpoints load as a model's decoder") {
  const TrainingScene scene;
  REQUIRE(scene.train("out").status == 0);
  const ModelConfig config = load_config(lvggt::test::test_data("golden/config_tiny.json"));
  SafetensorsWriter geometry(scene / "geometry.safetensors");
  geometry.set_metadata("config", to_json(config));
  for (const TensorSpec& spec : geometry_tensors(config)) {
    std::vector<float> values(static_cast<std::size_t>(spec.volume()));
    deterministic_values(spec.name, spec.shape, 1, values);
    geometry.add(spec.name, spec.shape, values);
  }
  geometry.finish();
  for (const std::string& name :
       {std::string("out/decoder.safetensors"), std::string("out/best.safetensors"),
        scene.newest_checkpoint("out")}) {
    CAPTURE(name);
    LoadOptions options;
    options.weights = scene / "geometry.safetensors";
    options.decoder = scene / name;
    options.strict = true;
    const Checkpoint checkpoint(options);
    CHECK(checkpoint.has_decoder());
    CHECK(checkpoint.warnings().empty());
    CHECK(checkpoint.read<4>("lang_encoder.down1.0.weight").extent(0) == 8);
  }
}

TEST_CASE("train_decoder: dynamic supervision tells the state of each held-out frame") {
  const TrainingScene scene;
  const TrainResult result =
      scene.train("out", {"--supervision", "dynamic", "--ema", "0.5", "--schedule", "cosine"});
  INFO(result.err);
  REQUIRE(result.status == 0);
  const Json held_out = scene.json("out/held_out.json");
  const auto& states = held_out.find("states")->as_array("");
  REQUIRE(states.size() == 4);
  CHECK(states[0].find("frame")->as_string("") == "000005");
  CHECK(states[0].find("true_class")->as_int64("") != states[3].find("true_class")->as_int64(""));
  CHECK(held_out.find("state_accuracy")->is_number());
}

TEST_CASE("train_decoder: the ablations train, and a run may start from a decoder") {
  const TrainingScene scene;
  const std::vector<std::string> few{"--steps", "2", "--evaluate-every", "2"};
  for (const std::vector<std::string>& ablation :
       std::vector<std::vector<std::string>>{{"--no-rgb"},
                                             {"--head", "mlp"},
                                             {"--no-dpt"},
                                             {"--hidden", "4", "--features", "16"},
                                             {"--accumulate", "2", "--checkpoint-activations"},
                                             {"--cosine-axis", "width"}}) {
    std::vector<std::string> more = few;
    more.insert(more.end(), ablation.begin(), ablation.end());
    more.push_back("--force");
    const TrainResult result = scene.train("out", more);
    INFO(ablation[0], ": ", result.err);
    CHECK(result.status == 0);
  }
  REQUIRE(scene.train("first").status == 0);
  const TrainResult second = scene.train(
      "second", {"--decoder", scene / "first/decoder.safetensors", "--warmup-steps", "0"});
  INFO(second.err);
  REQUIRE(second.status == 0);
  CHECK(log_curve(read_log(scene / "second/log.jsonl"), "loss")[0][1] <
        log_curve(read_log(scene / "first/log.jsonl"), "loss")[0][1]);
}

TEST_CASE("D36: one, two and three threads train the same bits") {
  const TrainingScene scene;
  REQUIRE(scene.train("two").status == 0);
  for (const char* threads : {"1", "3"}) {
    auto command = scene.command("other", {"--force"});
    *(std::find(command.begin(), command.end(), "--threads") + 1) = threads;
    test::ChildProcess child(command);
    REQUIRE(child.wait() == 0);
    CHECK(scene.bytes("other/decoder.safetensors") == scene.bytes("two/decoder.safetensors"));
  }
}

TEST_CASE("D07 D15: SIGTERM writes a checkpoint, exit 130; resumed, all files are as of one run") {
  const TrainingScene scene;
  const std::vector<std::string> options{"--ema", "0.9", "--outlier-z", "50", "--steps", "40"};
  REQUIRE(scene.train("whole", options).status == 0);
  {
    test::ChildProcess child(scene.command("cut", options));
    while (child.running() && read_log(scene / "cut/log.jsonl").size() < 5)
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
    child.send(SIGTERM);
    const int status = child.wait();
    INFO(child.err());
    REQUIRE(status == 130);
    CHECK(child.err().find("--resume continues") != std::string::npos);
  }
  CHECK(scene.json("cut/run.json").find("status")->as_string("") == "interrupted");
  std::vector<std::string> resume = options;
  resume.push_back("--resume");
  const TrainResult resumed = scene.train("cut", resume);
  INFO(resumed.err);
  REQUIRE(resumed.status == 0);
  CHECK(resumed.says("goes on after step"));
  CHECK(course(scene / "cut/log.jsonl") == course(scene / "whole/log.jsonl"));
  for (const char* name :
       {"decoder.safetensors", "best.safetensors", "held_out.json", "held_out_000040.png"})
    CHECK(scene.bytes("cut/" + std::string(name)) == scene.bytes("whole/" + std::string(name)));
  CHECK(scene.bytes(scene.newest_checkpoint("cut")) ==
        scene.bytes(scene.newest_checkpoint("whole")));
}

TEST_CASE("D08: killed at random moments and resumed, training ends with the same bits") {
  const TrainingScene scene;
  REQUIRE(scene.train("whole").status == 0);
  std::mt19937 random(7);
  for (int kill = 0; kill < 3; ++kill) {
    test::ChildProcess child(scene.command("cut", {"--resume"}));
    std::this_thread::sleep_for(std::chrono::milliseconds(20 + random() % 200));
    child.send(SIGKILL);
    child.wait();
  }
  const TrainResult resumed = scene.train("cut", {"--resume"});
  INFO(resumed.err);
  REQUIRE(resumed.status == 0);
  CHECK(scene.bytes("cut/decoder.safetensors") == scene.bytes("whole/decoder.safetensors"));
  CHECK(course(scene / "cut/log.jsonl") == course(scene / "whole/log.jsonl"));
}

TEST_CASE("D17: a damaged newest checkpoint is passed over loudly, and the end is the same") {
  const TrainingScene scene;
  REQUIRE(scene.train("out").status == 0);
  const std::string decoder = scene.bytes("out/decoder.safetensors");
  const std::string newest = scene.newest_checkpoint("out");
  std::string bytes = scene.bytes(newest);
  bytes[bytes.size() / 2] = static_cast<char>(bytes[bytes.size() / 2] ^ 4);
  test::write_bytes(scene / newest, bytes);
  const TrainResult resumed = scene.train("out", {"--resume"});
  INFO(resumed.err);
  REQUIRE(resumed.status == 0);
  CHECK(resumed.says("DAMAGED"));
  CHECK(resumed.says("goes on after step 9"));
  CHECK(scene.bytes("out/decoder.safetensors") == decoder);
}

TEST_CASE("D19: another setting, decoder or data set is refused on resuming, --force goes on") {
  const TrainingScene scene;
  REQUIRE(scene.train("out", {"--steps", "3"}).status == 0);
  const std::vector<std::pair<std::vector<std::string>, std::string>> changed{
      {{"--learning-rate", "1e-2"}, "learning_rate was 0.001 and is 0.01"},
      {{"--hidden", "4"}, "sbd_hidden_dim was 8 and is 4"},
      {{"--train-frames", "1-4"}, "data set"},
      {{"--seed", "3"}, "seed was 0 and is 3"}};
  for (const auto& [options, message] : changed) {
    std::vector<std::string> more = options;
    more.push_back("--resume");
    const TrainResult result = scene.train("out", more);
    INFO(result.err);
    CHECK(result.status == 3);
    CHECK(result.says(message));
  }
  CHECK(scene.train("out", {"--learning-rate", "1e-2", "--resume", "--force"}).status == 0);
}

TEST_CASE("D01 D02: wrong options and folders are refused by name before any work") {
  const TrainingScene scene;
  const std::vector<std::pair<std::vector<std::string>, std::string>> wrong{
      {{"--learning-rat", "1"}, "--learning-rate"},
      {{"--steps", "0"}, "--steps: '0'"},
      {{"--learning-rate", "nan"}, "--learning-rate: 'nan'"},
      {{"--supervision", "both"}, "--supervision"},
      {{"--accumulate", "3"}, "--accumulate"},
      {{"--epochs", "3"}, "exclude each other"},
      {{"--head", "tree"}, "--head"},
      {{"--hold-out-every", "2"}, "to hold out"},
      {{"--memory-limit", "lots"}, "--memory-limit"}};
  for (const auto& [options, message] : wrong) {
    const TrainResult result = scene.train("out", options);
    INFO(options[0], ": ", result.err);
    CHECK(result.status == 2);
    CHECK(result.says(message));
  }
  test::write_bytes(scene / "file", "mine");
  CHECK(scene.train("file").status == 1);
  CHECK(scene.train("no/parent").says("there is no folder"));
  CHECK_FALSE(fs::exists(scene / "out"));
  REQUIRE(scene.train("out", {"--steps", "1"}).status == 0);
  const TrainResult again = scene.train("out", {"--steps", "1"});
  CHECK(again.status == 2);
  CHECK(again.says("--force replaces it"));
  test::write_bytes(scene / "out/notes.txt", "mine");
  CHECK(scene.train("out", {"--steps", "1", "--force"}).status == 0);
  CHECK(scene.bytes("out/notes.txt") == "mine");
}

TEST_CASE("D12: a second training into the same folder is refused") {
  const TrainingScene scene;
  test::ChildProcess first(scene.command("out", {"--steps", "100000"}));
  while (first.running() && read_log(scene / "out/log.jsonl").empty())
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  const TrainResult second = scene.train("out", {"--resume"});
  CHECK(second.status == 2);
  CHECK(second.says("another training is writing"));
}

TEST_CASE("D40: a training over --memory-limit is refused with what would fit, exit 4") {
  const TrainingScene scene;
  const TrainResult result = scene.train("out", {"--memory-limit", "1M"});
  CHECK(result.status == 4);
  CHECK(result.says("bytes) of memory"));
  CHECK_FALSE(fs::exists(scene / "out"));
  const TrainResult plan = scene.train("out", {"--dry-run"});
  CHECK(plan.status == 0);
  CHECK(plan.says("activations"));
  CHECK_FALSE(fs::exists(scene / "out"));
}

TEST_CASE("D26: steps that are not finite are refused, named and counted; then training stops") {
  TrainingScene scene;
  REQUIRE(scene.train("out", {"--steps", "3"}).status == 0);
  const std::string checkpoint = scene.bytes(scene.newest_checkpoint("out"));
  // Tokens near the largest float pass every check of the data and overflow in the decoder.
  const TokenManifest manifest = scene.make_tokens();
  Tensor<float, 2> huge(Shape{manifest.h() * manifest.w(), manifest.channels()});
  std::fill_n(huge.data(), huge.size(), 3e38F);
  for (const TokenFrame& frame : manifest.frames)
    write_tokens(scene.tokens(), frame, {huge, huge, huge, huge}, Dtype::kF32);
  const TrainResult result = scene.train("out", {"--resume", "--max-refused", "4"});
  INFO(result.err);
  CHECK(result.status == 1);
  CHECK(result.says("is refused: "));
  CHECK(result.says("4 steps in a row were refused"));
  CHECK(result.says("the checkpoint of step 3 stays as it was"));
  CHECK(scene.json("out/run.json").find("status")->as_string("") == "failed");
  CHECK(scene.bytes(scene.newest_checkpoint("out")) == checkpoint);
}

TEST_CASE("D23: frames without a label give RGB loss only and are counted") {
  TrainingScene scene;
  const SupervisionSpec spec;
  for (int i = 1; i < 12; ++i) {
    Tensor<std::int8_t, 3> rows(
        Shape{std::int64_t{4}, TrainingScene::kHeight, TrainingScene::kWidth});
    std::fill_n(rows.data(), rows.size(), std::int8_t{-1});
    write_npy(scene.label_file(i, "s", spec), rows);
  }
  const TrainResult result = scene.train("out", {"--steps", "4"});
  INFO(result.err);
  CHECK(result.status == 0);
  CHECK(result.says("14 frames had no label"));
  CHECK(std::isfinite(last_loss(scene / "out/log.jsonl")));
}

TEST_CASE("D09: a disk that is full while a checkpoint is written leaves the one before") {
  const TrainingScene scene;
  REQUIRE(scene.train("out", {"--steps", "3"}).status == 0);
  const std::string before = scene.newest_checkpoint("out");
  const auto size = static_cast<rlim_t>(fs::file_size(scene / before));
  const TrainResult result = scene.train("out", {"--steps", "6", "--resume"}, size / 2);
  INFO(result.err);
  CHECK(result.status == 1);
  CHECK(result.says("stays valid"));
  CHECK(scene.newest_checkpoint("out") == before);
  const TrainResult resumed = scene.train("out", {"--steps", "6", "--resume"});
  INFO(resumed.err);
  CHECK(resumed.status == 0);
  CHECK(resumed.says("goes on after step 3"));
}
