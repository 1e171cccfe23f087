// SPDX-License-Identifier: Apache-2.0
#include <cmath>

#include "examples/check_reference/cases.h"

namespace check_reference {

using namespace lvggt;

Camera camera_as_encoded(View<const float, 1> encoding, std::int64_t H, std::int64_t W) {
  try {
    return decode_pose_encoding(encoding, H, W);
  } catch (const Error& e) {
    if (e.kind() != ErrorKind::kNumeric) throw;
  }
  Camera camera;
  const Eigen::Vector4d q(encoding[3], encoding[4], encoding[5], encoding[6]);
  camera.cam_from_world.leftCols<3>() = rotation_from_quaternion(q).cast<float>();
  camera.cam_from_world.col(3) << encoding[0], encoding[1], encoding[2];
  camera.cx = 0.5f * static_cast<float>(W);
  camera.cy = 0.5f * static_cast<float>(H);
  camera.fx = camera.cx / std::tan(encoding[8] / 2);
  camera.fy = camera.cy / std::tan(encoding[7] / 2);
  return camera;
}

}  // namespace check_reference
