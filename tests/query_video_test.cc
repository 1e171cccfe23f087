// SPDX-License-Identifier: Apache-2.0
// The program query_video as its users meet it, on a small field whose meaning is known.
#include <doctest/doctest.h>

#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/field/lifted_field.h"
#include "lvggt/io/image.h"
#include "lvggt/io/json.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/temp_dir.h"
#include "tests/support/tiny_field.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using test::TinyField;
namespace fs = std::filesystem;

namespace {

struct Result {
  int status = 0;
  std::string out, err;
  bool says(const std::string& text) const { return err.find(text) != std::string::npos; }
  bool prints(const std::string& text) const { return out.find(text) != std::string::npos; }
};

// A field and what is needed to ask it: "cup" and "wall" are halves of every frame, "unicorn" is
// nowhere; the cup is tilted from frame 3 on.
class Asked {
 public:
  explicit Asked(void (*change)(TinyField&) = nullptr) {
    TinyField field(dir_ / "field");
    if (change != nullptr) change(field);
    field.write();
    test::write_identity_autoencoder(dir_ / "ae.safetensors", TinyField::kAxes);
    test::write_identity_autoencoder(dir_ / "state_ae.safetensors", 2);
    test::write_axes(dir_ / "phrases", TinyField::kAxes,
                     {{"cup", TinyField::kCup},
                      {"wall", TinyField::kWall},
                      {"unicorn", 2},
                      {"the cup is upright", TinyField::kCup},
                      {"the cup is tilted", TinyField::kCup},
                      {"object", 3},
                      {"things", 4},
                      {"stuff", 5},
                      {"texture", 5}});
    test::write_axes(
        dir_ / "sentences", 2,
        {{"the cup is upright", TinyField::kUpright}, {"the cup is tilted", TinyField::kTilted}});
  }

  std::string operator/(const std::string& name) const { return dir_ / name; }

  std::vector<std::string> command(const std::vector<std::string>& more) const {
    std::vector<std::string> argv{lvggt::test::program("query_video"),
                                  dir_ / "field",
                                  "--text-encoder",
                                  dir_ / "phrases.npy",
                                  "--autoencoder",
                                  dir_ / "ae.safetensors",
                                  "--threads",
                                  "2"};
    argv.insert(argv.end(), more.begin(), more.end());
    return argv;
  }
  std::vector<std::string> with_states(std::vector<std::string> more) const {
    more.insert(more.end(), {"--sentence-encoder", dir_ / "sentences.npy", "--state-autoencoder",
                             dir_ / "state_ae.safetensors"});
    return more;
  }
  Result ask(const std::vector<std::string>& more) const {
    test::ChildProcess child(command(more));
    const int status = child.wait();
    return {status, child.out(), child.err()};
  }
  // With the standard input from a file.
  Result converse(const std::string& input, const std::vector<std::string>& more) const {
    test::write_bytes(dir_ / "input", input);
    std::string line = "exec \"$@\" <'" + (dir_ / "input") + "'";
    std::vector<std::string> argv{"/bin/sh", "-c", line, "sh"};
    for (const std::string& argument : command(more)) argv.push_back(argument);
    test::ChildProcess child(argv);
    const int status = child.wait();
    return {status, child.out(), child.err()};
  }

 private:
  test::TempDir dir_;
};

const Json& at(const Json& json, const std::string& key) {
  const Json* member = json.find(key);
  REQUIRE(member != nullptr);
  return *member;
}

}  // namespace

