// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/training_set.h"

#include <doctest/doctest.h>

#include <filesystem>

#include "tests/support/files.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/tiny_scene.h"

using namespace lvggt;
namespace fs = std::filesystem;

namespace {

TrainingSetOptions options_of(const test::TinyScene& tiny) {
  TrainingSetOptions options;
  options.scenes = {tiny.path()};
  return options;
}

test::Outcome open_set(const TrainingSetOptions& options) {
  Context ctx(2);
  return test::outcome_of([&] { TrainingSet::open(options, ctx); });
}

// Opens after `change`, in both ways of checking where that makes no difference.
void check_refused(const test::TinyScene& tiny, ErrorKind kind,
                   const std::vector<std::string>& says, bool also_headers = true) {
  TrainingSetOptions options = options_of(tiny);
  for (const bool check_labels : {true, false}) {
    if (!check_labels && !also_headers) continue;
    options.check_labels = check_labels;
    const auto outcome = open_set(options);
    INFO(outcome.message);
    CHECK(outcome.kind == kind);
    for (const std::string& text : says) CHECK(outcome.says(text));
  }
}

std::string hash_of(const TrainingSetOptions& options) {
  Context ctx(1);
  return TrainingSet::open(options, ctx).manifest_sha256();
}

struct Room {
  Room(const TrainingSet& set, const Sample& s) {
    for (std::size_t i = 0; i < 4; ++i) {
      taps[i] = Tensor<float, 2>(Shape{s.h * s.w, set.channels()});
      views.taps[i] = taps[i];
    }
    const std::int64_t levels = set.supervision().levels();
    image = Tensor<float, 3>(Shape{s.H, s.W, std::int64_t{3}});
    features = Tensor<float, 4>(Shape{levels, s.H, s.W, set.supervision().dim});
    mask = Tensor<float, 3>(Shape{levels, s.H, s.W});
    views.image = image;
    views.features = features;
    views.mask = mask;
  }
  std::array<Tensor<float, 2>, 4> taps;
  Tensor<float, 3> image, mask;
  Tensor<float, 4> features;
  SampleViews views;
};

}  // namespace

TEST_CASE("training_set: frames of both parts are there with sizes, labels and targets") {
  test::TinyScene tiny(5);
  tiny.make_tokens();
  TrainingSetOptions options = options_of(tiny);
  options.split.held_out = FrameRanges::parse("4-5", "test");
  Context ctx(2);
  const TrainingSet set = TrainingSet::open(options, ctx);
  CHECK(set.samples(Part::kTrain).size() == 3);
  REQUIRE(set.samples(Part::kHeldOut).size() == 2);
  const Sample& sample = set.samples(Part::kHeldOut)[1];
  CHECK(sample.frame.name == "000005");
  CHECK(sample.h == 2);
  CHECK(sample.w == 3);
  CHECK(sample.H == 28);
  CHECK(sample.W == 42);
  CHECK(sample.labelled == 3 * 28 * 42 * 3 / 4);
  CHECK(set.channels() == 128);
  CHECK(set.warnings().empty());
  Room room(set, sample);
  set.read(room.views, sample);
  CHECK(room.taps[3](0, 5) == test::TinyScene::token(4, 3, 5));
  CHECK(room.image(1, 2, 0) == static_cast<float>(2 + 3 + 80) / 255.0f);
  CHECK(room.features(1, 0, 41, 2) == test::TinyScene::code(4, 1, 2));
  CHECK(room.mask(2, 27, 0) == 0);
}

TEST_CASE("training_set: dynamic supervision has one level of six numbers") {
  test::TinyScene tiny(2, SceneLayout::kNeu3d);
  tiny.make_tokens();
  TrainingSetOptions options = options_of(tiny);
  options.supervision = {Supervision::kDynamic, 6};
  Context ctx(1);
  const TrainingSet set = TrainingSet::open(options, ctx);
  const Sample& sample = set.samples(Part::kTrain)[1];
  CHECK(sample.frame.name == "0001");
  CHECK(sample.labelled == 28 * 42 / 2);
  Room room(set, sample);
  set.read(room.views, sample);
  CHECK(room.features.shape() == (Shape{1, 28, 42, 6}));
  CHECK(room.features(0, 0, 0, 5) == test::TinyScene::code(1, 0, 5));
  CHECK(room.mask(0, 27, 41) == 0);  // a row of zeros
}

TEST_CASE("training_set: targets have the frame's size or that of the picture, and turn with it") {
  test::TinyScene tiny(1);
  tiny.make_tokens(Dtype::kF32, {FrameMode::kCrop, 28, true});
  TrainingSetOptions options = options_of(tiny);
  Context ctx(1);
  const TrainingSet set = TrainingSet::open(options, ctx);
  CHECK(set.samples(Part::kTrain)[0].H == 28);  // 42, cropped in the middle
  CHECK(set.samples(Part::kTrain)[0].W == 28);
  options.target = TargetSize::kOriginal;
  const TrainingSet original = TrainingSet::open(options, ctx);
  const Sample& sample = original.samples(Part::kTrain)[0];
  CHECK(sample.H == 42);
  CHECK(sample.W == 28);
  CHECK(sample.h == 2);
  Room room(original, sample);
  original.read(room.views, sample);
  // The upper right corner comes to the upper left.
  CHECK(room.features(0, 0, 0, 0) == test::TinyScene::code(0, 1, 0));
  CHECK(room.mask(0, 41, 27) == 0);
  CHECK(room.image(0, 0, 0) == 41.0f / 255.0f);
  CHECK(set.manifest_sha256() != original.manifest_sha256());
}

