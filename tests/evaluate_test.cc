// SPDX-License-Identifier: Apache-2.0
// The program evaluate as its users meet it, on the feature maps of another method.
#include <doctest/doctest.h>

#include <cmath>
#include <filesystem>
#include <map>

#include "lvggt/io/atomic_file.h"
#include "lvggt/io/json.h"
#include "lvggt/io/npy.h"
#include "lvggt/io/png.h"
#include "tests/support/paths.h"
#include "tests/support/random.h"
#include "tests/support/run_program.h"

using namespace lvggt;
using namespace lvggt::test;
namespace fs = std::filesystem;

namespace {

constexpr std::int64_t kH = 40, kW = 52, kD = 8, kLevels = 2;
const std::vector<std::string> kPhrases{"cup",    "hand",   "the cup is full", "mug",
                                        "object", "things", "stuff",           "texture"};

using Mask = std::vector<std::vector<bool>>;

Mask box(std::int64_t x0, std::int64_t y0, std::int64_t x1, std::int64_t y1) {
  Mask mask(kH, std::vector<bool>(kW));
  for (std::int64_t y = y0; y <= y1; ++y)
    for (std::int64_t x = x0; x <= x1; ++x)
      mask[static_cast<std::size_t>(y)][static_cast<std::size_t>(x)] = true;
  return mask;
}

// A scene of four frames, of which 1, 2 and 4 are annotated, with feature maps of full width: the
// embedding of what is at a pixel, and noise.
class MapScene {
 public:
  MapScene() : path_(dir_ / "kitchen") {
    for (const char* folder : {"/rgb/2x", "/annotations/train"})
      fs::create_directories(path_ + folder);
    for (std::int64_t level = 0; level < kLevels; ++level) fs::create_directories(renders(level));
    fs::create_directories(states());
    embeddings_ = random_tensor(Shape{std::ssize(kPhrases), kD}, 11);
    for (std::int64_t i = 0; i < embeddings_.extent(0); ++i) {
      double length = 0;
      for (std::int64_t c = 0; c < kD; ++c) length += std::pow(embeddings_(i, c), 2);
      for (std::int64_t c = 0; c < kD; ++c)
        embeddings_(i, c) /= static_cast<float>(std::sqrt(length));
    }
    write_npy(dir_ / "words.npy", embeddings_);
    std::string list;
    for (const std::string& phrase : kPhrases)
      list += (list.empty() ? "[\"" : ", \"") + phrase + '"';
    write_file(dir_ / "words.json", list + "]");
    for (std::int64_t frame = 0; frame < 4; ++frame) add_frame(frame);
    write_annotations();
  }

  std::string renders(std::int64_t level) const { return path_ + "/level" + std::to_string(level); }
  std::string states() const { return path_ + "/dynamic"; }
  const std::string& path() const { return path_; }
  std::string file(const std::string& name) const { return dir_ / name; }

  static Mask cup(std::int64_t frame) { return box(4 + 6 * frame, 5, 16 + 6 * frame, 30); }
  static Mask hand() { return box(38, 8, 49, 35); }

  std::vector<std::string> arguments(const std::vector<std::string>& more = {}) const {
    std::vector<std::string> all{path_,
                                 "--method",
                                 "Maps",
                                 "--threads",
                                 "1",
                                 "--text-encoder",
                                 dir_ / "words.npy",
                                 "--sentence-encoder",
                                 dir_ / "words.npy",
                                 "--renders",
                                 renders(0),
                                 "--renders",
                                 renders(1),
                                 "--state-renders",
                                 states()};
    all.insert(all.end(), more.begin(), more.end());
    return all;
  }

  const Tensor<float, 2>& embeddings() const { return embeddings_; }
  const Tensor<float, 4>& maps(std::int64_t frame) const { return maps_.at(frame); }

