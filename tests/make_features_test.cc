// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <filesystem>
#include <utility>

#include "lvggt/io/npy.h"
#include "lvggt/io/png.h"
#include "lvggt/language/captions.h"
#include "lvggt/language/crops.h"
#include "lvggt/language/frame_features.h"
#include "lvggt/language/object_masks.h"
#include "tests/support/child_process.h"
#include "tests/support/compare.h"
#include "tests/support/paths.h"
#include "tests/support/random.h"
#include "tests/support/safetensors_bytes.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

namespace fs = std::filesystem;

const std::string kWeights = test_data("golden/language/weights_clip_tiny_seed1.safetensors");
constexpr std::int64_t kHeight = 30, kWidth = 40;

// Two frames with three objects on one level; object 3 is one pixel wide and gets no features.
struct SceneFiles {
  TempDir dir{TempDir::in_memory()};
  std::string scene = dir / "scene", masks = dir / "masks", captions = dir / "captions.csv";

  SceneFiles() {
    fs::create_directories(scene + "/rgb/2x");
    fs::create_directories(masks);
    Tensor<std::uint8_t, 3> rgb(Shape{kHeight, kWidth, std::int64_t{3}});
    for (std::int64_t i = 0; i < rgb.size(); ++i) rgb.data()[i] = static_cast<std::uint8_t>(i * 7);
    for (const char* name : {"000001", "000002"}) {
      write_png(scene + "/rgb/2x/" + name + ".png", std::as_const(rgb).view());
      write_npy(masks + "/" + name + ".npy", labels());
    }
    fs::copy_file(kWeights, dir / "clip.safetensors");
    write_file(dir / "open_clip_config.json", R"({"vision_cfg": {"width": 48, "head_width": 16},
        "text_cfg": {"heads": 4}})");
    write_file(captions,
               "frame,object,sentence\n1,1,the cup is upright\n2,1,\"it is \"\"tilted\"\", now\"\n"
               "2,2,the cup is upright\n");
    Tensor<float, 2> vectors(Shape{2, 3});
    vectors(0, 0) = vectors(1, 1) = 1;
    write_npy(dir / "sentences.npy", vectors);
    write_file(dir / "sentences.json", R"(["the cup is upright", "it is \"tilted\", now"])");
  }

  static Tensor<std::int32_t, 2> labels() {
    Tensor<std::int32_t, 2> map(Shape{kHeight, kWidth});
    for (std::int64_t y = 5; y < 20; ++y)
      for (std::int64_t x = 4; x < 14; ++x) map(y, x) = 1;
    for (std::int64_t y = 2; y < 28; ++y)
      for (std::int64_t x = 20; x < 39; ++x) map(y, x) = 2;
    for (std::int64_t y = 2; y < 28; ++y) map(y, 39) = 3;
    return map;
  }

  // Runs the program on the scene; its exit status and what it said.
  std::pair<int, std::string> run(std::vector<std::string> arguments) const {
    arguments.insert(arguments.begin(), {program("make_features"), scene, "--threads", "1"});
    ChildProcess child(arguments);
    const int status = child.wait();
    return {status, child.err()};
  }
};

}  // namespace

