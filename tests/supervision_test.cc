// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/supervision.h"

#include <doctest/doctest.h>

#include <cmath>

#include "lvggt/data/scene.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/tiny_scene.h"

using namespace lvggt;

namespace {

const SupervisionSpec kClip{Supervision::kClip, 3}, kDynamic{Supervision::kDynamic, 6};

struct Targets {
  Tensor<float, 4> features;
  Tensor<float, 3> mask;
};

Targets paint(const FrameLabels& labels, const SupervisionSpec& spec, const ImageTransform& t,
              std::int64_t H, std::int64_t W, bool original_size = false) {
  Targets targets{Tensor<float, 4>(Shape{spec.levels(), H, W, spec.dim}),
                  Tensor<float, 3>(Shape{spec.levels(), H, W})};
  // What was there before must not matter.
  std::fill_n(targets.features.data(), targets.features.size(), 7.0f);
  std::fill_n(targets.mask.data(), targets.mask.size(), 7.0f);
  paint_targets(targets.features, targets.mask, labels, spec, t, original_size);
  return targets;
}

// One level; row 3y + x for a picture of 2 x 3 pixels, features of the row's number.
FrameLabels numbered() {
  FrameLabels labels{Tensor<std::int32_t, 3>(Shape{3, 2, 3}), Tensor<float, 2>(Shape{6, 3})};
  for (std::int64_t i = 0; i < 18; ++i) labels.rows.data()[i] = static_cast<std::int32_t>(i % 6);
  for (std::int64_t i = 0; i < 18; ++i) labels.codes.data()[i] = static_cast<float>(1 + i / 3);
  return labels;
}

}  // namespace

TEST_CASE("supervision: names, folders and levels") {
  CHECK(parse_supervision("clip") == Supervision::kClip);
  CHECK(parse_supervision("dynamic") == Supervision::kDynamic);
  CHECK_THROWS_AS(parse_supervision("CLIP"), Error);
  CHECK(kClip.folder() == "clip_features-language_features_dim3");
  CHECK(kDynamic.folder() == "video_features-language_features_dim6");
  CHECK(kClip.levels() == 3);
  CHECK(kDynamic.levels() == 1);
}

TEST_CASE("supervision: levels 1, 2 and 3 of four are read, and the only one of the dynamic kind") {
  const test::TinyScene tiny(1);
  // Another map on each level: level l names row l everywhere.
  Tensor<float, 3> rows(Shape{4, 2, 3});
  for (std::int64_t i = 0; i < rows.size(); ++i) rows.data()[i] = static_cast<float>(i / 6);
  write_npy(tiny.label_file(0, "s"), rows);
  const FrameLabels labels = read_labels(tiny.label_file(0, "s"), tiny.label_file(0, "f"), kClip);
  CHECK(labels.rows.shape() == (Shape{3, 2, 3}));
  for (std::int64_t level = 0; level < 3; ++level) CHECK(labels.rows(level, 1, 2) == level + 1);
  CHECK(labels.codes(2, 1) == test::TinyScene::code(0, 2, 1));

  const FrameLabels dynamic =
      read_labels(tiny.label_file(0, "s", kDynamic), tiny.label_file(0, "f", kDynamic), kDynamic);
  CHECK(dynamic.rows.extent(0) == 1);
  CHECK(dynamic.rows(0, 0, 0) == 0);
  CHECK(dynamic.rows(0, 27, 0) == -1);
}

TEST_CASE("supervision: published files hold labels as float32 and features as half or double") {
  const test::TinyScene tiny(1);
  Tensor<float, 3> rows(Shape{4, 2, 2});
  rows(1, 0, 0) = -1;
  rows(3, 1, 1) = 3;
  write_npy(tiny.label_file(0, "s"), rows);
  Tensor<double, 2> codes(Shape{4, 3});
  codes(3, 2) = 0.5;
  write_npy(tiny.label_file(0, "f"), codes);
  const FrameLabels labels = read_labels(tiny.label_file(0, "s"), tiny.label_file(0, "f"), kClip);
  CHECK(labels.rows(0, 0, 0) == -1);
  CHECK(labels.rows(2, 1, 1) == 3);
  CHECK(labels.codes(3, 2) == 0.5f);
}