 private:
  void add_frame(std::int64_t frame) {
    const std::string number = "00000" + std::to_string(frame + 1);
    Tensor<std::uint8_t, 3> picture(Shape{kH, kW, std::int64_t{3}});
    write_png(path_ + "/rgb/2x/" + number + ".png", picture);
    write_png(path_ + "/annotations/train/" + number + "_png.png", picture);
    const Mask at_cup = cup(frame), at_hand = hand();
    Tensor<float, 4> maps = random_tensor(Shape{kLevels, kH, kW, kD},
                                          20 + static_cast<std::uint32_t>(frame), -0.25F, 0.25F);
    Tensor<float, 3> state(Shape{kH, kW, kD});
    for (std::int64_t y = 0; y < kH; ++y)
      for (std::int64_t x = 0; x < kW; ++x) {
        const auto row = static_cast<std::size_t>(y), column = static_cast<std::size_t>(x);
        const std::int64_t phrase = at_cup[row][column] ? 0 : at_hand[row][column] ? 1 : 6;
        for (std::int64_t c = 0; c < kD; ++c) {
          for (std::int64_t level = 0; level < kLevels; ++level)
            maps(level, y, x, c) +=
                embeddings_(phrase, c) + 0.4F * embeddings_(phrase == 0 ? 2 : phrase, c);
          // Full in the first two frames.
          state(y, x, c) = embeddings_(frame < 2 ? 2 : 1, c);
        }
      }
    for (std::int64_t level = 0; level < kLevels; ++level)
      write_npy(renders(level) + "/0000" + std::to_string(frame) + ".npy",
                View<const float, 3>(maps[level]));
    write_npy(states() + "/0000" + std::to_string(frame) + ".npy", state);
    maps_[frame] = std::move(maps);
  }

  static std::string polygon(const Mask& mask) {
    std::int64_t x0 = kW, y0 = kH, x1 = 0, y1 = 0;
    for (std::int64_t y = 0; y < kH; ++y)
      for (std::int64_t x = 0; x < kW; ++x)
        if (mask[static_cast<std::size_t>(y)][static_cast<std::size_t>(x)])
          x0 = std::min(x0, x), x1 = std::max(x1, x), y0 = std::min(y0, y), y1 = std::max(y1, y);
    return concat("[[", x0, ", ", y0, ", ", x1, ", ", y0, ", ", x1, ", ", y1, ", ", x0, ", ", y1,
                  "]]");
  }

  void write_annotations() const {
    std::string images, annotations;
    for (const std::int64_t frame : {0, 1, 3}) {
      const char* comma = frame == 0 ? "" : ", ";
      images += concat(comma, "{\"id\": ", frame, ", \"file_name\": \"00000", frame + 1,
                       "_png.png\", \"height\": ", kH, ", \"width\": ", kW, "}");
      annotations += concat(comma, "{\"image_id\": ", frame,
                            ", \"category_id\": 1, \"segmentation\": ", polygon(cup(frame)), "}");
      if (frame != 1)
        annotations += concat(", {\"image_id\": ", frame,
                              ", \"category_id\": 2, \"segmentation\": ", polygon(hand()), "}");
    }
    write_file(
        path_ + "/annotations/train/_annotations.coco.json",
        "{\"categories\": [{\"id\": 1, \"name\": \"cup\"}, {\"id\": 2, \"name\": \"hand\"}], "
        "\"images\": [" +
            images + "], \"annotations\": [" + annotations + "]}");
    write_file(path_ + "/annotations/video_annotations.json",
               "{\"cup\": {\"the cup is full\": [[0, 1]]}}");
  }

  TempDir dir_{TempDir::in_memory()};
  std::string path_;
  Tensor<float, 2> embeddings_;
  std::map<std::int64_t, Tensor<float, 4>> maps_;
};

// The protocol once more, written from its description, in double and pixel by pixel.
struct Naive {
  static double relevancy(const float* e, const Tensor<float, 2>& words, std::int64_t phrase) {
    const auto cosine = [&](std::int64_t word) {
      double dot = 0, length = 0;
      for (std::int64_t c = 0; c < kD; ++c) {
        dot += static_cast<double>(e[c]) * words(word, c);
        length += static_cast<double>(e[c]) * e[c];
      }
      return dot / std::sqrt(length);
    };
    double least = 1;
    for (std::int64_t word = 4; word < 8; ++word)
      least = std::min(least, 1 / (1 + std::exp(10 * (cosine(word) - cosine(phrase)))));
    return least;
  }

  // The mean over the window, of what lies in the map.
  template <class Value>
  static double window(std::int64_t y, std::int64_t x, std::int64_t r, const Value& value) {
    double sum = 0, count = 0;
    for (std::int64_t v = y - r; v <= y + r; ++v)
      for (std::int64_t u = x - r; u <= x + r; ++u)
        if (v >= 0 && v < kH && u >= 0 && u < kW) sum += value(v, u), ++count;
    return sum / count;
  }

