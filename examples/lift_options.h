// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/cli/program.h"
#include "lvggt/cli/threads.h"
#include "lvggt/cli/work_list.h"
#include "lvggt/field/run_writer.h"
#include "lvggt/io/frame_source.h"
#include "lvggt/io/preprocess.h"
#include "lvggt/model/lang_vggt.h"
#include "lvggt/model/stream_options.h"

// The options of lift_video.
struct LiftOptions {
  std::string video, out, summary, mode = "crop", camera_cache = "stream", point_colors = "input";
  std::string weights_storage = "stored", cache_storage = "f32";
  std::string sha256;  // of the weights file; empty: any
  std::string list, shard_text;
  lvggt::cli::ListOptions list_options;
  lvggt::LoadOptions weights;
  lvggt::FrameSourceOptions frames;
  lvggt::PreprocessOptions preprocess;
  lvggt::StreamOptions stream;
  lvggt::RunOutputs outputs;
  int size = 0;  // 0: the model's own
  int threads = 0;
  std::size_t memory_limit = 0;  // 0: what is free
  bool no_ply = false, no_depth = false, no_confidence = false, no_rgb = false,
       no_semantics = false;
  bool no_colmap = false, no_contact_sheet = false, no_decoder = false;
  bool no_codes = false, no_frames = false;
  bool force = false, resume = false, dry_run = false, hash = false;

  // After parsing: words and negations become what the library takes. Throws kUsage.
  void settle() {
    using namespace lvggt;
    preprocess.mode = parse_frame_mode(mode);
    if (preprocess.mode == FrameMode::kGt)
      fail(ErrorKind::kUsage, "--mode: gt is for training targets; use crop, pad or original");
    if (size % kPatchSize != 0)
      fail(ErrorKind::kUsage, "--size: ", size, " is not a multiple of ", kPatchSize);
    if (video.empty() == list.empty())
      fail(ErrorKind::kUsage, "VIDEO is required, or --list FILE instead of it");
    if (!list.empty() && (force || dry_run || !summary.empty()))
      fail(ErrorKind::kUsage, "--list goes with none of --force, --dry-run and --summary");
    if (list.empty() && (!shard_text.empty() || list_options.retry_failed))
      fail(ErrorKind::kUsage, "--shard and --retry-failed are for --list");
    if (!shard_text.empty()) list_options.shard = cli::parse_shard(shard_text);
    if (force && resume) fail(ErrorKind::kUsage, "--force and --resume exclude each other");
    if (out.empty() && !dry_run)
      fail(ErrorKind::kUsage, "--out is required (except with --dry-run)");
    stream.camera_cache = camera_cache == "stream" ? CameraCache::kStream : CameraCache::kPerFrame;
    stream.decoder = !no_decoder;
    // More past frames than the run has are never reached.
    stream.max_past_frames = std::min(stream.max_past_frames, frames.max_frames);
    weights.points = false;
    if (weights_storage != "stored")
      weights.storage = StoragePolicy::of(parse_storage(weights_storage, "--weights-storage"));
    stream.cache_storage = parse_storage(cache_storage, "--cache-storage");
    outputs.ply = !no_ply;
    outputs.depth = !no_depth;
    outputs.confidence = !no_confidence;
    outputs.rgb = !no_rgb;
    outputs.semantics = !no_semantics;
    outputs.colmap = !no_colmap;
    outputs.contact_sheet = !no_contact_sheet;
    outputs.codes = !no_codes;
    outputs.frames = !no_frames;
    outputs.rgb_head_colors = point_colors == "rgb";
  }

  // Everything the results depend on but the bytes of the inputs.
  std::vector<std::pair<std::string, std::string>> settings() const {
    using lvggt::concat;
    const auto yes = [](bool flag) { return flag ? "yes" : "no"; };
    std::string written;
    for (const auto& [name, wanted] : {std::pair{"ply", outputs.ply},
                                       {"depth", outputs.depth},
                                       {"confidence", outputs.confidence},
                                       {"rgb", outputs.rgb},
                                       {"semantics", outputs.semantics},
                                       {"colmap", outputs.colmap},
                                       {"contact_sheet", outputs.contact_sheet},
                                       {"images", outputs.images},
                                       {"codes", outputs.codes},
                                       {"frames", outputs.frames}})
      if (wanted) written += (written.empty() ? "" : " ") + std::string(name);
    std::string percentile;
    lvggt::append_number(percentile, outputs.percentile);
    return {{"mode", mode},
            {"size", concat(preprocess.size)},
            {"rotate_to_portrait", yes(preprocess.rotate_to_portrait)},
            {"start", concat(frames.start)},
            {"stride", concat(frames.stride)},
            {"max_frames", frames.max_frames == std::numeric_limits<std::int64_t>::max()
                               ? "all"
                               : concat(frames.max_frames)},
            {"max_past_frames", concat(stream.max_past_frames)},
            {"keep_first_frame", yes(stream.window.keep_first)},
            {"keep_every", concat(stream.window.keep_every)},
            {"camera_cache", camera_cache},
            {"weights_storage", weights_storage},
            {"cache_storage", cache_storage},
            {"decoder", yes(stream.decoder)},
            {"percentile", percentile},
            {"point_colors", point_colors},
            {"colmap_points", concat(outputs.colmap_points)},
            {"every", concat(outputs.every)},
            {"outputs", written}};
  }
};

