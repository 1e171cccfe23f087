// SPDX-License-Identifier: Apache-2.0
#pragma once

// lvggt: from a video to a coloured, language-featured 4D point cloud, frame by frame. This is the
// one header to include; a whole program (examples/embed, with its CMakeLists.txt):
//
//   #include <lvggt/io/video.h>
//   #include <lvggt/lvggt.h>
//
//   #include <cstdio>
//   #include <string>
//
//   int main(int argc, char** argv) try {
//     if (argc < 2) lvggt::fail(lvggt::ErrorKind::kUsage, "give a video or folder (and weights)");
//     const std::string weights = argc > 2 ? argv[2] : SMALL_MODEL;  // from CMakeLists.txt
//     if (argc == 2) {
//       lvggt::check_bundled_file(lvggt::kSmallModel, weights);
//       std::fprintf(stderr, "embed: no weights given: using the bundled small model\n");
//     }
//     lvggt::Context ctx;  // all CPUs this process may use
//     const auto model =
//         lvggt::LangVggt::load({.weights = weights, .decoder = argc > 3 ? argv[3] : ""}, ctx);
//     const lvggt::PreprocessOptions size{.size = static_cast<int>(model.config().img_size)};
//
//     lvggt::Stream stream(model, ctx, {.max_past_frames = 8});
//     const auto frames = lvggt::open_frames(argv[1], {}, lvggt::open_video);
//     while (const auto input = frames->next()) {
//       const lvggt::PreparedFrame prepared = lvggt::prepare_frame(input->image, size);
//       const lvggt::Frame frame = stream.push(prepared.pixels);  // views live until the next push
//
//       const auto [H, W] = frame.depth.shape();
//       const auto& pose = frame.camera.cam_from_world;  // [R | t], OpenCV axes
//       std::printf("%6.2f s  t (%.3f %.3f %.3f)  depth %.3f", input->timestamp, pose(0, 3), pose(1, 3),
//                   pose(2, 3), frame.depth(H / 2, W / 2));
//       if (model.has_decoder()) {
//         const auto meaning = frame.language[0][H / 2][W / 2];  // [lang_dim], smallest level
//         std::printf("  semantics (%.3f %.3f %.3f)", meaning(0), meaning(1), meaning(2));
//       }
//       std::printf("\n");
//     }
//   } catch (const lvggt::Error& error) {
//     std::fprintf(stderr, "embed: %s\n", error.what());
//     return lvggt::exit_code(error.kind());
//   }
//
// Errors are exceptions of type lvggt::Error. The library prints nothing, reads no environment
// variable, installs no signal handler and has no globals. Link lvggt::lvggt; reading video files
// also needs lvggt/io/video.h and lvggt::video (FFmpeg). What is where:
//
//   core/      Shape, View, Tensor; Error; Context (threads, scratch memory)
//   model/     LangVggt, Stream, Frame; ModelConfig; names and shapes of the weights
//   io/        pictures, folders and preprocessing; safetensors; PLY, COLMAP, cameras.json, PNG
//   geometry/  Camera, unprojection, confidence filter
//   field/     coloured and language-featured clouds, colours of semantic maps, contact sheets
//   kernels/   the operators the model is made of; not included here, like what follows
//   train/     the Semantic Bridging Decoder's training; backward passes of encoder blocks
//   exact/     the decoder's training in float64 on plain kernels, for checking
//   data/      labelled scenes, token caches, loaders
//   language/  text and image encoders (link lvggt::text), autoencoders, queries, scores
//
// Shapes are written beside every declaration, channels last: [H, W, C] and [B, H, W, C].

#include "lvggt/core/arena.h"
#include "lvggt/core/context.h"
#include "lvggt/core/error.h"
#include "lvggt/core/float16.h"
#include "lvggt/core/parallel.h"
#include "lvggt/core/shape.h"
#include "lvggt/core/tensor.h"
#include "lvggt/field/color_map.h"
#include "lvggt/field/contact_sheet.h"
#include "lvggt/field/frame_pictures.h"
#include "lvggt/field/label.h"
#include "lvggt/field/point_cloud.h"
#include "lvggt/field/run_writer.h"
#include "lvggt/field/semantic_colors.h"
#include "lvggt/geometry/camera.h"
#include "lvggt/geometry/confidence.h"
#include "lvggt/geometry/unproject.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/cameras_json.h"
#include "lvggt/io/colmap.h"
#include "lvggt/io/depth_png.h"
#include "lvggt/io/dtype.h"
#include "lvggt/io/frame_source.h"
#include "lvggt/io/image.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/limits.h"
#include "lvggt/io/original_camera.h"
#include "lvggt/io/ply.h"
#include "lvggt/io/png.h"
#include "lvggt/io/preprocess.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/model/config.h"
#include "lvggt/model/deterministic_weights.h"
#include "lvggt/model/lang_vggt.h"
#include "lvggt/model/small_model.h"
#include "lvggt/model/stream.h"
#include "lvggt/model/tensor_list.h"