  static Mask mask(const Tensor<float, 4>& maps, const Tensor<float, 2>& words,
                   std::int64_t phrase) {
    std::vector<double> best;
    for (std::int64_t level = 0; level < kLevels; ++level) {
      std::vector<double> raw(kH * kW), filtered(kH * kW);
      for (std::size_t i = 0; i < raw.size(); ++i)
        raw[i] = relevancy(maps[level].data() + static_cast<std::int64_t>(i) * kD, words, phrase);
      for (std::int64_t y = 0; y < kH; ++y)
        for (std::int64_t x = 0; x < kW; ++x) {
          const auto i = static_cast<std::size_t>(y * kW + x);
          filtered[i] = (raw[i] + window(y, x, 14,
                                         [&](std::int64_t v, std::int64_t u) {
                                           return raw[static_cast<std::size_t>(v * kW + u)];
                                         })) /
                        2;
        }
      const auto largest = [](const std::vector<double>& v) {
        return *std::max_element(v.begin(), v.end());
      };
      if (best.empty() || largest(filtered) > largest(best)) best = filtered;
    }
    const auto [low, high] = std::minmax_element(best.begin(), best.end());
    const double least = *low, range = *high - *low + 1e-9;
    const auto inside = [&](std::int64_t v, std::int64_t u) {
      return (best[static_cast<std::size_t>(v * kW + u)] - least) / range * 2 - 1 > 0.4 ? 1.0 : 0.0;
    };
    Mask result(kH, std::vector<bool>(kW));
    for (std::int64_t y = 0; y < kH; ++y)
      for (std::int64_t x = 0; x < kW; ++x)
        result[static_cast<std::size_t>(y)][static_cast<std::size_t>(x)] =
            window(y, x, 3, inside) > 0.5;
    return result;
  }

  static std::pair<double, double> score(const Mask& a, const Mask& b) {
    double both = 0, any = 0, equal = 0;
    for (std::size_t y = 0; y < a.size(); ++y)
      for (std::size_t x = 0; x < a[y].size(); ++x) {
        both += a[y][x] && b[y][x];
        any += a[y][x] || b[y][x];
        equal += a[y][x] == b[y][x];
      }
    return {both / any, equal / static_cast<double>(kH * kW)};
  }
};

const Json& at(const Json& json, std::initializer_list<const char*> keys) {
  const Json* found = &json;
  for (const char* key : keys) {
    found = key[0] >= '0' && key[0] <= '9'
                ? &found->as_array("result")[static_cast<std::size_t>(key[0] - '0')]
                : found->find(key);
    REQUIRE(found != nullptr);
  }
  return *found;
}

}  // namespace

TEST_CASE("evaluate: mIoU and mAcc are those of an independent computation") {
  const MapScene scene;
  const ProgramResult result = run_program(program("evaluate"), scene.arguments({"--json"}));
  INFO(result.err);
  REQUIRE(result.status == 0);
  const Json json = Json::parse(result.out, "result");
  const Json& scored = at(json, {"runs", "0", "scenes", "0"});

  double miou = 0, macc = 0;
  for (const std::int64_t phrase : {0, 1}) {
    double iou = 0, accuracy = 0, frames = 0;
    for (const std::int64_t frame : {0, 1, 3}) {
      if (phrase == 1 && frame == 1) continue;  // not annotated there
      const auto [i, a] = Naive::score(Naive::mask(scene.maps(frame), scene.embeddings(), phrase),
                                       phrase == 0 ? MapScene::cup(frame) : MapScene::hand());
      iou += i, accuracy += a, ++frames;
    }
    miou += iou / frames / 2;
    macc += accuracy / frames / 2;
  }
  CHECK(miou > 0.5);
  CHECK(miou < 1);
  CHECK(at(scored, {"means", "miou"}).as_double("miou") == doctest::Approx(miou).epsilon(1e-9));
  CHECK(at(scored, {"means", "macc"}).as_double("macc") == doctest::Approx(macc).epsilon(1e-9));

  const Json& state = at(scored, {"states", "0"});
  double viou = 0;
  for (const std::int64_t frame : {0, 1})
    viou +=
        Naive::score(Naive::mask(scene.maps(frame), scene.embeddings(), 2), MapScene::cup(frame))
            .first /
        2;
  CHECK(at(state, {"acc"}).as_double("acc") == 1);
  CHECK(at(state, {"viou"}).as_double("viou") == doctest::Approx(viou).epsilon(1e-6));
}