namespace lift_options {

inline void add_inputs(lvggt::cli::Program& program, LiftOptions& o) {
  CLI::App& app = program.app();
  app.add_option("VIDEO", o.video, "A video, a folder of images, or an image");
  app.add_option("--list", o.list, "A file that names many of them, one a line; see below")
      ->type_name("FILE");
  app.add_option("--weights", o.weights.weights,
                 "The geometry model: safetensors, or a sharded model's index or folder; without "
                 "it, the small model that comes with lvggt")
      ->type_name("FILE");
  app.add_option("--decoder", o.weights.decoder,
                 "The semantic bridging decoder, unless it is in the same file; without any, there "
                 "is geometry only")
      ->type_name("FILE");
  app.add_option("--state-decoder", o.weights.state_decoder,
                 "A second decoder, for states (dynamic semantics); it shares the geometry's work")
      ->type_name("FILE");
  app.add_option("--config", o.weights.config,
                 "The model's configuration; otherwise what the weights' metadata or shapes tell")
      ->type_name("JSON");
  app.add_flag("--no-decoder", o.no_decoder, "Geometry only, also if there are decoders");
  app.add_flag("--strict", o.weights.strict, "Refuse weights with tensors the model does not use");
  app.add_option("--sha256", o.sha256, "Refuse weights whose file has another SHA-256")
      ->type_name("HEX");
  app.add_flag("--hash", o.hash, "Record the SHA-256 of the weights in run.json");
}

inline void add_frames(lvggt::cli::Program& program, LiftOptions& o) {
  constexpr auto kMany = std::numeric_limits<std::int64_t>::max();
  CLI::App& app = program.app();
  program.add_number<std::int64_t>("--start", o.frames.start, "First frame, counted from 0", 0,
                                   kMany);
  program.add_number<std::int64_t>("--stride", o.frames.stride, "Take every N-th frame", 1, kMany);
  program
      .add_number<std::int64_t>("--max-frames", o.frames.max_frames, "Take at most N frames", 1,
                                kMany)
      ->default_str("all");
  program.add_number<double>("--images-per-second", o.frames.images_per_second,
                             "Times of a folder's images, which have none", 1e-6, 1e6);
  app.add_option("--mode", o.mode, "How a picture becomes a model frame: crop, pad or original")
      ->check(CLI::IsMember({"crop", "pad", "original"}))
      ->type_name("MODE")
      ->capture_default_str();
  program
      .add_number<int>("--size", o.size, "Width (crop) or longest side (pad), a multiple of 14",
                       lvggt::kPatchSize, lvggt::kMaxFrameSize)
      ->default_str("the model's, 518 as published");
  app.add_flag("--rotate-to-portrait", o.preprocess.rotate_to_portrait,
               "Turn landscape pictures 90 degrees counter-clockwise first");
}

inline void add_model(lvggt::cli::Program& program, LiftOptions& o) {
  program.add_number<std::int64_t>("--max-past-frames", o.stream.max_past_frames,
                                   "Past frames the model sees; memory and time grow with it", 1,
                                   std::int64_t{1} << 20);
  program.app().add_flag(
      "--keep-first-frame", o.stream.window.keep_first,
      "When they are too many, never forget the first: it fixes the world frame");
  program.add_number<std::int64_t>(
      "--keep-every", o.stream.window.keep_every,
      "When they are too many, forget every N-th last; 0: oldest first", 0, std::int64_t{1} << 20);
  program.app()
      .add_option(
          "--camera-cache", o.camera_cache,
          "stream: cameras see those of past frames; frame: each alone, as the released demo")
      ->check(CLI::IsMember({"stream", "frame"}))
      ->type_name("KIND")
      ->capture_default_str();
  program.app()
      .add_option("--weights-storage", o.weights_storage,
                  "How weights are kept in memory: stored (as in their file), f32, bf16, f16 or "
                  "int8 (in the transformer); narrower is less exact")
      ->check(CLI::IsMember({"stored", "f32", "bf16", "f16", "int8"}))
      ->type_name("TYPE")
      ->capture_default_str();
  program.app()
      .add_option("--cache-storage", o.cache_storage,
                  "How past frames are kept in memory: f32, bf16 or int8; narrower is less exact")
      ->check(CLI::IsMember({"f32", "bf16", "int8"}))
      ->type_name("TYPE")
      ->capture_default_str();
  lvggt::cli::add_threads_option(program, o.threads);
  program.add_bytes("--memory-limit", o.memory_limit,
                    "Refuse to start if more is needed; otherwise what is free");
}

inline void add_outputs(lvggt::cli::Program& program, LiftOptions& o) {
  CLI::App& app = program.app();
  app.add_option(
         "--out", o.out,
         "Folder for the results; its parent exists. With --list, it gets a folder for each")
      ->type_name("DIR");
  app.add_flag("--force", o.force, "Replace an earlier run in that folder");
  app.add_flag(
      "--resume", o.resume,
      "Continue an interrupted run: files that are there stay. All frames are computed again, "
      "because each depends on those before");
  app.add_option("--shard", o.shard_text, "With --list: take only every N-th input, from the I-th")
      ->type_name("I/N");
  app.add_flag("--retry-failed", o.list_options.retry_failed,
               "With --list: also try what failed in earlier runs");
  app.add_flag("--dry-run", o.dry_run, "Print the plan (frames, sizes, memory) and stop");
  app.add_option("--summary", o.summary,
                 "Write a JSON summary: times by stage, peak memory; - for stdout")
      ->type_name("FILE");
  program.add_number<std::int64_t>("--every", o.outputs.every,
                                   "Write files for every N-th frame; cameras.json has all", 1,
                                   std::int64_t{1} << 40);
  program.add_number<double>("--percentile", o.outputs.percentile,
                             "Drop points whose confidence is below this percentile of the frame",
                             0, 100, "P");
  app.add_option("--point-colors", o.point_colors,
                 "Colours of points: input, or rgb for the RGB head's")
      ->check(CLI::IsMember({"input", "rgb"}))
      ->type_name("FROM")
      ->capture_default_str();
  program.add_number<std::int64_t>("--colmap-points", o.outputs.colmap_points,
                                   "About how many points the COLMAP model gets", 0,
                                   std::int64_t{1} << 40);
  app.add_flag("--images", o.outputs.images, "Also write the original pictures, as PNG");
  app.add_flag("--no-ply", o.no_ply, "No point clouds");
  app.add_flag("--no-depth", o.no_depth, "No depth maps");
  app.add_flag("--no-confidence", o.no_confidence, "No confidence maps");
  app.add_flag("--no-rgb", o.no_rgb, "No pictures of the RGB head");
  app.add_flag("--no-semantics", o.no_semantics, "No semantic maps (points keep their vectors)");
  app.add_flag("--no-codes", o.no_codes,
               "No semantic codes, which query_video needs (points keep theirs)");
  app.add_flag("--no-frames", o.no_frames,
               "No pictures of what the model saw, on which query_video paints");
  app.add_flag("--no-colmap", o.no_colmap, "No COLMAP model");
  app.add_flag("--no-contact-sheet", o.no_contact_sheet, "No contact sheet");
}

}  // namespace lift_options

inline void add_lift_options(lvggt::cli::Program& program, LiftOptions& options) {
  lift_options::add_inputs(program, options);
  lift_options::add_frames(program, options);
  lift_options::add_model(program, options);
  lift_options::add_outputs(program, options);
  program.app().footer(
      std::string(lvggt::cli::kListHelp) +
      "\n\nExit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input, 4 memory or a "
      "limit,\n"
      "5 partial result (the video ends early, or inputs of the list failed), 130 interrupted.\n\n"
      "Examples:\n"
      "  lift_video clip.mp4 --out clip                   with the bundled small model, to try\n"
      "  lift_video clip.mp4 --weights model.safetensors --decoder decoder.safetensors --out clip\n"
      "  query_video clip \"the cup\" --text-encoder CLIP --autoencoder ae.safetensors --out "
      "answer\n"
      "  mpirun -n 4 lift_video --list videos.txt --weights model.safetensors --out lifted");
}