TEST_CASE("make_features: objects become CLIP's vectors and rows, and stay with --resume") {
  const SceneFiles files;
  const std::vector<std::string> arguments = {"--masks", files.masks, "--image-encoder",
                                              files.dir / "clip.safetensors"};
  auto [status, said] = files.run(arguments);
  INFO(said);
  REQUIRE(status == 0);
  const std::string stem = files.scene + "/clip_features/000001";
  const auto features = NpyFile(stem + "_f.npy").read<2>();
  const auto rows = NpyFile(stem + "_s.npy").read<3>();
  CHECK(features.shape() == (Shape{2, 24}));
  CHECK(rows.shape() == (Shape{std::int64_t{4}, kHeight, kWidth}));
  for (std::int64_t level = 0; level < 4; ++level) {
    CHECK(rows(level, 10, 10) == 0);
    CHECK(rows(level, 10, 30) == 1);
    CHECK(rows(level, 10, 39) == -1);
    CHECK(rows(level, 0, 0) == -1);
  }
  // The same by library calls.
  Context ctx(2);
  const ClipImage clip = load_clip_image(Safetensors::open(kWeights), {3, 4, false, "", {}});
  const Image image = load_image(files.scene + "/rgb/2x/000001.png");
  const auto boxes = find_objects(SceneFiles::labels());
  Tensor<float, 4> pixels(Shape{2, 32, 32, 3});
  clip_object_pixels(pixels, image.pixels, SceneFiles::labels(), {boxes[0], boxes[1]}, ctx);
  Tensor<float, 2> expected(Shape{2, 24});
  clip_image_forward(expected, pixels, clip, nullptr, ctx);
  CHECK_CLOSE(features, expected, 5e-4);  // stored in half precision

  CHECK(files.run(arguments).first == 2);  // an earlier run is there
  const auto written = fs::last_write_time(stem + "_s.npy");
  fs::remove(files.scene + "/clip_features/000002_f.npy");
  auto resumed = arguments;
  resumed.push_back("--resume");
  CHECK(files.run(resumed).first == 0);
  CHECK(fs::exists(files.scene + "/clip_features/000002_f.npy"));
  CHECK(fs::last_write_time(stem + "_s.npy") == written);
  write_file(files.dir / "open_clip_config.json",
             R"({"quick_gelu": true, "vision_cfg": {"width": 48, "head_width": 16}})");
  std::tie(status, said) = files.run(resumed);
  CHECK(status == 2);
  CHECK(said.find("activation was GELU and is QuickGELU") != std::string::npos);
}

TEST_CASE("make_features: sentences become rows of every object, zeros without one") {
  const SceneFiles files;
  const auto [status, said] = files.run({"--masks", files.masks, "--captions", files.captions,
                                         "--sentence-encoder", files.dir / "sentences.npy"});
  INFO(said);
  REQUIRE(status == 0);
  const NpyFile file(files.scene + "/video_features/000002_f.npy");
  CHECK(file.dtype() == Dtype::kF64);
  const auto features = file.read<2>();
  CHECK(features.shape() == (Shape{3, 3}));
  CHECK(features(0, 1) == 1);  // object 1: tilted
  CHECK(features(1, 0) == 1);  // object 2: upright
  CHECK(features(2, 0) == 0);  // object 3 has no sentence
  const auto rows = NpyFile(files.scene + "/video_features/000002_s.npy").read<3>();
  CHECK(rows.extent(0) == 1);
  CHECK(rows(0, 10, 39) == 2);
}

TEST_CASE("make_features: what does not fit is refused in one sentence") {
  const SceneFiles files;
  const auto fails = [&](const std::vector<std::string>& arguments, int expected,
                         const std::string& sentence) {
    const auto [status, said] = files.run(arguments);
    CAPTURE(said);
    CHECK(status == expected);
    CHECK(said.find(sentence) != std::string::npos);
  };
  fails({}, 2, "nothing to make");
  fails({"--captions", files.captions, "--masks", files.masks}, 2, "need each other");
  fails({"--masks", files.scene, "--image-encoder", files.dir / "clip.safetensors"}, 3,
        "holds no masks for the frames");
  fails({"--autoencoder", test_data("golden/language/autoencoder_tiny_seed1.safetensors")}, 3, "");
  CHECK(!fs::exists(files.scene + "/clip_features-language_features_dim3"));
  write_npy(files.masks + "/000002.npy", Tensor<std::int32_t, 2>(Shape{40, 30}));
  fails({"--masks", files.masks, "--image-encoder", files.dir / "clip.safetensors"}, 3,
        "is 30 x 40, but its masks");
  write_file(files.captions, "1,1,the cup is upright\n7,1,the cup is upright\n");
  fails({"--masks", files.masks, "--captions", files.captions, "--sentence-encoder",
         files.dir / "sentences.npy"},
        3, "describes frame 7, which is not in");
}

