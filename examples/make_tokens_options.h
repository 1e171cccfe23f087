// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/cli/program.h"
#include "lvggt/cli/threads.h"
#include "lvggt/cli/work_list.h"
#include "lvggt/data/scene.h"
#include "lvggt/data/token_cache.h"
#include "lvggt/io/frame_source.h"
#include "lvggt/io/preprocess.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/stream_options.h"

// The options of make_tokens.
struct MakeTokensOptions {
  std::string input, list, out, mode = "crop";
  std::string weights_storage = "stored", cache_storage = "f32", storage = "bf16";
  std::string sha256;  // of the weights file; empty: any
  std::string shard_text;
  lvggt::LoadOptions weights;
  lvggt::FrameSourceOptions frames;
  lvggt::PreprocessOptions preprocess;
  lvggt::StreamOptions stream;
  lvggt::cli::ListOptions list_options;
  int size = 0;  // 0: the model's own
  int threads = 0;
  std::size_t memory_limit = 0;  // 0: what is free
  bool force = false, resume = false, dry_run = false;

  lvggt::Dtype dtype() const { return storage == "f32" ? lvggt::Dtype::kF32 : lvggt::Dtype::kBF16; }

  // After parsing: words become what the library takes. Throws kUsage.
  void settle() {
    using namespace lvggt;
    preprocess.mode = parse_frame_mode(mode);
    if (size % kPatchSize != 0)
      fail(ErrorKind::kUsage, "--size: ", size, " is not a multiple of ", kPatchSize);
    if (input.empty() == list.empty())
      fail(ErrorKind::kUsage, "give either a SCENE (or video, or folder) or --list FILE");
    if (force && resume) fail(ErrorKind::kUsage, "--force and --resume exclude each other");
    if (!list.empty() && (force || dry_run))
      fail(ErrorKind::kUsage, "--list goes with neither --force nor --dry-run");
    if (list.empty() && (!shard_text.empty() || list_options.retry_failed))
      fail(ErrorKind::kUsage, "--shard and --retry-failed are for --list");
    if (!shard_text.empty()) list_options.shard = cli::parse_shard(shard_text);
    // More past frames than the run has are never reached, but they are a setting of the tokens.
    if (weights_storage != "stored")
      weights.storage = StoragePolicy::of(parse_storage(weights_storage, "--weights-storage"));
    weights.points = false;
    stream.cache_storage = parse_storage(cache_storage, "--cache-storage");
    stream.decoder = false;
  }

  // The folder of an input's tokens.
  std::string folder_for(const std::string& from, const std::string& name) const {
    if (!out.empty()) return out + "/" + name;
    if (!lvggt::Scene::is_scene(from))
      lvggt::fail(lvggt::ErrorKind::kUsage, from,
                  ": is no labelled scene, which keeps its tokens itself; give --out");
    return lvggt::cli::without_trailing_slashes(from) + "/lvggt_tokens";
  }
};

