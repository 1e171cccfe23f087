// SPDX-License-Identifier: Apache-2.0
// The program make_tokens as its users meet it, alone and several at a list.
#include <doctest/doctest.h>

#include <algorithm>
#include <chrono>
#include <filesystem>
#include <map>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "lvggt/core/float16.h"
#include "lvggt/data/training_set.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/json.h"
#include "lvggt/io/safetensors.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/tiny_scene.h"

using namespace lvggt;
namespace fs = std::filesystem;

namespace {

struct Result {
  int status = 0;
  std::string out, err;
  bool says(const std::string& text) const { return err.find(text) != std::string::npos; }
};

Result finish(test::ChildProcess& child) {
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

// A small model's weights, made once.
const std::string& weights() {
  static const test::TempDir dir(test::TempDir::in_memory());
  static const std::string path = [] {
    const ModelConfig config = test::tiny_config();
    test::write_tensors(dir / "model.safetensors", geometry_tensors(config), &config);
    return dir / "model.safetensors";
  }();
  return path;
}

std::vector<std::string> command(const std::vector<std::string>& more) {
  std::vector<std::string> argv{lvggt::test::program("make_tokens"),
                                "--weights",
                                weights(),
                                "--mode",
                                "original",
                                "--threads",
                                "1"};
  argv.insert(argv.end(), more.begin(), more.end());
  return argv;
}
Result run(const std::vector<std::string>& more) {
  test::ChildProcess child(command(more));
  Result result = finish(child);
  INFO(result.err);
  return result;
}

// All token files and the manifest below a folder, with their bytes.
std::map<std::string, std::string> contents(const std::string& folder) {
  std::map<std::string, std::string> files;
  for (const auto& entry : fs::recursive_directory_iterator(folder)) {
    const std::string name = entry.path().filename().string();
    if (entry.is_regular_file() && (name.ends_with(".safetensors") || name == "manifest.json"))
      files[fs::relative(entry.path(), folder).string()] = test::read_bytes(entry.path().string());
  }
  return files;
}

bool has_temporary(const std::string& folder) {
  for (const auto& entry : fs::recursive_directory_iterator(folder))
    if (entry.path().filename().string().starts_with('.')) return true;
  return false;
}

// Kills the program as soon as `file` is there, or leaves it if it ends before.
void kill_once_there(const std::vector<std::string>& argv, const std::string& file, int signal) {
  test::ChildProcess child(argv);
  while (child.running() && !fs::exists(file))
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  child.send(signal);
  child.wait();
}

}  // namespace

TEST_CASE("make_tokens: the tokens of a scene are what training asks for") {
  test::TinyScene tiny(3);
  const Result result = run({tiny.path()});
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK_FALSE(has_temporary(tiny.tokens()));
  const TokenCache cache = TokenCache::open(tiny.tokens());
  CHECK(cache.manifest().complete);
  CHECK(cache.manifest().settings.storage == Dtype::kBF16);
  CHECK(cache.manifest().frames[2].name == "000003");
  CHECK(cache.manifest().frames[2].image == "000003.png");
  TrainingSetOptions options;
  options.scenes = {tiny.path()};
  options.config = test::tiny_config();
  Context ctx(1);
  LoadOptions load;
  load.weights = weights();
  options.encoder_sha256 = encoder_sha256(Checkpoint(load), ctx);
  const TrainingSet set = TrainingSet::open(options, ctx);
  CHECK(set.samples(Part::kTrain).size() == 3);
  const Json record = Json::read(tiny.tokens() + "/run.json");
  CHECK(record.find("status")->as_string("status") == "complete");
}

TEST_CASE("make_tokens: f32 tokens are those of the stream, and bf16 ones are them rounded") {
  test::TinyScene tiny(2);
  REQUIRE(run({tiny.path(), "--storage", "f32", "--out", tiny / "f32"}).status == 0);
  REQUIRE(run({tiny.path(), "--out", tiny / "bf16", "--threads", "2"}).status != 0);  // twice
  REQUIRE(run({tiny.path(), "--out", tiny / "bf16"}).status == 0);
  const Tensor<float, 2> exact =
      Safetensors::open(tiny / "f32/000002.safetensors").read<2>("tap.3");
  const Tensor<float, 2> narrow =
      Safetensors::open(tiny / "bf16/000002.safetensors").read<2>("tap.3");
  for (std::int64_t i = 0; i < exact.size(); ++i)
    REQUIRE(narrow.data()[i] == to_float(to_bfloat16(exact.data()[i])));
}

TEST_CASE("make_tokens: a folder of images and a video are inputs too, with --out") {
  test::TinyScene tiny(2);
  CHECK(run({tiny.images()}).status == 2);
  REQUIRE(run({tiny.images(), "--out", tiny / "a"}).status == 0);
  CHECK(fs::exists(tiny / "a/000002.safetensors"));
  const Result video = run({lvggt::test::test_data("../examples/data/cup_24.mp4"), "--out",
                            tiny / "b", "--max-frames", "3", "--stride", "2"});
  INFO(video.err);
  REQUIRE(video.status == 0);
  CHECK(fs::exists(tiny / "b/000004.safetensors"));
  CHECK(TokenCache::open(tiny / "b").manifest().frames.size() == 3);
}

TEST_CASE("D08: killed at any moment and resumed, the tokens are those of one run") {
  test::TinyScene tiny(8);
  REQUIRE(run({tiny.path(), "--out", tiny / "whole"}).status == 0);
  const auto whole = contents(tiny / "whole");
  CHECK(whole.size() == 9);
  for (const int frame : {0, 3, 7}) {
    const std::string out = tiny / ("out" + std::to_string(frame));
    kill_once_there(command({tiny.path(), "--out", out}),
                    out + "/" + tiny.name(frame) + ".safetensors", SIGKILL);
    for (const auto& [name, bytes] : contents(out))
      if (name != "manifest.json") CHECK(bytes == whole.at(name));
    const Result result = run({tiny.path(), "--out", out, "--resume"});
    INFO(result.err);
    CHECK(result.status == 0);
    CHECK(contents(out) == whole);
  }
}

TEST_CASE("D07: SIGINT leaves a usable part, exit 130, and --resume completes it") {
  test::TinyScene tiny(40);
  const std::string out = tiny.tokens();
  test::ChildProcess child(command({tiny.path()}));
  while (child.running() && !fs::exists(out + "/000002.safetensors"))
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  child.send(SIGINT);
  const Result result = finish(child);
  INFO(result.err);
  REQUIRE(result.status == 130);
  CHECK(result.says("--resume continues"));
  const TokenManifest manifest = TokenCache::open(out).manifest();
  CHECK_FALSE(manifest.complete);
  CHECK(manifest.frames.size() >= 2);
  CHECK(manifest.frames.size() < 40);
  const Result other = run({tiny.path(), "--resume", "--max-past-frames", "3"});
  CHECK(other.status == 2);
  CHECK(other.says("max_past_frames is 128, not 3"));
  const Result resumed = run({tiny.path(), "--resume"});
  CHECK(resumed.status == 0);
  CHECK(resumed.says("were there already"));
  CHECK(TokenCache::open(out).manifest().frames.size() == 40);
  CHECK(run({tiny.path(), "--resume"}).says("complete already"));
}

TEST_CASE("B22: after a picture changed, --resume makes its tokens and all later ones again") {
  test::TinyScene tiny(4), changed(4);
  REQUIRE(run({tiny.path()}).status == 0);
  const auto before = contents(tiny.tokens());
  for (const test::TinyScene* scene : {&tiny, &changed})
    test::TinyScene::add_picture(scene->images() + "/000003.png", 28, 42, 55);
  REQUIRE(run({tiny.path(), "--resume"}).status == 0);
  REQUIRE(run({changed.path()}).status == 0);
  auto after = contents(tiny.tokens()), wanted = contents(changed.tokens());
  CHECK(after.at("000002.safetensors") == before.at("000002.safetensors"));
  CHECK(after.at("000004.safetensors") != before.at("000004.safetensors"));
  after.erase("manifest.json");  // it names the folder
  wanted.erase("manifest.json");
  CHECK(after == wanted);
}

TEST_CASE("D02: tokens that are there are refused, replaced with --force, and foreign files stay") {
  test::TinyScene tiny(3);
  REQUIRE(run({tiny.path()}).status == 0);
  const Result again = run({tiny.path()});
  CHECK(again.status == 2);
  CHECK(again.says("--force replaces it"));
  test::write_bytes(tiny.tokens() + "/notes.txt", "mine");
  SafetensorsWriter foreign(tiny.tokens() + "/mine.safetensors");
  foreign.add("x", {1}, std::vector<float>{1});
  foreign.finish();
  REQUIRE(run({tiny.path(), "--force", "--max-frames", "1"}).status == 0);
  CHECK(fs::exists(tiny.tokens() + "/000001.safetensors"));
  CHECK_FALSE(fs::exists(tiny.tokens() + "/000002.safetensors"));
  CHECK(fs::exists(tiny.tokens() + "/notes.txt"));
  CHECK(fs::exists(tiny.tokens() + "/mine.safetensors"));
  fs::create_directory(tiny / "foreign");
  test::write_bytes(tiny / "foreign/x", "mine");
  CHECK(run({tiny.path(), "--out", tiny / "foreign", "--force"}).status == 2);
}

TEST_CASE("make_tokens: wrong usage and bad input are refused before anything is written") {
  test::TinyScene tiny(2);
  const auto status = [&](std::vector<std::string> more) {
    const Result result = run(more);
    INFO(result.err);
    CHECK_FALSE(result.err.empty());
    return result.status;
  };
  CHECK(status({}) == 2);
  CHECK(status({tiny.path(), "--list", "x"}) == 2);
  CHECK(status({tiny.path(), "--shard", "1/2"}) == 2);
  CHECK(status({tiny.path(), "--size", "100"}) == 2);
  CHECK(status({tiny.path(), "--storage", "int8"}) == 2);
  CHECK(status({tiny.path(), "--force", "--resume"}) == 2);
  CHECK(status({tiny / "nothing", "--out", tiny / "x"}) == 3);
  CHECK(status({tiny.path(), "--sha256", std::string(64, 'a')}) == 3);
  CHECK(status({tiny.path(), "--memory-limit", "1M"}) == 4);
  CHECK(status({tiny.path(), "--start", "2"}) == 2);
  const Result plan = run({tiny.path(), "--dry-run"});
  CHECK(plan.status == 0);
  CHECK(plan.out.find("2 frames of 42 x 28") != std::string::npos);
  CHECK(plan.out.find("disk ") != std::string::npos);
  CHECK_FALSE(fs::exists(tiny.tokens()));
  CHECK_FALSE(fs::exists(tiny / "x"));
  test::TinyScene::add_picture(tiny.images() + "/000002.png", 28, 56, 0);
  const Result mixed = run({tiny.path()});
  CHECK(mixed.status == 3);
  CHECK(mixed.says("000002.png"));
  CHECK(TokenCache::open(tiny.tokens()).manifest().frames.size() == 1);
}

TEST_CASE("D09: a disk that is full ends the run with status 1 and leaves no cut file") {
  test::TinyScene tiny(2);
  test::ChildProcess child(command({tiny.path()}), 3000);  // the manifest fits, tokens do not
  const Result result = finish(child);
  INFO(result.err);
  CHECK(result.status == 1);
  CHECK(result.says("000001.safetensors"));
  CHECK_FALSE(fs::exists(tiny.tokens() + "/000001.safetensors"));
  CHECK_FALSE(has_temporary(tiny.tokens()));
}

namespace {

// Scenes of some frames each, and a file that lists them.
struct Scenes {
  explicit Scenes(int num_scenes, int num_frames = 3) {
    std::string text = "# scenes\n";
    for (int i = 0; i < num_scenes; ++i) {
      scenes.push_back(std::make_unique<test::TinyScene>(num_frames, SceneLayout::kHyperNerf,
                                                         "scene" + std::to_string(i)));
      text += scenes.back()->path() + "\n";
    }
    test::write_bytes(list(), text);
  }
  std::string list() const { return dir / "list.txt"; }
  std::vector<std::string> arguments(const std::string& out) const {
    return {"--list", list(), "--out", dir / out};
  }