TEST_CASE("ObjectMasks: label pictures of one level and of four; 16 bits are refused") {
  const SceneFiles files;
  const Scene scene = Scene::open(files.scene);
  const std::string folder = files.dir / "pictures";
  Tensor<std::uint8_t, 3> grey(Shape{2, 3, 1}), colour(Shape{2, 3, 3});
  grey(0, 1, 0) = 200;
  colour(1, 2, 0) = 1;
  for (const char* level : {"default", "small", "middle", "large"}) {
    fs::create_directories(folder + "/" + level);
    write_png(folder + "/" + level + "/000001.png", std::as_const(grey).view());
  }
  const auto four = ObjectMasks::open(folder, scene);
  CHECK(four->read(scene.frames()[0]).shape() == (Shape{4, 2, 3}));
  CHECK(four->has(scene.frames()[0]));
  CHECK(!four->has(scene.frames()[1]));
  write_png(folder + "/large/000001.png", Tensor<std::uint8_t, 3>(Shape{3, 3, 1}));
  CHECK(outcome_of([&] { four->read(scene.frames()[0]); }).says("but " + folder));

  write_png(folder + "/000001.png", std::as_const(colour).view());
  const auto one = ObjectMasks::open(folder, scene);
  const auto labels = one->read(scene.frames()[0]);
  CHECK(labels.extent(0) == 1);
  CHECK(labels(0, 1, 2) == 65536);
  write_png(folder + "/000001.png", Tensor<std::uint16_t, 2>(Shape{2, 3}));
  CHECK(outcome_of([&] { one->read(scene.frames()[0]); }).kind == ErrorKind::kUnsupported);
}

TEST_CASE("ObjectMasks: COCO's categories are objects with one number in all frames") {
  const SceneFiles files;
  const Scene scene = Scene::open(files.scene);
  write_file(files.dir / "coco.json", R"({
      "categories": [{"id": 5, "name": "wall"}, {"id": 2, "name": "cup"}],
      "images": [{"id": 1, "file_name": "000001_png.jpg", "height": 30, "width": 40},
                 {"id": 2, "file_name": "000002_png.jpg", "height": 30, "width": 40}],
      "annotations": [
        {"image_id": 1, "category_id": 2, "segmentation": [[4, 5, 13, 5, 13, 19, 4, 19]]},
        {"image_id": 2, "category_id": 5, "segmentation": [[0, 0, 39, 0, 39, 29, 0, 29]]},
        {"image_id": 2, "category_id": 2, "segmentation": [[4, 5, 13, 5, 13, 19, 4, 19]]}]})");
  const auto masks = ObjectMasks::open(files.dir / "coco.json", scene);
  CHECK(masks->describe().find("1 cup; 2 wall") != std::string::npos);
  const auto first = masks->read(scene.frames()[0]), second = masks->read(scene.frames()[1]);
  CHECK(first.shape() == (Shape{std::int64_t{1}, kHeight, kWidth}));
  CHECK(first(0, 10, 10) == 1);
  CHECK(first(0, 0, 0) == 0);
  CHECK(second(0, 10, 10) == 1);
  CHECK(second(0, 0, 0) == 2);
}

TEST_CASE("read_captions: quotes, columns in any order, and faults by their row") {
  const TempDir dir;
  const auto read = [&](const std::string& text) {
    write_file(dir / "c.csv", text);
    return read_captions(dir / "c.csv");
  };
  const auto fault = [&](const std::string& text) { return outcome_of([&] { read(text); }); };
  const Captions captions =
      read("\xef\xbb\xbfsentence,frame,object\r\n\"a, \"\"b\"\"\nc\",3,1\r\n\r\n ,3,2\r\n");
  REQUIRE(captions.size() == 1);
  CHECK(captions.at(3).size() == 1);
  CHECK(captions.at(3).at(1) == "a, \"b\"\nc");
  CHECK(read("000012,7,words\n").at(12).at(7) == "words");
  CHECK(fault("1,1,a, b\n").says("row 1 has 4 columns"));
  CHECK(fault("1,1,a\n1,x,b\n").says("row 2 has the frame \"1\" and the object \"x\""));
  CHECK(fault("1,1,a\n1,1,b\n").says("row 2 describes object 1 of frame 1 again"));
  CHECK(fault("1,1,\"a\n").says("row 1 has a quote that is not closed"));
  CHECK(fault("frame,thing,sentence\n").says("has no column \"object\""));
  CHECK(fault("").says("holds no captions"));
}
