// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/scene.h"

#include <doctest/doctest.h>

#include <filesystem>

#include "tests/support/files.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/tiny_scene.h"

using namespace lvggt;
namespace fs = std::filesystem;

namespace {

test::Outcome open_scene(const std::string& path) {
  test::Outcome outcome = test::outcome_of([&] { Scene::open(path); });
  INFO(outcome.message);
  return outcome;
}

}  // namespace

TEST_CASE("scene: the HyperNeRF layout is read in the order of frame numbers") {
  const test::TinyScene tiny(11);
  const Scene scene = Scene::open(tiny.path() + "/");
  CHECK(scene.layout() == SceneLayout::kHyperNerf);
  CHECK(scene.name() == "scene");
  REQUIRE(scene.frames().size() == 11);
  CHECK(scene.frames()[0].number == 1);
  CHECK(scene.frames()[10].number == 11);
  CHECK(scene.frames()[10].name == "000011");
  CHECK(scene.warnings().empty());
  const auto [rows, codes] = scene.label_files(scene.frames()[1], {Supervision::kDynamic, 6});
  CHECK(rows == tiny.path() + "/video_features-language_features_dim6/000002_s.npy");
  CHECK(codes == tiny.path() + "/video_features-language_features_dim6/000002_f.npy");
}

TEST_CASE("scene: the Neu3D layout is read with both spellings of its feature files") {
  const test::TinyScene tiny(2, SceneLayout::kNeu3d);
  const Scene scene = Scene::open(tiny.path());
  CHECK(scene.layout() == SceneLayout::kNeu3d);
  CHECK(scene.frames()[0].number == 0);
  CHECK(scene.label_files(scene.frames()[1], {}).first == tiny.label_file(1, "s"));
  fs::create_directories(tiny / "cam00/clip_features-language_features_dim3");
  for (const char* which : {"s", "f"})
    fs::rename(tiny.label_file(1, which),
               tiny / "cam00/clip_features-language_features_dim3/0001_" + which + ".npy");
  CHECK(scene.label_files(scene.frames()[1], {}).first ==
        tiny / "cam00/clip_features-language_features_dim3/0001_s.npy");
  fs::remove_all(tiny / "cam00/clip_features-language_features_dim3");
  const auto missing = test::outcome_of([&] { scene.label_files(scene.frames()[1], {}); });
  CHECK(missing.kind == ErrorKind::kRead);
  CHECK(missing.says("cam00/clip_features-language_features_dim3/0001_s.npy"));
  CHECK(missing.says("clip_features-language_features_dim3/cam00-0001_s.npy"));
}

TEST_CASE("scene: one of a frame's two files without the other is said") {
  const test::TinyScene tiny(1);
  const Scene scene = Scene::open(tiny.path());
  fs::remove(tiny.label_file(0, "f"));
  const auto outcome = test::outcome_of([&] { scene.label_files(scene.frames()[0], {}); });
  CHECK(outcome.kind == ErrorKind::kRead);
  CHECK(outcome.says("000001_f.npy is missing"));
}

TEST_CASE("scene: folders that are no scene are refused with what was looked for") {
  const test::TempDir dir;
  CHECK(open_scene(dir / "nothing").kind == ErrorKind::kRead);
  CHECK(open_scene(dir.path()).says("rgb/2x"));
  CHECK(open_scene(dir.path()).kind == ErrorKind::kFormat);
  fs::create_directories(dir / "rgb/2x");
  CHECK(open_scene(dir.path()).says("no PNG or JPEG"));
  CHECK(Scene::is_scene(dir.path()));
  fs::create_directories(dir / "cam00/images");
  CHECK(open_scene(dir.path()).says("both"));
  test::write_bytes(dir / "file", "x");
  CHECK_FALSE(open_scene(dir / "file").accepted);
}

TEST_CASE(
    "B27: gaps are a warning; hidden and foreign files are no frames; extensions in any case") {
  const test::TinyScene tiny(3);
  fs::rename(tiny.images() + "/000003.png", tiny.images() + "/000007.PNG");
  test::write_bytes(tiny.images() + "/.DS_Store", "x");
  test::write_bytes(tiny.images() + "/._000004.png", "x");
  test::write_bytes(tiny.images() + "/notes.txt", "x");
  fs::create_directory(tiny.images() + "/000005.png");
  const Scene scene = Scene::open(tiny.path());
  REQUIRE(scene.frames().size() == 3);
  CHECK(scene.frames()[2].number == 7);
  CHECK(scene.frames()[2].name == "000007");
  REQUIRE(scene.warnings().size() == 1);
  CHECK(scene.warnings()[0].find("4 frame numbers are missing") != std::string::npos);
  CHECK(scene.warnings()[0].find("such as 3") != std::string::npos);
}

TEST_CASE("B27: two pictures of one number and names without a number are refused") {
  const test::TinyScene tiny(2);
  fs::copy(tiny.images() + "/000001.png", tiny.images() + "/1.png");
  CHECK(open_scene(tiny.path()).says("are both frame 1"));
  fs::remove(tiny.images() + "/1.png");
  for (const char* name : {"cover.png", "000003b.png", "-3.png", "99999999999999999999.png"}) {
    fs::copy(tiny.images() + "/000001.png", tiny.images() + "/" + name);
    const auto outcome = open_scene(tiny.path());
    CHECK(outcome.kind == ErrorKind::kFormat);
    CHECK(outcome.says(name));
    fs::remove(tiny.images() + "/" + name);
  }
}

TEST_CASE("scene: list files name folders, relative to the list") {
  const test::TempDir dir;
  test::write_bytes(dir / "scenes.txt", "# two scenes\r\na\r\n\n/abs/b c  \n");
  CHECK(read_list_file(dir / "scenes.txt") == std::vector<std::string>{dir / "a", "/abs/b c"});
  const auto says = [&](const std::string& text, std::string_view message) {
    test::write_bytes(dir / "list", text);
    return test::outcome_of([&] { read_list_file(dir / "list"); }).says(message);
  };
  CHECK(says("a\nb\na\n", "twice"));
  CHECK(says("# nothing\n", "names nothing"));
  CHECK(says("", "names nothing"));
  CHECK(says(std::string("a\0b", 3), "zero byte"));
  CHECK(test::outcome_of([&] { read_list_file(dir / "none"); }).kind == ErrorKind::kRead);
}
