// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "lvggt/core/parallel.h"
#include "lvggt/core/tensor.h"
#include "lvggt/geometry/camera.h"

namespace lvggt {

// The world point of every pixel: X_c = ((u - cx) z / fx, (v - cy) z / fy, z), X_w = R^T (X_c - t).
//   points: [H, W, 3]   depth: [H, W]
inline void unproject(View<float, 3> points, View<const float, 2> depth, const Camera& camera,
                      Context& ctx) {
  const std::int64_t H = depth.extent(0), W = depth.extent(1);
  LVGGT_CHECK((points.shape() == Shape{H, W, std::int64_t{3}}), "unproject: points are ",
              points.shape(), " but depth is ", depth.shape());
  const Eigen::Matrix3f world_from_cam = camera.cam_from_world.leftCols<3>().transpose();
  const Eigen::Vector3f t = camera.cam_from_world.col(3);
  // About 16k points a chunk: long enough to pay for a task, short enough to balance.
  const std::int64_t grain = 1 + 16384 / std::max<std::int64_t>(W, 1);
  parallel_rows(
      H, grain,
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t v = begin; v < end; ++v) {
          const float* z = depth[v].data();
          const View<float, 2> row = points[v];
          for (std::int64_t u = 0; u < W; ++u) {
            const Eigen::Vector3f in_camera((static_cast<float>(u) - camera.cx) * z[u] / camera.fx,
                                            (static_cast<float>(v) - camera.cy) * z[u] / camera.fy,
                                            z[u]);
            Eigen::Map<Eigen::Vector3f>(row[u].data()).noalias() = world_from_cam * (in_camera - t);
          }
        }
      },
      ctx);
}

}  // namespace lvggt