TEST_CASE("B11: labels beyond the features, below -1 or no whole numbers are refused by place") {
  const test::TinyScene tiny(1);
  const auto outcome_with = [&](float label) {
    Tensor<float, 3> rows(Shape{4, 5, 6});
    rows(2, 3, 4) = label;
    write_npy(tiny.label_file(0, "s"), rows);
    return test::outcome_of(
        [&] { read_labels(tiny.label_file(0, "s"), tiny.label_file(0, "f"), kClip); });
  };
  for (const float label : {4.0f, -2.0f, 1e9f, -1e9f}) {
    const auto outcome = outcome_with(label);
    INFO(outcome.message);
    CHECK(outcome.kind == ErrorKind::kFormat);
    CHECK(outcome.says("000001_s.npy"));
    CHECK(outcome.says("row 3, column 4 of level middle"));
  }
  CHECK(outcome_with(4).says("has 4 rows"));
  CHECK_FALSE(outcome_with(0.5f).accepted);
  CHECK_FALSE(outcome_with(std::nanf("")).accepted);
  CHECK(outcome_with(3).accepted);
}

TEST_CASE("B11: a map without any label is fine, and counted as such") {
  const test::TinyScene tiny(1);
  Tensor<std::int8_t, 3> rows(Shape{4, 5, 6});
  std::fill_n(rows.data(), rows.size(), std::int8_t{-1});
  write_npy(tiny.label_file(0, "s"), rows);
  const FrameLabels labels = read_labels(tiny.label_file(0, "s"), tiny.label_file(0, "f"), kClip);
  CHECK(num_labelled(labels, kClip) == 0);
}

TEST_CASE("B12: features of another width or with NaN are refused") {
  const test::TinyScene tiny(1);
  const auto outcome_with = [&](const Tensor<float, 2>& codes) {
    write_npy(tiny.label_file(0, "f"), codes);
    return test::outcome_of(
        [&] { read_labels(tiny.label_file(0, "s"), tiny.label_file(0, "f"), kClip); });
  };
  const auto raw = outcome_with(Tensor<float, 2>(Shape{4, 512}));
  CHECK(raw.kind == ErrorKind::kMismatch);
  CHECK(raw.says("[4,512]"));
  CHECK(raw.says("autoencoder"));
  CHECK(outcome_with(Tensor<float, 2>(Shape{4, 6})).says("features of 3 numbers"));
  Tensor<float, 2> codes(Shape{4, 3});
  codes(2, 1) = std::nanf("");
  const auto nan = outcome_with(codes);
  CHECK(nan.kind == ErrorKind::kNumeric);
  CHECK(nan.says("000001_f.npy"));
  CHECK(nan.says("row 2"));
  codes(2, 1) = HUGE_VALF;
  CHECK(outcome_with(codes).kind == ErrorKind::kNumeric);
}

TEST_CASE("supervision: a label map with other levels is refused with its shape") {
  const test::TinyScene tiny(1);
  const auto outcome = test::outcome_of([&] {
    check_labels(tiny.label_file(0, "s", kDynamic), tiny.label_file(0, "f", kClip), kClip);
  });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("[1,28,42]"));
  CHECK(outcome.says("[4,H,W]"));
  const LabelHeader header = check_labels(tiny.label_file(0, "s"), tiny.label_file(0, "f"), kClip);
  CHECK(header.H == 28);
  CHECK(header.W == 42);
  CHECK(header.num_codes == 4);
}

TEST_CASE("paint_targets: unlabelled pixels are zero in features and mask") {
  const test::TinyScene tiny(1);
  const FrameLabels labels = read_labels(tiny.label_file(0, "s"), tiny.label_file(0, "f"), kClip);
  const Targets t = paint(labels, kClip, plan_frame(42, 28, {FrameMode::kOriginal}), 28, 42);
  for (std::int64_t level = 0; level < 3; ++level) {
    CHECK(t.mask(level, 0, 0) == 1);
    CHECK(t.features(level, 0, 41, 2) == test::TinyScene::code(0, 1, 2));
    CHECK(t.mask(level, 27, 0) == 0);
    CHECK(t.features(level, 27, 0, 1) == 0);
    CHECK(t.features(level, 27, 41, 0) == test::TinyScene::code(0, 3, 0));
  }
  CHECK(num_labelled(labels, kClip) == 3 * 28 * 42 * 3 / 4);
}

