// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/annotations.h"

#include <doctest/doctest.h>

#include <filesystem>
#include <numeric>

#include "lvggt/language/metrics.h"
#include "lvggt/language/polygon.h"
#include "tests/support/files.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// A small valid file, with places where tests put something else.
std::string coco(const std::string& annotations = R"([{"id": 1, "image_id": 0, "category_id": 1,
    "segmentation": [[1, 1, 4, 1, 4, 4, 1, 4], [6, 6, 7, 6, 7, 7]]}])",
                 const std::string& categories = R"([{"id": 1, "name": "cup"},
    {"id": 2, "name": "hand"}])",
                 const std::string& images = R"([{"id": 0, "file_name": "000003_png.jpg",
    "height": 8, "width": 10}])") {
  return "{\"images\": " + images + ", \"categories\": " + categories +
         ", \"annotations\": " + annotations + "}";
}

std::vector<AnnotatedImage> read(const std::string& text) {
  const TempDir dir;
  write_bytes(dir / "a.json", text);
  return read_coco_annotations(dir / "a.json", {.check_images = false});
}

std::int64_t count(const Tensor<std::uint8_t, 2>& mask) {
  return std::accumulate(mask.data(), mask.data() + mask.size(), std::int64_t{0});
}

Tensor<std::uint8_t, 2> label_mask(const AnnotatedImage& image, const std::string& label,
                                   PolygonRule rule) {
  Tensor<std::uint8_t, 2> mask(Shape{image.height, image.width});
  paint_label(mask, *image.find(label), rule);
  return mask;
}

#define CHECK_REFUSED(expression, words) \
  CHECK_THROWS_WITH_AS(expression, doctest::Contains(words), Error)

}  // namespace

TEST_CASE("fill_polygon: a square with its outline, points outside, one point, nothing") {
  Tensor<std::uint8_t, 2> mask(Shape{6, 6});
  fill_polygon(mask, Polygon{{1.9, 1.2}, {3.9, 1}, {3, 3}, {1, 3}});
  CHECK(count(mask) == 9);
  fill_polygon(mask, Polygon{});
  CHECK(count(mask) == 9);
  fill_polygon(mask, Polygon{{5, 5}});
  CHECK(count(mask) == 10);
  fill_polygon(mask, Polygon{{-5, -5}, {20, -5}, {20, 20}, {-5, 20}});
  CHECK(count(mask) == 36);
  CHECK_REFUSED(fill_polygon(mask, Polygon{{1e9, 0}}), "is not within");
}

TEST_CASE("annotations: the first polygon of an object counts, or all, and objects are joined") {
  const auto images = read(coco());
  REQUIRE(images.size() == 1);
  CHECK(images[0].frame == 2);
  CHECK(images[0].find("hand") == nullptr);
  CHECK(count(label_mask(images[0], "cup", PolygonRule::kFirst)) == 16);
  CHECK(count(label_mask(images[0], "cup", PolygonRule::kAll)) == 19);
  const auto joined = read(coco(R"([
    {"id": 1, "image_id": 0, "category_id": 1, "segmentation": [[1, 1, 2, 1, 2, 2, 1, 2]]},
    {"id": 2, "image_id": 0, "category_id": 1, "segmentation": [[2, 2, 3, 2, 3, 3, 2, 3]]}])"));
  CHECK(count(label_mask(joined[0], "cup", PolygonRule::kFirst)) == 7);
}

TEST_CASE("B25 annotations: crowd masks in runs, as numbers and as text; wrong lengths refused") {
  // 8 x 10, down the columns: pixels 3 .. 5 and 16 .. 17.
  const auto images = read(coco(R"([{"id": 1, "image_id": 0, "category_id": 1, "iscrowd": 1,
    "segmentation": {"size": [8, 10], "counts": [3, 3, 10, 2, 62]}}])"));
  const Tensor<std::uint8_t, 2> mask = label_mask(images[0], "cup", PolygonRule::kFirst);
  CHECK(count(mask) == 5);
  CHECK(mask(3, 0) == 1);
  CHECK(mask(5, 0) == 1);
  CHECK(mask(0, 2) == 1);
  CHECK(mask(1, 2) == 1);
  // From the fourth on as differences to the run before the last: 3, 3, 10, -1, 52.
  CHECK(parse_run_lengths("33:Od1", "x") == std::vector<std::int64_t>{3, 3, 10, 2, 62});
  CHECK_REFUSED(parse_run_lengths("3d", "x"), "breaks off");
  CHECK_REFUSED(read(coco(R"([{"id": 1, "image_id": 0, "category_id": 1,
    "segmentation": {"size": [8, 10], "counts": [3, 3]}}])")),
                "the runs add up to 6 pixels, not 10 x 8");
  CHECK_REFUSED(read(coco(R"([{"id": 1, "image_id": 0, "category_id": 1,
    "segmentation": {"size": [10, 8], "counts": [80]}}])")),
                "the mask is 8 x 10 but the picture 000003_png.jpg is 10 x 8");
}

