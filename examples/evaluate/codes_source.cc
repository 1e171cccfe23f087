// SPDX-License-Identifier: Apache-2.0
#include "examples/evaluate/codes_source.h"

#include <algorithm>
#include <cmath>

namespace evaluate {

using namespace lvggt;

std::unique_ptr<CodesSource> open_source(const RunSpec& run, const Scene& scene,
                                         const std::vector<std::int64_t>& annotated, Context& ctx) {
  if (!run.field.empty()) return open_field(RunSpec::for_scene(run.field, scene.name()), scene);
  if (run.renders.empty()) return open_decoders(run, scene, ctx);
  std::vector<std::string> levels;
  for (const std::string& folder : run.renders)
    levels.push_back(RunSpec::for_scene(folder, scene.name()));
  return open_renders(levels, RunSpec::for_scene(run.state_renders, scene.name()), annotated);
}

const SceneFrame& frame_of(const Scene& scene, std::int64_t frame) {
  const std::int64_t number = frame + (scene.layout() == SceneLayout::kHyperNerf ? 1 : 0);
  for (const SceneFrame& candidate : scene.frames())
    if (candidate.number == number) return candidate;
  fail(ErrorKind::kMismatch, scene.path(), ": frame ", number,
       " is annotated, but the scene has no such picture");
}

ImageTransform stretch(std::int64_t from_H, std::int64_t from_W, std::int64_t H, std::int64_t W) {
  ImageTransform transform;
  transform.original_width = static_cast<int>(W);
  transform.original_height = static_cast<int>(H);
  transform.width = static_cast<int>(from_W);
  transform.height = static_cast<int>(from_H);
  transform.scale_x = static_cast<double>(from_W) / static_cast<double>(W);
  transform.scale_y = static_cast<double>(from_H) / static_cast<double>(H);
  return transform;
}

void resample_to_picture(View<float, 3> y, View<const float, 3> x,
                         const ImageTransform& transform) {
  const std::int64_t H = y.extent(0), W = y.extent(1), d = y.extent(2);
  const std::int64_t h = x.extent(0), w = x.extent(1);
  // Annotations may be of another size than the pictures.
  const double to_x = static_cast<double>(transform.original_width) / static_cast<double>(W);
  const double to_y = static_cast<double>(transform.original_height) / static_cast<double>(H);
  for (std::int64_t row = 0; row < H; ++row)
    for (std::int64_t column = 0; column < W; ++column) {
      double u = (static_cast<double>(column) + 0.5) * to_x;
      double v = (static_cast<double>(row) + 0.5) * to_y;
      if (transform.quarter_turns_ccw == 1) {
        const double turned = transform.original_width - u;
        u = v;
        v = turned;
      }
      u = std::clamp(transform.scale_x * u + transform.offset_x - 0.5, 0.0,
                     static_cast<double>(w - 1));
      v = std::clamp(transform.scale_y * v + transform.offset_y - 0.5, 0.0,
                     static_cast<double>(h - 1));
      const auto left = std::min(static_cast<std::int64_t>(u), std::max<std::int64_t>(w - 2, 0));
      const auto top = std::min(static_cast<std::int64_t>(v), std::max<std::int64_t>(h - 2, 0));
      const std::int64_t right = std::min(left + 1, w - 1), bottom = std::min(top + 1, h - 1);
      const auto a = static_cast<float>(u - static_cast<double>(left));
      const auto b = static_cast<float>(v - static_cast<double>(top));
      for (std::int64_t c = 0; c < d; ++c) {
        const float upper = (1 - a) * x(top, left, c) + a * x(top, right, c);
        const float lower = (1 - a) * x(bottom, left, c) + a * x(bottom, right, c);
        y(row, column, c) = (1 - b) * upper + b * lower;
      }
    }
}

}  // namespace evaluate