  test::TempDir dir{test::TempDir::in_memory()};
  std::vector<std::unique_ptr<test::TinyScene>> scenes;
};

}  // namespace

TEST_CASE("make_tokens: a list goes to the scenes, or to a folder for each") {
  const Scenes all(3);
  const Result result = run({"--list", all.list()});
  INFO(result.err);
  CHECK(result.status == 0);
  CHECK(result.says("3 of 3 inputs done"));
  for (const auto& scene : all.scenes) CHECK(TokenCache::open(scene->tokens()).manifest().complete);
  CHECK(run({"--list", all.list()}).says("0 of 3 inputs done, 3 done before"));
  CHECK(run(all.arguments("out")).status == 0);
  CHECK(TokenCache::open(all.dir / "out/scene1").manifest().complete);
  CHECK_FALSE(fs::exists(all.dir / "out/scene1.lock"));
  auto shard = all.arguments("shards");
  shard.insert(shard.end(), {"--shard", "2/3"});
  CHECK(run(shard).status == 0);
  CHECK(fs::exists(all.dir / "shards/scene1"));
  CHECK_FALSE(fs::exists(all.dir / "shards/scene0"));
}

TEST_CASE(
    "E11: processes killed at random while they share a list leave what one clean run would") {
  const Scenes all(4);
  REQUIRE(run(all.arguments("clean")).status == 0);
  const auto clean = contents(all.dir / "clean");
  for (int round = 0; round < 3; ++round) {
    test::ChildProcess first(command(all.arguments("out"))), second(command(all.arguments("out")));
    std::this_thread::sleep_for(std::chrono::milliseconds(20 + 35 * round));
    first.send(SIGKILL);
    first.wait();
    std::this_thread::sleep_for(std::chrono::milliseconds(25));
    second.send(SIGKILL);
    second.wait();
  }
  test::ChildProcess a(command(all.arguments("out"))), b(command(all.arguments("out")));
  const Result from_a = finish(a), from_b = finish(b);
  INFO(from_a.err, from_b.err);
  CHECK(from_a.status == 0);
  CHECK(from_b.status == 0);
  CHECK(run(all.arguments("out")).says("4 done before"));
  CHECK(contents(all.dir / "out") == clean);
}

TEST_CASE("E15: a damaged scene in a list is reported, the others finish, status 5") {
  const Scenes all(3);
  test::write_bytes(all.scenes[1]->images() + "/000001.png", "no picture");
  const Result result = run(all.arguments("out"));
  INFO(result.err);
  CHECK(result.status == 5);
  CHECK(result.says("2 of 3 inputs done, 1 failed"));
  CHECK(TokenCache::open(all.dir / "out/scene2").manifest().complete);
  CHECK(test::read_bytes(all.dir / "out/scene1.failed").find("000001.png") != std::string::npos);
  const Result again = run(all.arguments("out"));
  CHECK(again.status == 5);
  CHECK(again.says("left out, it failed 2 times"));
  test::TinyScene::add_picture(all.scenes[1]->images() + "/000001.png", 28, 42, 0);
  auto retry = all.arguments("out");
  retry.push_back("--retry-failed");
  CHECK(run(retry).status == 0);
}

TEST_CASE("E13: an input whose pictures changed between two runs of a list is made again") {
  const Scenes all(2);
  REQUIRE(run(all.arguments("out")).status == 0);
  test::TinyScene::add_picture(all.scenes[1]->images() + "/000001.png", 28, 42, 9);
  const Result result = run(all.arguments("out"));
  CHECK(result.status == 0);
  CHECK(result.says("1 of 2 inputs done, 1 done before"));
}