TEST_CASE("paint_targets: all-zero dynamic features belong to no sentence and are unlabelled") {
  const test::TinyScene tiny(1);
  const FrameLabels labels =
      read_labels(tiny.label_file(0, "s", kDynamic), tiny.label_file(0, "f", kDynamic), kDynamic);
  const Targets t = paint(labels, kDynamic, plan_frame(42, 28, {FrameMode::kOriginal}), 28, 42);
  CHECK(t.mask(0, 0, 0) == 1);
  CHECK(t.mask(0, 27, 41) == 0);
  CHECK(num_labelled(labels, kDynamic) == 28 * 42 / 2);
}

TEST_CASE("paint_targets: labels follow the crop, resize, padding and turn of the picture") {
  const FrameLabels labels = numbered();
  ImageTransform t;
  t.original_width = 3;
  t.original_height = 2;
  // Twice as large, the middle cut out by one pixel on each side, as "crop" does.
  t.scale_x = t.scale_y = 2;
  t.offset_x = -1;
  t.offset_y = -1;
  Targets cropped = paint(labels, kClip, t, 2, 4);
  const float expected_cropped[2][4] = {{1, 2, 2, 3}, {4, 5, 5, 6}};
  for (std::int64_t y = 0; y < 2; ++y)
    for (std::int64_t x = 0; x < 4; ++x)
      CHECK(cropped.features(2, y, x, 0) == expected_cropped[y][x]);
  // Padded by one row above and below.
  t.scale_x = t.scale_y = 1;
  t.offset_x = 0;
  t.offset_y = 1;
  Targets padded = paint(labels, kClip, t, 4, 3);
  for (std::int64_t x = 0; x < 3; ++x) {
    CHECK(padded.mask(0, 0, x) == 0);
    CHECK(padded.mask(0, 1, x) == 1);
    CHECK(padded.features(0, 2, x, 1) == static_cast<float>(4 + x));
    CHECK(padded.mask(0, 3, x) == 0);
  }
  // 1 2 3      3 6
  // 4 5 6  ->  2 5   counter-clockwise.
  //            1 4
  t.offset_y = 0;
  t.quarter_turns_ccw = 1;
  const float turned[3][2] = {{3, 6}, {2, 5}, {1, 4}};
  for (const bool original : {false, true}) {
    Targets result = paint(labels, kClip, t, 3, 2, original);
    for (std::int64_t y = 0; y < 3; ++y)
      for (std::int64_t x = 0; x < 2; ++x) CHECK(result.features(1, y, x, 2) == turned[y][x]);
  }
}

TEST_CASE("paint_targets: shrinking takes the pixel in the middle, as the picture's rows move") {
  // Six columns to two: centres at 1.5 and 4.5 of the original's edges.
  FrameLabels labels{Tensor<std::int32_t, 3>(Shape{3, 1, 6}), Tensor<float, 2>(Shape{6, 3})};
  for (std::int64_t i = 0; i < 18; ++i) labels.rows.data()[i] = static_cast<std::int32_t>(i % 6);
  for (std::int64_t i = 0; i < 18; ++i) labels.codes.data()[i] = static_cast<float>(1 + i / 3);
  ImageTransform t;
  t.scale_x = 2.0 / 6;
  const Targets result = paint(labels, kClip, t, 1, 2);
  CHECK(result.features(0, 0, 0, 0) == 2);
  CHECK(result.features(0, 0, 1, 0) == 5);
}

TEST_CASE("supervision: a real labelled frame is read as its makers describe it") {
  const Scene scene = Scene::open(lvggt::test::test_data("golden/scene"));
  REQUIRE(scene.frames().size() == 1);
  for (const SupervisionSpec& spec : {kClip, kDynamic}) {
    const auto [rows, codes] = scene.label_files(scene.frames()[0], spec);
    const FrameLabels labels = read_labels(rows, codes, spec);
    CHECK(labels.rows.shape() == (Shape{spec.levels(), 180, 240}));
    CHECK(labels.codes.shape() == (Shape{3, spec.dim}));
    CHECK(labels.rows(0, 90, 120) == 0);  // the bottle is in the middle
    CHECK(labels.rows(0, 0, 0) == 2);     // before a wall
    CHECK(num_labelled(labels, spec) == spec.levels() * (180 * 240 - 552));  // all but its rim
    // At half the size, every second pixel's label.
    const ImageTransform t = plan_frame(240, 180, {FrameMode::kCrop, 126, false});
    const Targets targets = paint(labels, spec, t, t.height, t.width);
    CHECK(targets.features(0, t.height / 2, t.width / 2, 0) == labels.codes(0, 0));
    CHECK(targets.mask(0, 0, 0) == 1);
  }
}