TEST_CASE("query_video: masks, heat maps, clouds, time lines and JSON say where and when") {
  const Asked asked;
  const Result result = asked.ask(
      asked.with_states({"cup", "wall", "--state", "the cup is tilted", "--out", asked / "out"}));
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.prints("\"cup\": found in 6 of 6 frames"));
  CHECK(result.prints("\"the cup is tilted\": holds in frames 3-5 (1.50-2.50 s)"));
  CHECK(result.says("3 answers about 6 frames"));

  for (const char* file :
       {"answers.json", "answers.png", "time_lines.png", "run.json", "001_cup/heat/000005.png",
        "002_wall/points/000000.ply", "003_the_cup_is_tilted/mask/000000.png"})
    CHECK_MESSAGE(fs::exists(asked / ("out/" + std::string(file))), file);
  const Image cup = load_image(asked / "out/001_cup/mask/000002.png");
  REQUIRE(cup.width() == TinyField::kWidth);
  CHECK(cup.pixels(10, 2, 0) == 255);
  CHECK(cup.pixels(10, 30, 0) == 0);
  CHECK(load_image(asked / "out/002_wall/mask/000002.png").pixels(10, 30, 0) == 255);
  // A state's mask is its object where it holds, and empty elsewhere.
  CHECK(load_image(asked / "out/003_the_cup_is_tilted/mask/000002.png").pixels(10, 2, 0) == 0);
  CHECK(load_image(asked / "out/003_the_cup_is_tilted/mask/000004.png").pixels(10, 2, 0) == 255);
  const std::string ply = test::read_bytes(asked / "out/001_cup/points/000000.ply");
  CHECK(ply.find("property float relevancy\nproperty float answer\nend_header") !=
        std::string::npos);

  const Json answers = Json::read(asked / "out/answers.json");
  const auto& results = at(answers, "results").as_array("results");
  REQUIRE(results.size() == 3);
  CHECK(at(results[0], "phrase").as_string("phrase") == "cup");
  CHECK(at(results[0], "folder").as_string("folder") == "001_cup");
  const auto& frames = at(results[0], "frames").as_array("frames");
  REQUIRE(frames.size() == 6);
  CHECK(at(frames[1], "found").as_bool("found"));
  CHECK(at(frames[1], "timestamp").as_double("timestamp") == 0.5);
  const auto& box = at(frames[1], "box").as_array("box");
  CHECK(box[0].as_int64("x") == 0);
  CHECK(box[3].as_int64("height") == TinyField::kHeight);
  const auto& intervals = at(results[2], "intervals").as_array("intervals");
  REQUIRE(intervals.size() == 1);
  CHECK(at(intervals[0], "first").as_int64("first") == 3);
  CHECK(at(intervals[0], "last").as_int64("last") == 5);
  CHECK(at(results[2], "threshold").as_double("threshold") == doctest::Approx(0.5));
}

TEST_CASE("query_video: nonsense is not found, unless something is to be found everywhere") {
  const Asked asked;
  const Result nowhere = asked.ask({"unicorn", "--json"});
  INFO(nowhere.err);
  REQUIRE(nowhere.status == 0);
  const Json answers = Json::parse(nowhere.out, "stdout");
  const Json& result = at(answers, "results").as_array("results")[0];
  CHECK(at(result, "frames_positive").as_int64("n") == 0);
  CHECK(at(at(result, "frames").as_array("frames")[0], "box").is_null());
  CHECK(asked.ask({"unicorn"}).prints("not found: its relevancy reaches 0.50"));
  CHECK(asked.ask({"unicorn", "--min-score", "0"}).prints("found in 6 of 6"));
}

TEST_CASE("D06 query_video: a phrase that is empty, too long, unknown or not UTF-8 is refused") {
  const Asked asked;
  const Result empty = asked.ask({"cup", ""});
  CHECK(empty.status == 2);
  CHECK(empty.says("phrase 2 of 2 is empty"));
  CHECK(asked.ask({}).says("nothing is asked"));
  const Result unknown = asked.ask({"a zebra"});
  CHECK(unknown.status == 3);
  CHECK(unknown.says("a zebra"));
  CHECK(unknown.says("phrases"));
  CHECK(asked.ask({"\xff\xfe"}).status == 3);
  CHECK(asked.ask({"   "}).status == 2);
  CHECK(asked.ask({std::string(4096, 'a')}).status == 3);  // unknown, not too long
  CHECK(asked.ask({std::string(4097, 'a')}).status == 4);
  for (const char* odd : {"😀 a cup", "כוס", "<script>alert(1)</script>"}) {
    const Result result = asked.ask({odd});
    CHECK(result.status == 3);
    CHECK(result.says(odd));
  }
  CHECK(asked.ask({"--state", "the cup is tilted"}).says("--sentence-encoder"));
}

