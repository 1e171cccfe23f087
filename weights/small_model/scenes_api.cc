// SPDX-License-Identifier: Apache-2.0
// The scene generator for Python: plain arrays in, plain arrays out.
#include <algorithm>
#include <cstring>
#include <numeric>

#include "weights/small_model/scene.h"

extern "C" {

// Renders the frames of the scene that `seed` makes, all in one exposure of the generator:
//   rgb [S, H, W, 3] bytes; depth [S, H, W] metres along the camera's axis
//   object [S, H, W]: 0 the room, else 1 + the number of what moves as one
//   cam_from_world [S, 3, 4]; fov [2]: height, width, radians
//   labels [256]: of each value of `object`: 0 room, 1 thing, 2 held, 3 person
// Returns 0, or 1 when the scene cannot be used (the camera ends in a wall or in a thing).
int small_model_render(std::uint64_t seed, int frames, int height, int width, std::uint8_t* rgb,
                       float* depth, std::uint8_t* object, float* cam_from_world, float* fov,
                       std::uint8_t* labels) {
  const small_model::Scene scene = small_model::make_scene(seed);
  std::memset(labels, 0, 256);
  for (std::size_t i = 0; i < std::min<std::size_t>(scene.groups.size(), 255); ++i)
    labels[i + 1] = static_cast<std::uint8_t>(scene.groups[i].label);
  const float aspect = static_cast<float>(height) / static_cast<float>(width);
  fov[1] = scene.fov_w;
  fov[0] = 2 * std::atan(aspect * std::tan(0.5f * scene.fov_w));
  const auto pixels = static_cast<std::size_t>(height) * static_cast<std::size_t>(width);
  for (int s = 0; s < frames; ++s) {
    const float time = scene.seconds_per_frame * static_cast<float>(s);
    const small_model::Rigid pose = scene.camera.at(time);
    const small_model::Vec3 eye = small_model::inverse(pose).t;
    for (int k = 0; k < 3; ++k)
      if (eye[k] < scene.room_low[k] + 0.05f || eye[k] > scene.room_high[k] - 0.05f) return 1;
    const small_model::Picture picture =
        small_model::render(scene, pose, time, height, width,
                            small_model::mix_bits(seed + 77) + static_cast<unsigned>(s));
    const auto at = static_cast<std::size_t>(s) * pixels;
    std::transform(picture.rgb.begin(), picture.rgb.end(), rgb + 3 * at,
                   [](float v) { return static_cast<std::uint8_t>(v * 255 + 0.5f); });
    std::copy(picture.depth.begin(), picture.depth.end(), depth + at);
    std::copy(picture.object.begin(), picture.object.end(), object + at);
    for (int row = 0; row < 3; ++row) {
      for (int k = 0; k < 3; ++k) cam_from_world[12 * s + 4 * row + k] = pose.R.row[row][k];
      cam_from_world[12 * s + 4 * row + 3] = pose.t[row];
    }
  }
  // Nobody films with something right before the lens, or walks on when something comes there.
  const double mean = std::accumulate(depth, depth + pixels, 0.0) / static_cast<double>(pixels);
  for (int s = 0; s < frames; ++s) {
    const float* at = depth + static_cast<std::size_t>(s) * pixels;
    const auto near = std::count_if(at, at + pixels, [&](float d) { return d < 0.2 * mean; });
    if (static_cast<std::size_t>(near) * 12 > pixels) return 1;
  }
  return 0;
}

}  // extern "C"
