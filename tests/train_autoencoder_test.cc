// SPDX-License-Identifier: Apache-2.0
// The program train_autoencoder as its users meet it.
#include <doctest/doctest.h>

#include <chrono>
#include <cmath>
#include <csignal>
#include <filesystem>
#include <thread>

#include "lvggt/data/supervision.h"
#include "lvggt/io/json.h"
#include "lvggt/io/npy.h"
#include "lvggt/language/autoencoder.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/random.h"
#include "tests/support/run_program.h"
#include "tests/support/tiny_scene.h"

using namespace lvggt;
using namespace lvggt::test;
namespace fs = std::filesystem;

namespace {

constexpr std::int64_t kFeatures = 20;

// A tiny scene with features of full width: four objects a frame, the last one all zeros.
class FeatureScene {
 public:
  FeatureScene() {
    fs::remove_all(compact());
    fs::create_directories(scene_ / "clip_features");
    const Tensor<float, 2> objects = random_tensor(Shape{std::int64_t{3}, kFeatures}, 4);
    for (int i = 0; i < 6; ++i) {
      Tensor<float, 2> features(Shape{std::int64_t{4}, kFeatures});
      for (std::int64_t n = 0; n < 3; ++n)
        for (std::int64_t c = 0; c < kFeatures; ++c)
          features(n, c) = objects(n, c) / 2.6F + 0.01F * static_cast<float>((i + c) % 3);
      write_npy(stem(i) + "_f.npy", features);
      Tensor<std::int8_t, 3> rows(Shape{std::int64_t{4}, TinyScene::kHeight, TinyScene::kWidth});
      write_npy(stem(i) + "_s.npy", rows);
    }
  }
  const std::string& path() const { return scene_.path(); }
  std::string stem(int i) const { return scene_ / ("clip_features/" + scene_.name(i)); }
  std::string compact() const { return scene_ / SupervisionSpec{}.folder(); }
  std::string out() const { return dir_ / "run"; }

