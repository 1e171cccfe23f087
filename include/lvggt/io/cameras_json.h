// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "lvggt/geometry/camera.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/original_camera.h"
#include "lvggt/io/preprocess.h"

namespace lvggt {

// One frame's entry in cameras.json.
struct CameraRecord {
  std::int64_t index = 0;         // of the frame in the run
  std::int64_t source_index = 0;  // of the frame in the video or folder
  std::string name;
  double timestamp = 0;  // seconds
  Camera camera;         // in model pixels
};

// The transform as cameras.json and run.json state it.
inline void write_transform(JsonWriter& json, const ImageTransform& transform) {
  json.begin_object();
  json.field("original_width", transform.original_width);
  json.field("original_height", transform.original_height);
  json.field("quarter_turns_ccw", transform.quarter_turns_ccw);
  json.field("model_width", transform.width);
  json.field("model_height", transform.height);
  json.key("scale");
  json.numbers(std::array<double, 2>{transform.scale_x, transform.scale_y});
  json.key("offset");
  json.numbers(std::array<double, 2>{transform.offset_x, transform.offset_y});
  json.end_object();
}

// Streams cameras.json, format 1: the conventions in words, the transform from the original
// pictures to model frames (all frames of a run share it), and for each frame its camera in model
// pixels and in those of the original. The file appears at finish().
class CamerasJson {
 public:
  CamerasJson(const std::string& path, const ImageTransform& transform)
      : file_(path), transform_(transform) {
    json_.begin_object();
    json_.field("format_version", 1);
    write_conventions();
    json_.key("transform");
    write_transform(json_, transform);
    json_.key("frames");
    json_.begin_array();
  }

  void add(const CameraRecord& record) {
    json_.begin_object();
    json_.field("index", record.index);
    json_.field("source_index", record.source_index);
    json_.field("name", record.name);
    json_.field("timestamp", record.timestamp);
    json_.key("model");
    write_camera(record.camera, transform_.width, transform_.height);
    json_.key("original");
    write_camera(in_original_pixels(record.camera, transform_), transform_.original_width,
                 transform_.original_height);
    json_.end_object();
    file_.write(json_.take());
  }

  void finish() {
    json_.end_array();
    json_.end_object();
    file_.write(json_.take());
    file_.commit();
  }

 private:
  void write_conventions() {
    json_.key("conventions");
    json_.begin_object();
    json_.field("cam_from_world", "3 x 4, row by row: x_cam = R x_world + t");
    json_.field("axes", "OpenCV: x right, y down, z forward");
    json_.field("world", "the model places the first camera at the origin, as well as it can");
    json_.field("pixels", "the centre of the first pixel is (0, 0): u = fx x / z + cx");
    json_.field("scale", "relative: the unit is not a metre");
    json_.field("timestamp", "seconds");
    json_.field(
        "transform",
        "with the centre of the first pixel at (0.5, 0.5): model = scale * original + offset, "
        "the original first turned by quarter_turns_ccw");
    json_.field("original",
                "the upright picture as viewers show it; when it was turned for the model, its "
                "cam_from_world is turned back too");
    json_.end_object();
  }

  void write_camera(const Camera& camera, int width, int height) {
    json_.begin_object();
    json_.field("width", width);
    json_.field("height", height);
    json_.field("fx", camera.fx);
    json_.field("fy", camera.fy);
    json_.field("cx", camera.cx);
    json_.field("cy", camera.cy);
    json_.key("cam_from_world");
    json_.begin_array();
    for (int row = 0; row < 3; ++row) {
      const auto& E = camera.cam_from_world;
      json_.numbers(std::array<float, 4>{E(row, 0), E(row, 1), E(row, 2), E(row, 3)});
    }
    json_.end_array();
    json_.end_object();
  }

  AtomicFile file_;
  ImageTransform transform_;
  JsonWriter json_;
};

}  // namespace lvggt