namespace make_tokens_options {

inline void add_inputs(lvggt::cli::Program& program, MakeTokensOptions& o) {
  CLI::App& app = program.app();
  app.add_option("SCENE", o.input,
                 "A labelled scene (rgb/2x or cam00/images), a folder of images, or a video");
  app.add_option("--list", o.list, "A file that names many of them, one a line; see below")
      ->type_name("FILE");
  app.add_option(
         "--weights", o.weights.weights,
         "The geometry model: safetensors, or a sharded model's index or folder; without it, "
         "the small model that comes with lvggt")
      ->type_name("FILE");
  app.add_option("--config", o.weights.config,
                 "The model's configuration; otherwise what the weights' metadata or shapes tell")
      ->type_name("JSON");
  app.add_flag("--strict", o.weights.strict, "Refuse weights with tensors the model does not use");
  app.add_option("--sha256", o.sha256, "Refuse weights whose file has another SHA-256")
      ->type_name("HEX");
}

inline void add_frames(lvggt::cli::Program& program, MakeTokensOptions& o) {
  constexpr auto kMany = std::numeric_limits<std::int64_t>::max();
  CLI::App& app = program.app();
  program.add_number<std::int64_t>("--start", o.frames.start, "First frame, counted from 0", 0,
                                   kMany);
  program.add_number<std::int64_t>("--stride", o.frames.stride, "Take every N-th frame", 1, kMany);
  program
      .add_number<std::int64_t>("--max-frames", o.frames.max_frames, "Take at most N frames", 1,
                                kMany)
      ->default_str("all");
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

inline void add_model(lvggt::cli::Program& program, MakeTokensOptions& o) {
  constexpr std::int64_t kManyFrames = std::int64_t{1} << 20;
  CLI::App& app = program.app();
  program.add_number<std::int64_t>("--max-past-frames", o.stream.max_past_frames,
                                   "Past frames the model sees; memory and time grow with it", 1,
                                   kManyFrames);
  app.add_flag("--keep-first-frame", o.stream.window.keep_first,
               "When they are too many, never forget the first");
  program.add_number<std::int64_t>(
      "--keep-every", o.stream.window.keep_every,
      "When they are too many, forget every N-th last; 0: oldest first", 0, kManyFrames);
  app.add_option("--weights-storage", o.weights_storage,
                 "How weights are kept in memory: stored (as in their file), f32, bf16, f16 or "
                 "int8; narrower is less exact")
      ->check(CLI::IsMember({"stored", "f32", "bf16", "f16", "int8"}))
      ->type_name("TYPE")
      ->capture_default_str();
  app.add_option("--cache-storage", o.cache_storage,
                 "How past frames are kept in memory: f32, bf16 or int8; narrower is less exact")
      ->check(CLI::IsMember({"f32", "bf16", "int8"}))
      ->type_name("TYPE")
      ->capture_default_str();
  lvggt::cli::add_threads_option(program, o.threads);
  program.add_bytes("--memory-limit", o.memory_limit,
                    "Refuse to start if more is needed; otherwise what is free");
}

inline void add_outputs(lvggt::cli::Program& program, MakeTokensOptions& o) {
  CLI::App& app = program.app();
  app.add_option("--out", o.out,
                 "Folder for the tokens, SCENE/lvggt_tokens unless given; with --list, the folder "
                 "that gets one for each input")
      ->type_name("DIR");
  app.add_option("--storage", o.storage, "How tokens are kept on disk: bf16 or f32")
      ->check(CLI::IsMember({"bf16", "f32"}))
      ->type_name("TYPE")
      ->capture_default_str();
  app.add_flag("--force", o.force, "Replace the tokens in that folder");
  app.add_flag("--resume", o.resume,
               "Continue an interrupted run: files that are there stay. All frames are computed "
               "again, because each depends on those before; the result is the same to the bit");
  app.add_flag("--dry-run", o.dry_run, "Print the plan (frames, sizes, memory, disk) and stop");
  app.add_option("--shard", o.shard_text, "With --list: take only every N-th input, from the I-th")
      ->type_name("I/N");
  app.add_flag("--retry-failed", o.list_options.retry_failed,
               "With --list: also try what failed in earlier runs");
}

}  // namespace make_tokens_options

inline void add_make_tokens_options(lvggt::cli::Program& program, MakeTokensOptions& options) {
  make_tokens_options::add_inputs(program, options);
  make_tokens_options::add_frames(program, options);
  make_tokens_options::add_model(program, options);
  make_tokens_options::add_outputs(program, options);
  program.app().footer(
      std::string("The folder gets NAME.safetensors for each frame (tap.0 to tap.3, [h*w, 2C]: the "
                  "patch tokens of the\nfour layers that the decoder reads) and manifest.json: "
                  "weights, sizes, window, and a hash of every picture.\nTraining refuses tokens "
                  "that were made with other weights, settings or pictures, and says what "
                  "differs.\n\n") +
      lvggt::cli::kListHelp +
      "\n\nExit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input, 4 memory or a "
      "limit,\n5 partial result (the video ends early, or inputs of the list failed), 130 "
      "interrupted.\n\n"
      "Examples:\n"
      "  make_tokens scenes/americano --weights model.safetensors\n"
      "  make_tokens --list scenes.txt --weights model.safetensors");
}
