// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/geometry/camera.h"
#include "lvggt/model/config.h"

namespace lvggt {

// Where the weights are and how strictly they are read.
struct LoadOptions {
  std::string weights;  // safetensors with the geometry tensors, and the decoder's unless `decoder`
                        // is given; a file, a sharded model's index or the folder that holds it
  std::string decoder;  // safetensors with the decoder tensors; may be empty
  std::string
      config;  // JSON configuration; empty: the file's metadata, else what the tensor shapes tell
  bool strict = false;  // tensors that the configuration does not name are an error, not a warning
  bool allow_nonfinite = false;  // accept NaN and infinity in weights
  bool points = true;            // load the point head, if it is there
};

// The whole model, immutable once loaded: any number of streams may share it.
class LangVggt {
 public:
  // Checks every name and shape before anything is allocated and packs tensor by tensor, so that
  // the peak is the packed model and one tensor. Throws kMismatch with all missing and misshapen
  // tensors, kNumeric for weights that are not finite.
  static LangVggt load(const LoadOptions& options, Context& ctx);
  static LangVggt load(const std::string& weights);

  const ModelConfig& config() const;
  bool has_decoder() const;
  bool has_point_head() const;
  // What was odd about the weights but did not stop the loading, one sentence each.
  const std::vector<std::string>& warnings() const;
};

enum class CameraCache {
  kStream,  // the camera head's attention sees its own entries of earlier frames, one per iteration
  kPerFrame,  // each frame alone, as the released 4DLangVGGT demo does
};

struct StreamOptions {
  std::int64_t max_past_frames = 128;  // frames kept in the caches after each push; at least 1
  CameraCache camera_cache = CameraCache::kStream;
  bool points = false;              // run the point head
  bool rgb = true;                  // run the RGB head, if the decoder has one
  bool decoder = true;              // run the decoder, if there is one
  std::int64_t decoder_height = 0;  // size of rgb and language; 0: the frame's size
  std::int64_t decoder_width = 0;
};

// Seconds spent in each stage of one push.
struct StageTimes {
  double dino = 0;
  double frame_blocks = 0;
  double global_blocks = 0;
  double camera = 0;
  double depth = 0;
  double points = 0;
  double decoder = 0;
  double total = 0;
};

// What is known about one frame. Views are into the stream's buffers and live until its next push;
// what was not asked for is an empty view.
struct Frame {
  std::int64_t index = 0;  // 0 for the first frame pushed
  std::int64_t frames_attended =
      0;          // frames in the cache while this one was computed, itself included
  Camera camera;  // in the pixels of the pushed frame
  View<const float, 1> pose_encoding;      // [9]: tx ty tz, qx qy qz qw, fov_h fov_w
  View<const float, 2> depth;              // [H, W], along the camera's z axis
  View<const float, 2> depth_confidence;   // [H, W], at least 1
  View<const float, 3> points;             // [H, W, 3], of the point head, in world coordinates
  View<const float, 2> points_confidence;  // [H, W], at least 1
  View<const float, 3> rgb;                // [H, W, 3], in (0, 1)
  View<const float, 4> language;           // [level, H, W, lang_dim]
  StageTimes times;
};

// Runs the model over a video, one frame after the other. Owns the caches and the output buffers;
// the model and the context must outlive it. From the second frame on, push does not touch the
// heap.
class Stream {
 public:
  Stream(const LangVggt& model, Context& ctx, const StreamOptions& options = {});

  // pixels: [H, W, 3], RGB in [0, 1], H and W multiples of the patch size and the same for every
  // frame. Throws kMismatch for another size, kNumeric naming stage and frame when a value is not
  // finite. A frame that fails leaves the stream as it was before it.
  Frame push(View<const float, 3> pixels);
};

// Bytes that a stream over frames of H x W needs; `total` is the sum.
struct MemoryPlan {
  std::size_t weights = 0;  // packed model
  std::size_t cache = 0;    // keys and values when max_past_frames are kept
  std::size_t arenas = 0;   // scratch and outputs
  std::size_t total = 0;
};
MemoryPlan plan_memory(const ModelConfig& config, std::int64_t H, std::int64_t W,
                       const StreamOptions& options = {});

}  // namespace lvggt