TEST_CASE("training_set: a missing label map, feature table or picture is named with its frame") {
  test::TinyScene tiny(3);
  tiny.make_tokens();
  fs::remove(tiny.label_file(1, "f"));
  check_refused(tiny, ErrorKind::kRead, {"scene scene, frame 000002", "000002_f.npy is missing"});
  fs::remove(tiny.label_file(1, "s"));
  check_refused(tiny, ErrorKind::kRead, {"frame 000002", "000002_s.npy is missing"});
  // Frames in neither part are not looked at.
  TrainingSetOptions options = options_of(tiny);
  options.split.train = FrameRanges::parse("1,3", "test");
  CHECK(open_set(options).accepted);
}

TEST_CASE("training_set: all problems are reported together, the first five in words") {
  test::TinyScene tiny(9);
  tiny.make_tokens();
  for (int i = 0; i < 8; ++i) fs::remove(tiny.label_file(i, "s"));
  check_refused(tiny, ErrorKind::kRead,
                {"frame 000001:", "frame 000005:", "and 3 frames more have problems"});
}

TEST_CASE("B13: pictures, label maps and tokens of different sizes are refused") {
  test::TinyScene tiny(3);
  tiny.make_tokens();
  tiny.add_labels(1, {}, 28, 41);
  check_refused(tiny, ErrorKind::kMismatch,
                {"000002_s.npy", "labels 41x28 pixels", "000002.png has 42x28"});
  tiny.add_labels(1, {}, 42, 28);
  check_refused(tiny, ErrorKind::kMismatch, {"000002_s.npy", "turned by 90 degrees"});
}

TEST_CASE("C17: a picture of another size than the others is refused") {
  test::TinyScene tiny(3);
  tiny.make_tokens();
  test::TinyScene::add_picture(tiny.images() + "/000003.png", 28, 56, 0);
  check_refused(tiny, ErrorKind::kMismatch, {"000003.png", "56x28", "42x28"});
}

TEST_CASE("B11: a label without a feature is found before training, by frame, level and pixel") {
  test::TinyScene tiny(3);
  tiny.make_tokens();
  write_npy(tiny.label_file(2, "f"), Tensor<float, 2>(Shape{3, 3}));
  check_refused(tiny, ErrorKind::kFormat,
                {"frame 000003", "000003_s.npy", "row 14, column 21 of level small", "is 3"},
                false);
  TrainingSetOptions headers = options_of(tiny);
  headers.check_labels = false;
  Context ctx(1);
  const TrainingSet set = TrainingSet::open(headers, ctx);
  CHECK(set.samples(Part::kTrain)[0].labelled == -1);
  Room room(set, set.samples(Part::kTrain)[2]);
  CHECK_THROWS_AS(set.read(room.views, set.samples(Part::kTrain)[2]), Error);
}

TEST_CASE("B12: features of another width or with NaN are found before training") {
  test::TinyScene tiny(2);
  tiny.make_tokens();
  Tensor<float, 2> codes(Shape{4, 3});
  codes(1, 1) = std::nanf("");
  write_npy(tiny.label_file(1, "f"), codes);
  check_refused(tiny, ErrorKind::kNumeric, {"frame 000002", "000002_f.npy: row 1 holds nan"});
  write_npy(tiny.label_file(1, "f"), Tensor<float, 2>(Shape{4, 4}));
  check_refused(tiny, ErrorKind::kMismatch, {"frame 000002", "[4,4]"});
}

TEST_CASE("B10: a truncated label map is found before training") {
  test::TinyScene tiny(2);
  tiny.make_tokens();
  const std::string path = tiny.label_file(0, "s");
  const std::string bytes = test::read_bytes(path);
  test::write_bytes(path, bytes.substr(0, bytes.size() - 100));
  check_refused(tiny, ErrorKind::kFormat, {"frame 000001", path, "cut short"});
}

TEST_CASE("B27: an empty or damaged picture is found before training") {
  test::TinyScene tiny(2);
  tiny.make_tokens();
  const std::string path = tiny.images() + "/000002.png";
  const std::string bytes = test::read_bytes(path);
  test::write_bytes(path, "");
  check_refused(tiny, ErrorKind::kFormat, {"frame 000002", path});
  test::write_bytes(path, bytes.substr(0, bytes.size() / 2));
  check_refused(tiny, ErrorKind::kFormat, {"frame 000002", path});
}

