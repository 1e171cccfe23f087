// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

#include "examples/evaluate/run_spec.h"
#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/data/scene.h"
#include "lvggt/io/preprocess.h"

namespace evaluate {

// The codes of one frame in the pixels of its picture; reused from frame to frame.
struct FrameCodes {
  lvggt::Tensor<float, 4> language;  // [levels, H, W, d]
  lvggt::Tensor<float, 3> states;    // [H, W, d']; empty without states
};

// Where the codes of a scene's frames come from.
class CodesSource {
 public:
  virtual ~CodesSource() = default;
  virtual bool has_states() const = 0;
  // Fills `codes` for the frame of that index (from 0), stretched to H x W pixels. Frames are asked
  // for in ascending order.
  virtual void read(FrameCodes& codes, std::int64_t frame, std::int64_t H, std::int64_t W) = 0;
};

// The source that a run names for a scene. `annotated` are the frames that will be asked for.
std::unique_ptr<CodesSource> open_source(const RunSpec& run, const lvggt::Scene& scene,
                                         const std::vector<std::int64_t>& annotated,
                                         lvggt::Context& ctx);

// Decoders on tokens, from a cache or made on the way.
std::unique_ptr<CodesSource> open_decoders(const RunSpec& run, const lvggt::Scene& scene,
                                           lvggt::Context& ctx);
// What lift_video left.
std::unique_ptr<CodesSource> open_field(const std::string& folder, const lvggt::Scene& scene);
// Feature maps in .npy files, [H, W, d] a frame, one folder a level.
std::unique_ptr<CodesSource> open_renders(const std::vector<std::string>& levels,
                                          const std::string& states,
                                          const std::vector<std::int64_t>& annotated);

// The picture of a frame index. Errors: kMismatch when the scene has none.
const lvggt::SceneFrame& frame_of(const lvggt::Scene& scene, std::int64_t frame);

// Each pixel of a picture takes the value of the model frame where its centre lies, bilinear,
// clamped at the border.   y: [H, W, d]   x: [h, w, d], of a model frame
void resample_to_picture(lvggt::View<float, 3> y, lvggt::View<const float, 3> x,
                         const lvggt::ImageTransform& transform);

// The transform that stretches a map over its picture.
lvggt::ImageTransform stretch(std::int64_t from_H, std::int64_t from_W, std::int64_t H,
                              std::int64_t W);

}  // namespace evaluate