TEST_CASE("query_video: 1000 phrases are answered; empty lines and comments are left out") {
  const Asked asked;
  std::string list = "# phrases\n\n";
  for (int i = 0; i < 500; ++i) list += "cup\r\nwall\n";
  test::write_bytes(asked / "list.txt", list);
  const Result result = asked.ask({"--phrases", asked / "list.txt", "--json", "--every", "3"});
  INFO(result.err);
  REQUIRE(result.status == 0);
  const Json answers = Json::parse(result.out, "stdout");
  const auto& results = at(answers, "results").as_array("results");
  REQUIRE(results.size() == 1000);
  for (const std::size_t i : {0U, 1U, 63U, 64U, 998U, 999U}) {
    const Json& frame = at(results[i], "frames").as_array("frames")[1];
    CHECK(at(frame, "index").as_int64("index") == 3);
    CHECK(at(frame, "box").as_array("box")[0].as_int64("x") <= 20);
    CHECK((at(frame, "box").as_array("box")[0].as_int64("x") == 0) == (i % 2 == 0));
  }
  test::write_bytes(asked / "list.txt", std::string("cup\n").append(20'005, 'x'));
  CHECK(asked.ask({"--phrases", asked / "list.txt"}).status == 4);
}

TEST_CASE("query_video: --interactive answers line by line and goes on after an error") {
  const Asked asked;
  const Result result =
      asked.converse("cup\n\nzebra\nstate: the cup is upright\nunicorn",
                     asked.with_states({"--interactive", "--out", asked / "out"}));
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.prints("\"cup\": found in 6 of 6 frames"));
  CHECK(result.prints("holds in frames 0-2"));
  CHECK(result.prints("\"unicorn\": not found"));
  CHECK(result.says("an empty line asks nothing"));
  CHECK(result.says("zebra"));
  CHECK(fs::exists(asked / "out/001_cup.png"));
  CHECK(fs::exists(asked / "out/003_the_cup_is_upright_time.png"));

  const Result without = asked.converse("state: the cup is upright\n", {"--interactive"});
  CHECK(without.status == 0);
  CHECK(without.says("--sentence-encoder"));
}

TEST_CASE("query_video: files that do not fit each other are named") {
  const Asked asked;
  test::write_identity_autoencoder(asked / "narrow.safetensors", 3);
  const auto ask = [&](const std::string& autoencoder, const std::string& encoder) {
    test::ChildProcess child({lvggt::test::program("query_video"), asked / "field", "cup",
                              "--text-encoder", asked / encoder, "--autoencoder",
                              asked / autoencoder});
    const int status = child.wait();
    return Result{status, child.out(), child.err()};
  };
  const Result narrow = ask("narrow.safetensors", "phrases.npy");
  CHECK(narrow.status == 3);
  CHECK(narrow.says("narrow.safetensors"));
  CHECK(narrow.says("have 6"));
  const Result width = ask("ae.safetensors", "sentences.npy");
  CHECK(width.status == 3);
  CHECK(width.says("sentences.npy"));
  CHECK(ask("no.safetensors", "phrases.npy").says("no.safetensors"));
}

TEST_CASE("query_video: a field without semantics or states, or none at all, is said") {
  const Asked asked([](TinyField& field) { field.states = false; });
  const Result states = asked.ask(asked.with_states({"--state", "the cup is tilted"}));
  CHECK(states.status == 3);
  CHECK(states.says("without states"));
  CHECK(asked.ask({"cup"}).status == 0);

  const Asked geometry([](TinyField& field) { field.language = false; });
  CHECK(geometry.ask({"cup"}).says("without semantics"));
  fs::remove(geometry / "field/field.json");
  const Result none = geometry.ask({"cup"});
  CHECK(none.status == 3);
  CHECK(none.says("is no lifted field"));
}

TEST_CASE("query_video: a field without depth or frames still answers, and says what is missing") {
  const Asked asked([](TinyField& field) { field.outputs.depth = field.outputs.frames = false; });
  const Result result = asked.ask({"cup", "--out", asked / "out"});
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.says("no point clouds"));
  CHECK(result.says("painted on black"));
  CHECK_FALSE(fs::exists(asked / "out/001_cup/points"));
  CHECK(fs::exists(asked / "out/001_cup/heat/000000.png"));
}