TEST_CASE("evaluate: tables, CSV and pictures go into a folder, with the paper's figures") {
  const MapScene scene;
  const std::string out = scene.file("out");
  const ProgramResult result =
      run_program(program("evaluate"), scene.arguments({"--out", out, "--per-frame"}));
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.prints("Maps (one model a scene)"));
  CHECK(result.prints("83.99/98.67"));
  CHECK(result.prints("91.44/74.74"));
  CHECK(result.prints("\"the cup is full\""));
  const std::string csv = read_bytes(out + "/table.csv");
  CHECK(csv.find("Maps,one model a scene,kitchen,time-agnostic,cup,cup,3,IoU,") !=
        std::string::npos);
  for (const char* name : {"run.json", "table.txt", "1_kitchen_masks.png", "1_kitchen_states.png"})
    CHECK(fs::file_size(out + "/" + name) > 0);
  CHECK(run_program(program("evaluate"), scene.arguments({"--out", out})).status == 2);
  CHECK(run_program(program("evaluate"), scene.arguments({"--out", out, "--force"})).status == 0);
}

TEST_CASE("evaluate: a plan puts several runs and other wordings into one table") {
  const MapScene scene;
  write_file(scene.file("words_again.json"), R"({"cup": ["mug"]})");
  write_file(scene.file("plan.json"),
             R"([{"method": "A"}, {"method": "B", "paraphrases": "words_again.json"},
                 {"method": "C", "all-polygons": true, "regime": "fair"}])");
  const ProgramResult result =
      run_program(program("evaluate"), scene.arguments({"--plan", scene.file("plan.json")}));
  INFO(result.err);
  REQUIRE(result.status == 0);
  for (const char* row : {"A (one", "B (one", "B, in other words (one", "C (fair)"})
    CHECK(result.prints(row));
  write_file(scene.file("plan.json"), R"([{"methd": "A"}])");
  const ProgramResult unknown =
      run_program(program("evaluate"), scene.arguments({"--plan", scene.file("plan.json")}));
  CHECK(unknown.status == 3);
  CHECK(unknown.says("run 1: methd: there is no such member"));
}

TEST_CASE("evaluate: several scenes are scored side by side, with one model for all of them") {
  const MapScene scene;
  const std::string pantry = scene.file("pantry");
  fs::copy(scene.path(), pantry, fs::copy_options::recursive);
  const std::string out = scene.file("out");
  const ProgramResult result =
      run_program(program("evaluate"), scene.arguments({pantry, "--out", out}));
  INFO(result.err);
  REQUIRE(result.status == 0);
  CHECK(result.prints("Maps (one model for all)"));
  const std::string csv = read_bytes(out + "/table.csv");
  const auto score_of = [&](const std::string& name) {
    const std::string row = "Maps,one model for all," + name + ",time-agnostic,,,,mIoU,";
    const std::size_t at = csv.find(row);
    REQUIRE(at != std::string::npos);
    return csv.substr(at + row.size(), csv.find('\n', at) - at - row.size());
  };
  CHECK(score_of("kitchen") == score_of("pantry"));
}

TEST_CASE("evaluate: what does not fit is said in one sentence") {
  const MapScene scene;
  const auto fails = [&](const std::vector<std::string>& arguments, int status,
                         const std::string& words) {
    const ProgramResult result = run_program(program("evaluate"), arguments);
    CAPTURE(result.err);
    CHECK(result.status == status);
    CHECK(result.says(words));
  };
  fails(scene.arguments({"--field", "x"}), 2, "exactly one source of features");
  fails({scene.path(), "--renders", scene.renders(0)}, 2, "--text-encoder is needed");
  write_file(scene.file("words_again.json"), R"({"cup": ["a cup of tea"]})");
  fails(scene.arguments({"--paraphrases", scene.file("words_again.json")}), 3, "a cup of tea");

  Tensor<float, 2> narrow(Shape{std::ssize(kPhrases), std::int64_t{5}});
  for (std::int64_t i = 0; i < narrow.size(); ++i) narrow.data()[i] = 1;
  write_npy(scene.file("narrow.npy"), narrow);
  fs::copy_file(scene.file("words.json"), scene.file("narrow.json"));
  std::vector<std::string> arguments = scene.arguments();
  arguments[6] = scene.file("narrow.npy");
  fails(arguments, 3, "codes of 8 numbers but the autoencoder takes 5");

  fs::remove(scene.renders(1) + "/00003.npy");
  fs::remove(scene.renders(1) + "/00002.npy");
  fails(scene.arguments(), 3, "neither numbered by the annotated frames nor one after the other");
  fs::remove(scene.path() + "/annotations/train/000002_png.png");
  fails(scene.arguments(), 3, "000002_png.png: there is no such picture");
}
