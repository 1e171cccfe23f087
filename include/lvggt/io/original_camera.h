// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/geometry/camera.h"
#include "lvggt/io/preprocess.h"

namespace lvggt {

// A pixel of a model frame in the picture it was made from; both in pixel index coordinates, where
// the centre of the first pixel is (0, 0).
inline Eigen::Vector2d pixel_in_original(const ImageTransform& transform, double u, double v) {
  // Edge coordinates of the turned picture.
  const double x = (u + 0.5 - transform.offset_x) / transform.scale_x;
  const double y = (v + 0.5 - transform.offset_y) / transform.scale_y;
  // A counter-clockwise quarter turn brought original (x0, y0) to (y0, original_width - x0).
  if (transform.quarter_turns_ccw == 1) return {transform.original_width - y - 0.5, x - 0.5};
  return {x - 0.5, y - 0.5};
}

// The camera of a model frame as the camera of the picture it was made from: the same rays, in the
// pixels of the original, and with its axes when the picture was turned.
inline Camera in_original_pixels(const Camera& camera, const ImageTransform& transform) {
  LVGGT_CHECK(transform.quarter_turns_ccw == 0 || transform.quarter_turns_ccw == 1,
              "camera: ", transform.quarter_turns_ccw, " quarter turns are not handled");
  const Eigen::Vector2d centre = pixel_in_original(transform, camera.cx, camera.cy);
  Camera original = camera;
  original.cx = static_cast<float>(centre[0]);
  original.cy = static_cast<float>(centre[1]);
  const auto fx = static_cast<float>(camera.fx / transform.scale_x);
  const auto fy = static_cast<float>(camera.fy / transform.scale_y);
  original.fx = transform.quarter_turns_ccw == 1 ? fy : fx;
  original.fy = transform.quarter_turns_ccw == 1 ? fx : fy;
  if (transform.quarter_turns_ccw == 1) {
    // The turned camera's x is the original's y, its y the original's -x.
    original.cam_from_world.row(0) = -camera.cam_from_world.row(1);
    original.cam_from_world.row(1) = camera.cam_from_world.row(0);
  }
  return original;
}

}  // namespace lvggt
