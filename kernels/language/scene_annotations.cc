// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <filesystem>
#include <set>

#include "lvggt/io/json.h"
#include "lvggt/language/annotations.h"

namespace lvggt {
namespace {

std::vector<FrameInterval> read_intervals(const Json& json, const std::string& place) {
  std::vector<FrameInterval> intervals;
  for (const Json& pair : json.as_array(place)) {
    const Json::Array& ends = pair.as_array(place + ": an interval");
    if (ends.size() != 2)
      fail(ErrorKind::kFormat, place, ": an interval has ", ends.size(),
           " entries, not its first and last frame");
    const FrameInterval interval(ends[0].as_int64(place), ends[1].as_int64(place));
    if (interval.first < 0 || interval.second < interval.first)
      fail(ErrorKind::kFormat, place, ": the interval [", interval.first, ", ", interval.second,
           "] is empty or starts before frame 0");
    intervals.push_back(interval);
  }
  if (intervals.empty()) fail(ErrorKind::kFormat, place, ": there is no interval");
  std::sort(intervals.begin(), intervals.end());
  for (std::size_t i = 1; i < intervals.size(); ++i)
    if (intervals[i].first <= intervals[i - 1].second)
      fail(ErrorKind::kFormat, place, ": the intervals [", intervals[i - 1].first, ", ",
           intervals[i - 1].second, "] and [", intervals[i].first, ", ", intervals[i].second,
           "] overlap");
  return intervals;
}

}  // namespace

std::vector<StateAnnotation> read_video_annotations(const std::string& path) {
  const Json root = Json::read(path);
  std::vector<StateAnnotation> states;
  std::set<std::string> sentences;
  for (const auto& [object, list] : root.as_object(path)) {
    for (const auto& [sentence, intervals] : list.as_object(concat(path, ": ", object))) {
      const std::string place = concat(path, ": ", object, ": \"", sentence, "\"");
      if (!sentences.insert(sentence).second)
        fail(ErrorKind::kFormat, place, ": the sentence is there for another object too");
      states.push_back({object, sentence, read_intervals(intervals, place)});
    }
  }
  return states;
}

std::vector<std::string> SceneAnnotations::labels() const {
  std::vector<std::string> all;
  for (const AnnotatedImage& image : images)
    for (const auto& [label, objects] : image.labels)
      if (std::find(all.begin(), all.end(), label) == all.end()) all.push_back(label);
  return all;
}

SceneAnnotations read_scene_annotations(const std::string& scene,
                                        const AnnotationOptions& options) {
  namespace fs = std::filesystem;
  SceneAnnotations annotations;
  std::error_code error;
  const std::string folder = scene + "/annotations";
  annotations.coco_path = folder + "/train/_annotations.coco.json";
  if (!fs::exists(annotations.coco_path, error)) {
    annotations.coco_path = folder + "/_annotations.coco.json";
    if (!fs::exists(annotations.coco_path, error))
      fail(ErrorKind::kRead, scene, ": there is no annotations/train/_annotations.coco.json");
  }
  annotations.images = read_coco_annotations(annotations.coco_path, options);
  annotations.video_path = folder + "/video_annotations.json";
  if (!fs::exists(annotations.video_path, error)) {
    annotations.video_path.clear();
    return annotations;
  }
  annotations.states = read_video_annotations(annotations.video_path);
  const std::vector<std::string> labels = annotations.labels();
  for (const StateAnnotation& state : annotations.states)
    LVGGT_CHECK(std::find(labels.begin(), labels.end(), state.object) != labels.end(),
                annotations.video_path, ": the object \"", state.object,
                "\" is annotated in no picture of ", annotations.coco_path);
  return annotations;
}

}  // namespace lvggt
