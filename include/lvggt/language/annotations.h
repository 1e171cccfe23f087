// SPDX-License-Identifier: Apache-2.0
// The truth that queries are scored against: masks in COCO form and the intervals in which a state
// holds.
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/data/scene.h"
#include "lvggt/io/limits.h"
#include "lvggt/language/time_series.h"

namespace lvggt {

using Polygon = std::vector<std::array<double, 2>>;  // x, y in pixels

// COCO's run-length code of a mask: runs of 0 and 1 in turn, the first of 0, down the columns.
struct RunLengths {
  std::int64_t height = 0, width = 0;
  std::vector<std::int64_t> runs;
};

// Decodes the text form of such runs: six bits a character from '0' on, the sixth one saying that
// another follows, from the fourth run on as the difference to the run before the last. Errors:
// kFormat, with `place`.
std::vector<std::int64_t> parse_run_lengths(const std::string& text, const std::string& place);

// mask = 1 where the runs say so; other pixels stay.   mask: [height, width]
// Errors: kMismatch when the runs are of another size or do not add up to it.
void paint_runs(View<std::uint8_t, 2> mask, const RunLengths& code);

// One annotated object: polygons, or runs (crowds).
struct ObjectMask {
  std::vector<Polygon> polygons;
  std::vector<RunLengths> runs;
};

// All that is annotated in one picture.
struct AnnotatedImage {
  std::string file_name;
  std::int64_t frame = 0;  // index from 0
  std::int64_t height = 0, width = 0;
  std::vector<std::pair<std::string, std::vector<ObjectMask>>> labels;  // in order of appearance

  // The objects of a label, or null.
  const std::vector<ObjectMask>* find(const std::string& label) const;
};

// Which polygons of an object count.
enum class PolygonRule {
  kFirst,  // the first, as in the published evaluation
  kAll,    // all of them, joined
};

// The joined masks of a label in a picture: 1 inside.   mask: [height, width], overwritten
void paint_label(View<std::uint8_t, 2> mask, const std::vector<ObjectMask>& objects,
                 PolygonRule rule);

// A frame's index from 0: the number that its picture's name starts with, less 1 in the HyperNeRF
// layout. Errors: kFormat for a name without such a number, or 0 in the HyperNeRF layout.
std::int64_t annotated_frame(const std::string& file_name, SceneLayout layout);

struct AnnotationOptions {
  SceneLayout layout = SceneLayout::kHyperNerf;
  // Pictures are looked for beside the file and an error if missing; else only named.
  bool check_images = true;
};

// Reads _annotations.coco.json; the pictures come by ascending frame. Errors: what Json::read
// throws; kFormat or kMismatch naming the entry for: a category, picture or annotation that is
// malformed; a category or picture twice; an annotation of a category or picture that is not
// listed; a polygon with an odd number of coordinates, fewer than one point, or wholly outside of
// its picture; runs that do not fit; two pictures of one frame; a listed picture that is missing
// (kRead).
std::vector<AnnotatedImage> read_coco_annotations(const std::string& path,
                                                  const AnnotationOptions& options);

// When one state of an object holds.
struct StateAnnotation {
  std::string object, sentence;
  std::vector<FrameInterval> intervals;  // at least one, ascending, inclusive
};

// Reads video_annotations.json: {object: {sentence: [[first, last], ...]}}. Errors: what Json::read
// throws; kFormat naming object and sentence for a sentence without intervals, an interval that is
// not two whole numbers from 0, ends before it begins, or overlaps another; a sentence twice.
std::vector<StateAnnotation> read_video_annotations(const std::string& path);

// Both files of a scene; a missing video_annotations.json is no states.
struct SceneAnnotations {
  std::string coco_path, video_path;
  std::vector<AnnotatedImage> images;
  std::vector<StateAnnotation> states;

  // All labels in order of first appearance.
  std::vector<std::string> labels() const;
};

// From <scene>/annotations/train/_annotations.coco.json (or the same without train/) and
// <scene>/annotations/video_annotations.json. Errors: as above; kRead when there is no COCO file;
// kMismatch for a state of an object that no picture annotates.
SceneAnnotations read_scene_annotations(const std::string& scene, const AnnotationOptions& options);

}  // namespace lvggt