TEST_CASE("B22: tokens of other pictures, weights, sizes or preprocessing are refused by name") {
  test::TinyScene tiny(2);
  check_refused(tiny, ErrorKind::kRead, {"lvggt_tokens/manifest.json", "make_tokens"});
  tiny.make_tokens();
  TrainingSetOptions options = options_of(tiny);
  options.config = test::tiny_config();
  options.encoder_sha256 = std::string(64, 'e');
  options.preprocess = PreprocessOptions{FrameMode::kOriginal, 518, false};
  CHECK(open_set(options).accepted);
  options.config->lang_dim = 6;  // not the encoder's
  CHECK(open_set(options).accepted);
  const auto says = [&](const TrainingSetOptions& wanted, std::string_view text) {
    const auto outcome = open_set(wanted);
    INFO(outcome.message);
    return outcome.kind == ErrorKind::kMismatch && outcome.says(text);
  };
  TrainingSetOptions other = options;
  other.config->embed_dim = 128;
  CHECK(says(other, "embed_dim is 64, not 128"));
  other = options;
  other.encoder_sha256 = std::string(64, 'f');
  CHECK(says(other, "encoder_sha256"));
  other = options;
  other.preprocess->mode = FrameMode::kCrop;
  CHECK(says(other, "mode is original, not crop"));
  // A picture that changed since, of the same size.
  test::TinyScene::add_picture(tiny.images() + "/000002.png", 28, 42, 77);
  check_refused(tiny, ErrorKind::kMismatch, {"000002.png", "not the picture"});
}

TEST_CASE("B22: a frame without tokens, or with a damaged token file, is refused") {
  test::TinyScene tiny(2);
  tiny.make_tokens();
  tiny.add_frame(2);
  check_refused(tiny, ErrorKind::kMismatch, {"frame 000003", "no tokens of frame 000003"});
  tiny.make_tokens();
  fs::resize_file(tiny.tokens() + "/000003.safetensors", 300);
  check_refused(tiny, ErrorKind::kFormat, {"frame 000003", "000003.safetensors"});
}

TEST_CASE(
    "D23: a data set without a single labelled pixel is refused; one such frame is a warning") {
  test::TinyScene tiny(3);
  tiny.make_tokens();
  Tensor<std::int8_t, 3> rows(Shape{4, 28, 42});
  std::fill_n(rows.data(), rows.size(), std::int8_t{-1});
  write_npy(tiny.label_file(1, "s"), rows);
  Context ctx(1);
  const TrainingSet set = TrainingSet::open(options_of(tiny), ctx);
  REQUIRE(set.warnings().size() == 1);
  CHECK(set.warnings()[0].find("1 frame to train on without any labelled pixel") !=
        std::string::npos);
  CHECK(set.warnings()[0].find("000002") != std::string::npos);
  CHECK(set.samples(Part::kTrain)[1].labelled == 0);
  for (const int i : {0, 2}) write_npy(tiny.label_file(i, "s"), rows);
  check_refused(tiny, ErrorKind::kMismatch, {"no frame to train on", "000001"}, false);
}

TEST_CASE("training_set: several scenes, their tokens in one folder by name") {
  test::TinyScene a(2, SceneLayout::kHyperNerf, "a"), b(3, SceneLayout::kNeu3d, "b");
  a.make_tokens();
  b.make_tokens(Dtype::kBF16);
  const test::TempDir root(test::TempDir::in_memory());
  fs::rename(a.tokens(), root / "a");
  fs::rename(b.tokens(), root / "b");
  TrainingSetOptions options;
  options.scenes = {a.path(), b.path()};
  options.tokens = root.path();
  Context ctx(2);
  const TrainingSet set = TrainingSet::open(options, ctx);
  CHECK(set.samples(Part::kTrain).size() == 5);
  CHECK(set.samples(Part::kTrain)[4].scene == 1);
  options.tokens = root / "a";
  CHECK(open_set(options).says("tokens of one scene"));
  options.tokens = root.path();
  options.scenes = {a.path(), a.path() + "/"};
  CHECK(open_set(options).says("twice"));
  options.scenes = {};
  CHECK(open_set(options).kind == ErrorKind::kUsage);
  fs::remove_all(root / "b");
  options.tokens.clear();
  options.scenes = {a.path(), b.path()};
  a.make_tokens();
  b.make_tokens(Dtype::kF32, {FrameMode::kCrop, 42, false});
  CHECK(open_set(options).says("different settings"));
}

TEST_CASE("training_set: the manifest's hash is that of the data, wherever they are") {
  test::TinyScene tiny(3), copy(3, SceneLayout::kHyperNerf, "scene");
  tiny.make_tokens();
  copy.make_tokens();
  const TrainingSetOptions options = options_of(tiny);
  const std::string hash = hash_of(options);
  CHECK(hash.size() == 64);
  CHECK(hash_of(options_of(copy)) == hash);
  TrainingSetOptions other = options;
  other.split.held_out = FrameRanges::parse("3", "test");
  CHECK(hash_of(other) != hash);
  other = options;
  other.supervision = {Supervision::kDynamic, 6};
  CHECK(hash_of(other) != hash);
  Tensor<std::int8_t, 3> rows(Shape{4, 28, 42});
  write_npy(copy.label_file(1, "s"), rows);
  CHECK(hash_of(options_of(copy)) != hash);
}