TEST_CASE("B25 annotations: a polygon of one or two points is its outline, a point or a line") {
  const auto pixels = [](const std::string& polygon) {
    const auto images = read(coco(R"([{"id": 1, "image_id": 0, "category_id": 1,
        "segmentation": [)" + polygon +
                                  "]}]"));
    return count(label_mask(images.at(0), "cup", PolygonRule::kFirst));
  };
  CHECK(pixels("[1, 1, 4, 1]") == 4);
  CHECK(pixels("[2, 1, 2, 6]") == 6);
  CHECK(pixels("[2, 1, 2, 1]") == 1);
  CHECK(pixels("[2, 1]") == 1);
  CHECK(pixels("[-3, 1, 1, 1]") == 2);  // partly outside
}

TEST_CASE("B25 annotations: malformed ones are refused by place") {
  const auto object = [](const std::string& segmentation) {
    return coco(R"([{"id": 1, "image_id": 0, "category_id": 1, "segmentation": )" + segmentation +
                "}]");
  };
  CHECK_REFUSED(read(object("[[1, 2, 3]]")),
                "annotations[0]: segmentation: a polygon has 3 coordinates");
  CHECK_REFUSED(read(object("[[]]")), "a polygon has 0 coordinates");
  CHECK_REFUSED(read(object("[]")), "there is no polygon");
  CHECK_REFUSED(read(object("[[20, 1, 30, 1, 30, 5]]")), "lies outside of the 10 x 8 picture");
  CHECK_REFUSED(read(object("[[NaN, 1, 3, 1, 3, 5]]")), "a.json");
  CHECK_REFUSED(read(object("[[1, 1e999, 3, 1, 3, 5]]")), "a.json");
  CHECK_REFUSED(read(object("[[1, null, 3, 1, 3, 5]]")), "a.json");
  CHECK_REFUSED(read(object("[[1e300, 1, 3, 1, 3, 5]]")), "lies far outside");
  CHECK_REFUSED(read(coco(R"([{"id": 1, "image_id": 7, "category_id": 1, "segmentation": []}])")),
                "the image_id 7 is no picture");
  CHECK_REFUSED(read(coco(R"([{"id": 1, "image_id": 0, "category_id": 9, "segmentation": []}])")),
                "the category_id 9 is no category");
  CHECK_REFUSED(read(coco("[]", R"([{"id": 1, "name": "cup"}, {"id": 2, "name": "cup"}])")),
                "the category \"cup\" is there twice");
  CHECK_REFUSED(read(coco("[]", R"([{"id": 1, "name": "cup"}, {"id": 1, "name": "b"}])")),
                "the id 1 is there twice");
  CHECK_REFUSED(read(coco("[]", "[]", R"([{"id": 0, "file_name": "3_a.jpg", "height": 8,
    "width": 10}, {"id": 1, "file_name": "0003_b.jpg", "height": 8, "width": 10}])")),
                "are pictures of one frame");
  CHECK_REFUSED(read(coco("[]", "[]", R"([{"id": 0, "file_name": "x.jpg", "height": 8,
    "width": 10}])")),
                "does not start with a frame number");
}

TEST_CASE("B25 annotations: a listed picture that is not there is an error that names it") {
  const TempDir dir;
  write_bytes(dir / "a.json", coco());
  CHECK_REFUSED(read_coco_annotations(dir / "a.json", {}), "000003_png.jpg: there is no such");
  write_bytes(dir / "000003_png.jpg", "x");
  CHECK(read_coco_annotations(dir / "a.json", {}).size() == 1);
}

TEST_CASE("annotations: frames are counted from 1 in HyperNeRF's names and from 0 in Neu3D's") {
  CHECK(annotated_frame("000017_png.rf.12.jpg", SceneLayout::kHyperNerf) == 16);
  CHECK(annotated_frame("0000_png.jpg", SceneLayout::kNeu3d) == 0);
  CHECK_REFUSED(annotated_frame("000000_png.jpg", SceneLayout::kHyperNerf), "counts from 1");
  CHECK_REFUSED(annotated_frame("17a.jpg", SceneLayout::kHyperNerf), "does not start with");
}