TEST_CASE("D02: query_video replaces its own answers only, and only when told to") {
  const Asked asked;
  REQUIRE(asked.ask({"cup", "--out", asked / "out"}).status == 0);
  CHECK(asked.ask({"wall", "--out", asked / "out"}).status == 2);
  test::write_bytes(asked / "out/notes.txt", "mine");
  const Result forced = asked.ask({"wall", "--out", asked / "out", "--force", "--no-ply"});
  INFO(forced.err);
  REQUIRE(forced.status == 0);
  CHECK_FALSE(fs::exists(asked / "out/001_cup"));
  CHECK(fs::exists(asked / "out/001_wall/mask/000000.png"));
  CHECK_FALSE(fs::exists(asked / "out/001_wall/points"));
  CHECK(test::read_bytes(asked / "out/notes.txt") == "mine");

  // The field itself is not a place for answers.
  test::write_bytes(asked / "field/run.json", R"({"tool": "lift_video"})");
  const Result onto = asked.ask({"cup", "--out", asked / "field", "--force"});
  CHECK(onto.status == 2);
  CHECK(onto.says("another program"));
  CHECK(fs::exists(asked / "field/field.json"));
}

TEST_CASE("query_video: asks a folder of pictures directly, which it lifts first") {
  const Asked asked;
  const ModelConfig config = test::tiny_config();
  test::write_tensors(asked / "model.safetensors", test::all_tensors(config), &config);
  test::write_identity_autoencoder(asked / "three.safetensors", 3);
  test::write_axes(asked / "axes", 3,
                   {{"cup", 0}, {"object", 1}, {"things", 1}, {"stuff", 2}, {"texture", 2}});
  fs::create_directory(asked / "pictures");
  for (const char* name : {"a.png", "b.png"})
    write_png(asked / ("pictures/" + std::string(name)),
              Tensor<std::uint8_t, 3>(Shape{std::int64_t{56}, std::int64_t{84}, std::int64_t{3}}));
  const auto ask = [&](const std::vector<std::string>& more) {
    std::vector<std::string> argv{test::program("query_video"),
                                  asked / "pictures",
                                  "cup",
                                  "--text-encoder",
                                  asked / "axes.npy",
                                  "--autoencoder",
                                  asked / "three.safetensors",
                                  "--weights",
                                  asked / "model.safetensors",
                                  "--size",
                                  "84",
                                  "--threads",
                                  "2"};
    argv.insert(argv.end(), more.begin(), more.end());
    test::ChildProcess child(argv);
    const int status = child.wait();
    return Result{status, child.out(), child.err()};
  };
  CHECK(ask({}).says("--weights needs --out"));
  const Result result = ask({"--out", asked / "out"});
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.says("lifting "));
  CHECK(result.says("1 answer about 2 frames"));
  CHECK(fs::exists(asked / "out/001_cup/points/000001.ply"));
  CHECK(LiftedField::open(asked / "out/field").num_frames() == 2);
  const Result refused = ask({"--out", asked / "out", "--force", "--memory-limit", "1M"});
  CHECK(refused.status == 4);
  CHECK(refused.says("but it may have 1.0 MiB (--memory-limit)"));
  CHECK(fs::exists(asked / "out/001_cup/points/000001.ply"));  // nothing was replaced
  CHECK(ask({"--out", asked / "out", "--force"}).status == 0);
}

TEST_CASE("D40 query_video: more memory than --memory-limit is refused, and nothing is written") {
  const Asked asked;
  const std::vector<std::vector<std::string>> runs{
      {"cup", "--out", asked / "out"}, {"cup", "--dry-run"}, {"--interactive"}};
  for (std::vector<std::string> run : runs) {
    run.insert(run.end(), {"--memory-limit", "1M"});
    const Result result = asked.ask(run);
    CAPTURE(result.err);
    CHECK(result.status == 4);
    CHECK(result.says("the run needs about "));
    CHECK(result.says(" with the encoders and autoencoders, "));
    CHECK(result.says("but it may have 1.0 MiB (--memory-limit)"));
  }
  CHECK_FALSE(fs::exists(asked / "out"));
  CHECK(asked.ask({"cup", "--memory-limit", "100G"}).status == 0);
  CHECK(asked.ask({"cup", "--memory-limit", "much"}).status == 2);
}

TEST_CASE("query_video: --dry-run says what the field holds and writes nothing") {
  const Asked asked;
  const Result result = asked.ask({"cup", "--dry-run", "--out", asked / "out"});
  REQUIRE(result.status == 0);
  CHECK(result.prints("6 frames of 32 x 20"));
  CHECK(result.prints("memory "));
  CHECK_FALSE(fs::exists(asked / "out"));
}