  ProgramResult run(const std::vector<std::string>& more) const {
    std::vector<std::string> arguments{scene_.path(), "--threads", "1"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run_program(program("train_autoencoder"), arguments);
  }
  ProgramResult train(const std::vector<std::string>& more = {}) const {
    std::vector<std::string> arguments{"--output",         out(),   "--encoder-widths",  "12,3",
                                       "--decoder-widths", "12,20", "--epochs",          "40",
                                       "--batch",          "8",     "--held-out-frames", "6",
                                       "--learning-rate",  "1e-2"};
    arguments.insert(arguments.end(), more.begin(), more.end());
    return run(arguments);
  }

 private:
  TinyScene scene_{6};
  TempDir dir_{TempDir::in_memory()};
};

}  // namespace

TEST_CASE("train_autoencoder: trains, encodes for train_decoder, and goes on where it stopped") {
  const FeatureScene scene;
  const ProgramResult result = scene.train({"--encode"});
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(
      result.says("20 -> 12, 3 -> 12, 20; 15 features of 5 frames, 3 of 1 held out; 6 rows of "
                  "zeros left out"));
  const std::string file = scene.out() + "/autoencoder.safetensors";
  const Autoencoder autoencoder = Autoencoder::load(file);
  Context ctx(1);
  const FrameLabels labels =
      read_labels(scene.compact() + "/000006_s.npy", scene.compact() + "/000006_f.npy", {});
  Tensor<float, 2> decoded(Shape{std::int64_t{4}, kFeatures});
  autoencoder.decode(decoded, labels.codes, ctx);
  const Tensor<float, 2> wanted = NpyFile(scene.stem(5) + "_f.npy").read<2>();
  for (std::int64_t n = 0; n < 3; ++n) {
    double dot = 0, length = 0;
    for (std::int64_t c = 0; c < kFeatures; ++c) {
      dot += static_cast<double>(decoded(n, c)) * wanted(n, c);
      length += static_cast<double>(wanted(n, c)) * wanted(n, c);
    }
    CHECK(dot / std::sqrt(length) > 0.97);
  }
  for (std::int64_t c = 0; c < 3; ++c) CHECK(labels.codes(3, c) == 0);
  CHECK(fs::exists(scene.out() + "/loss.png"));
  CHECK(Json::read(scene.out() + "/run.json").find("held_out_l2") != nullptr);

  CHECK(scene.train().says("holds an earlier run"));
  const ProgramResult again = scene.train({"--encode", "--resume"});
  CHECK(again.status == 0);
  CHECK(again.says("complete already"));
  CHECK(again.says("0 of them written now"));

  // make_features writes the same folder with an autoencoder that is there.
  const auto make = [&](std::vector<std::string> more) {
    more.insert(more.begin(), {scene.path(), "--threads", "1", "--autoencoder", file});
    return run_program(program("make_features"), more);
  };
  const std::string codes_file = scene.compact() + "/000006_f.npy";
  const std::string trained = read_bytes(codes_file);
  const ProgramResult refused = make({});
  CHECK(refused.status == 2);
  CHECK(refused.says("holds codes already"));
  fs::remove(codes_file);
  CHECK(make({"--resume"}).says("codes of 6 frames in clip_features-language_features_dim3, 1 of"));
  CHECK(read_bytes(codes_file) == trained);
  CHECK(make({"--force"}).says("6 of them written now"));
  CHECK(read_bytes(codes_file) == trained);
}

TEST_CASE("train_autoencoder: the same autoencoder after an interruption") {
  const FeatureScene scene;
  const auto arguments = [&](const std::string& out) {
    return std::vector<std::string>{
        scene.path(), "--threads",         "1",     "--output",           out,   "--encoder-widths",
        "12,3",       "--decoder-widths",  "12,20", "--epochs",           "300", "--batch",
        "8",          "--held-out-frames", "6",     "--checkpoint-every", "7"};
  };
  const std::string whole = scene.out() + "_whole", stopped = scene.out() + "_stopped";
  REQUIRE(run_program(program("train_autoencoder"), arguments(whole)).status == 0);
  std::vector<std::string> argv = arguments(stopped);
  argv.insert(argv.begin(), program("train_autoencoder"));
  ChildProcess child(argv);
  // Stopped after some epochs, wherever that is; the result must not show it.
  const auto epochs = [&] {
    std::error_code error;
    return fs::exists(stopped + "/log.jsonl", error) ? fs::file_size(stopped + "/log.jsonl") : 0;
  };
  while (child.running() && epochs() < 2000)
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  child.send(SIGTERM);
  const int status = child.wait();
  CHECK((status == 130 || status == 0));
  std::vector<std::string> resume = arguments(stopped);
  resume.push_back("--resume");
  REQUIRE(run_program(program("train_autoencoder"), resume).status == 0);
  CHECK(read_bytes(whole + "/autoencoder.safetensors") ==
        read_bytes(stopped + "/autoencoder.safetensors"));
  CHECK(read_bytes(whole + "/log.jsonl") == read_bytes(stopped + "/log.jsonl"));
}

TEST_CASE("train_autoencoder: what does not fit is said in one sentence") {
  const FeatureScene scene;
  const ProgramResult width = scene.run({"--output", scene.out()});
  CHECK(width.status == 2);
  CHECK(width.says("the features have 20 numbers, but the decoder"));
  CHECK(scene.run({}).says("--output names the folder"));
  Tensor<float, 2> bad(Shape{std::int64_t{2}, kFeatures});
  bad(1, 3) = std::numeric_limits<float>::quiet_NaN();
  write_npy(scene.stem(2) + "_f.npy", bad);
  const ProgramResult nan = scene.train();
  CHECK(nan.status == 1);
  CHECK(nan.says("_f.npy: row 1 holds nan"));
  fs::remove(scene.stem(2) + "_f.npy");
  CHECK(scene.train().says("_s.npy or _f.npy is missing"));
}