TEST_CASE("video annotations: intervals are whole, in order and apart") {
  const TempDir dir;
  const auto states = [&](const std::string& text) {
    write_bytes(dir / "v.json", text);
    return read_video_annotations(dir / "v.json");
  };
  const auto read = states(R"({"cup": {"full": [[4, 9], [0, 3]], "empty": [[10, 10]]}})");
  REQUIRE(read.size() == 2);
  CHECK(read[0].sentence == "full");
  CHECK(read[0].intervals[0] == FrameInterval(0, 3));
  CHECK_REFUSED(states(R"({"cup": {"full": []}})"), "cup: \"full\": there is no interval");
  CHECK_REFUSED(states(R"({"cup": {"full": [[5, 4]]}})"), "[5, 4] is empty");
  CHECK_REFUSED(states(R"({"cup": {"full": [[-1, 4]]}})"), "starts before frame 0");
  CHECK_REFUSED(states(R"({"cup": {"full": [[1, 4], [4, 6]]}})"), "overlap");
  CHECK_REFUSED(states(R"({"cup": {"full": [[1, 2, 3]]}})"), "has 3 entries");
  CHECK_REFUSED(states(R"({"cup": {"full": [[0.5, 2]]}})"), "full");
  CHECK_REFUSED(states(R"({"a": {"full": [[0, 1]]}, "b": {"full": [[0, 1]]}})"),
                "for another object too");
}

TEST_CASE("scene annotations: states belong to objects that pictures annotate") {
  const TempDir dir;
  std::filesystem::create_directories(dir / "annotations/train");
  CHECK_REFUSED(read_scene_annotations(dir.path(), {}), "there is no annotations/train");
  write_bytes(dir / "annotations/train/_annotations.coco.json", coco());
  const AnnotationOptions options{.check_images = false};
  CHECK(read_scene_annotations(dir.path(), options).states.empty());
  write_bytes(dir / "annotations/video_annotations.json", R"({"cup": {"full": [[0, 1]]}})");
  const SceneAnnotations scene = read_scene_annotations(dir.path(), options);
  CHECK(scene.states.size() == 1);
  CHECK(scene.labels() == std::vector<std::string>{"cup"});
  write_bytes(dir / "annotations/video_annotations.json", R"({"hat": {"on": [[0, 1]]}})");
  CHECK_REFUSED(read_scene_annotations(dir.path(), options), "\"hat\" is annotated in no picture");
}

TEST_CASE("metrics: means over frames, then over phrases, agree with pixels counted in sets") {
  // Masks of intervals on a line: [a, b) against [c, d) of 10 pixels.
  const auto line = [](std::int64_t begin, std::int64_t end) {
    Tensor<std::uint8_t, 2> mask(Shape{1, 10});
    for (std::int64_t x = begin; x < end; ++x) mask(0, x) = 1;
    return mask;
  };
  struct Case {
    std::int64_t a, b, c, d;
    double iou, accuracy;
  };
  for (const Case& k : {Case{0, 4, 2, 6, 2.0 / 6, 0.6}, Case{0, 0, 0, 0, 1, 1},
                        Case{0, 0, 3, 4, 0, 0.9}, Case{0, 10, 0, 10, 1, 1}}) {
    CHECK(mask_iou(line(k.a, k.b), line(k.c, k.d)) == doctest::Approx(k.iou));
    CHECK(pixel_accuracy(line(k.a, k.b), line(k.c, k.d)) == doctest::Approx(k.accuracy));
  }
  const std::vector<PhraseScore> phrases{{"a", {{0, 1, 1}, {1, 0.5, 0.9}}},
                                         {"b", {{0, 0.25, 0.8}}}};
  CHECK(mean_score(phrases).iou == doctest::Approx((0.75 + 0.25) / 2));
  CHECK(mean_score(phrases).accuracy == doctest::Approx((0.95 + 0.8) / 2));
  CHECK(mean_score({}).iou == 0);
}

TEST_CASE("metrics: of a state over time, also when nothing is positive") {
  const std::vector<std::uint8_t> truth{1, 1, 0, 0}, called{1, 0, 1, 0}, none(4, 0);
  const std::vector<float> iou{0.5F, 0.9F, 0.9F, 0.9F};
  const StateScore score = score_state(truth, called, iou);
  CHECK(score.accuracy == doctest::Approx(0.5));
  CHECK(score.viou == doctest::Approx(0.5 / 3));
  CHECK(score.precision == doctest::Approx(0.5));
  CHECK(score.recall == doctest::Approx(0.5));
  CHECK(score_state(none, none, iou).viou == 0);
  CHECK(score_state(none, none, iou).accuracy == 1);
  CHECK(score_state({}, {}, {}).accuracy == 0);
}
