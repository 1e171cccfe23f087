// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "examples/lift_options.h"
#include "lvggt/cli/memory_check.h"
#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/progress.h"
#include "lvggt/cli/threads.h"
#include "lvggt/data/token_cache.h"
#include "lvggt/io/video.h"
#include "lvggt/lvggt.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/time_plan.h"

// What lift_video knows before it starts: the input, its size, the memory the run will need.
namespace lift_plan {

using namespace lvggt;

// The input with its first frame, which tells the size of all.
struct Input {
  std::unique_ptr<FrameSource> source;
  std::optional<InputFrame> next;
  ImageTransform transform;
};

inline Input open_input(const LiftOptions& options) {
  Input input;
  input.source = open_frames(options.video, options.frames, open_video);
  input.next = input.source->next();
  if (!input.next) fail(ErrorKind::kFormat, options.video, ": holds no frames");
  input.transform =
      plan_frame(input.next->image.width(), input.next->image.height(), options.preprocess);
  return input;
}

// The files of the model, names and shapes only, and what their decoders are: known before anything
// large is read.
class ModelFiles {
 public:
  explicit ModelFiles(const LoadOptions& options) : checkpoint_(options) {
    if (options.state_decoder.empty()) return;
    LoadOptions alone = options;
    alone.decoder = options.state_decoder;
    state_.emplace(alone, checkpoint_.config());
  }
  const Checkpoint& checkpoint() const { return checkpoint_; }
  const Checkpoint* state() const { return state_ ? &*state_ : nullptr; }

 private:
  Checkpoint checkpoint_;
  std::optional<Checkpoint> state_;
};

// Levels and values of the decoders that run.
struct DecoderSizes {
  std::int64_t levels = 0, dim = 0, state_levels = 0, state_dim = 0;
  std::int64_t maps() const { return levels + state_levels; }
  std::int64_t values() const { return levels * dim + state_levels * state_dim; }
};

inline DecoderSizes decoder_sizes(const ModelFiles& files, const StreamOptions& stream) {
  DecoderSizes sizes;
  if (!stream.decoder) return sizes;
  if (files.checkpoint().has_decoder()) {
    sizes.levels = files.checkpoint().config().sbd_levels;
    sizes.dim = files.checkpoint().config().lang_dim;
  }
  if (files.state() != nullptr) {
    sizes.state_levels = files.state()->config().sbd_levels;
    sizes.state_dim = files.state()->config().lang_dim;
  }
  return sizes;
}

// What the files of the run hold. Hashes the decoders whose codes are written.
inline RunFormat run_format(const LiftOptions& options, const Input& input, const ModelFiles& files,
                            Context& ctx) {
  RunFormat format;
  format.transform = input.transform;
  const DecoderSizes decoders = decoder_sizes(files, options.stream);
  format.levels = decoders.levels;
  format.lang_dim = decoders.dim;
  format.state_levels = decoders.state_levels;
  format.state_dim = decoders.state_dim;
  format.has_rgb = (decoders.levels > 0 && files.checkpoint().config().sbd_rgb) ||
                   (decoders.state_levels > 0 && files.state()->config().sbd_rgb);
  if (options.outputs.codes && decoders.levels > 0)
    format.decoder_sha256 = decoder_sha256(files.checkpoint(), ctx);
  if (options.outputs.codes && decoders.state_levels > 0)
    format.state_sha256 = decoder_sha256(*files.state(), ctx);
  format.names_are_files = input.next->name != concat("frame ", input.next->source_index);
  format.expected_frames = input.source->expected_frames();
  const std::filesystem::path path(cli::without_trailing_slashes(options.video));
  format.title = concat(path.filename().string(), "   ", input.transform.width, " x ",
                        input.transform.height, " pixels");
  format.footer =
      "depth and confidence: blue low, red high; semantics: one basis for the whole video";
  return format;
}

// Memory beside the model's: what this process holds by now (its libraries, the decoder of the
// video, the first frame), the code it has yet to touch, the point cloud, the pictures of a frame
// and of the contact sheet, and the decoding of the original.
inline std::size_t program_bytes(const ImageTransform& transform, std::size_t frames,
                                 const DecoderSizes& decoders) {
  constexpr std::size_t kCode = std::size_t{18} << 20;
  const auto width = static_cast<std::size_t>(transform.width);
  const auto height = static_cast<std::size_t>(transform.height);
  const std::size_t pixels = width * height;
  const auto original = static_cast<std::size_t>(transform.original_width) *
                        static_cast<std::size_t>(transform.original_height);
  // Vectors of the points and a picture of each map; codes go to disk as they are.
  const auto semantics =
      static_cast<std::size_t>(4 * decoders.levels * decoders.dim + 3 * decoders.maps());
  // The contact sheet keeps up to 16 frames, each with four pictures and the levels.
  constexpr std::size_t kSheetFrames = 16, kSheetCellWidth = 176;
  const std::size_t cell_width = std::min<std::size_t>(width, kSheetCellWidth);
  const std::size_t cell = cell_width * (cell_width * height / width + 1) * 3;
  const std::size_t sheet =
      std::min(frames, kSheetFrames) * (4 + static_cast<std::size_t>(decoders.maps())) * cell;
  // Before the first video of a list: later ones find the model there.
  static const std::size_t process = cli::resident_bytes();
  return process + kCode + pixels * (80 + semantics) + original * 24 + sheet;
}

struct Plan {
  MemoryPlan model;
  std::size_t total = 0;
};

// Memory of the run with other options.
using PlanOf = std::function<std::size_t(const LiftOptions&)>;

// A second decoder: its weights and outputs come on top, scratch memory is used in turn.
inline void add_state_decoder(MemoryPlan& plan, const Checkpoint& state, const LiftOptions& options,
                              const ImageTransform& transform) {
  const ModelConfig& config = state.config();
  const auto plan_with = [&](bool decoder) {
    StreamOptions some = options.stream;
    some.max_past_frames = 1;
    some.decoder = decoder;
    // The geometry's weights cancel out, whatever their storage.
    return plan_memory(
        config, transform.height, transform.width, some, [&](const std::string& weight) {
          if (options.weights.storage) return options.weights.storage->of_weight(weight);
          return is_decoder_tensor(weight) ? state.storage_of(weight) : Storage::kF32;
        });
  };
  const MemoryPlan with = plan_with(true);
  plan.weights += with.weights - plan_with(false).weights;
  if (!options.stream.decoder) return;
  const auto pixels =
      static_cast<std::size_t>(transform.width) * static_cast<std::size_t>(transform.height);
  const auto maps = static_cast<std::size_t>(config.sbd_levels * config.lang_dim) * pixels;
  plan.arenas = std::max(plan.arenas, with.arenas) + maps * sizeof(float);
}

inline Plan plan_run(const ModelFiles& files, const LiftOptions& options,
                     const ImageTransform& transform, std::int64_t past_frames,
                     std::size_t num_frames) {
  StreamOptions stream = options.stream;
  stream.max_past_frames = past_frames;
  const auto plan_with = [&](const Checkpoint& checkpoint, bool decoder) {
    StreamOptions some = stream;
    some.decoder = decoder;
    return plan_memory(checkpoint.config(), transform.height, transform.width, some,
                       [&](const std::string& weight) {
                         return options.weights.storage ? options.weights.storage->of_weight(weight)
                                                        : checkpoint.storage_of(weight);
                       });
  };
  // A decoder that is there is loaded, also if it will not run.
  const Checkpoint& checkpoint = files.checkpoint();
  const bool runs = stream.decoder && checkpoint.has_decoder();
  Plan plan{plan_with(checkpoint, runs), 0};
  plan.model.weights = plan_with(checkpoint, checkpoint.has_decoder()).weights;
  if (files.state() != nullptr) add_state_decoder(plan.model, *files.state(), options, transform);
  plan.model.total = plan.model.weights + plan.model.cache + plan.model.arenas;
  plan.total =
      plan.model.total + program_bytes(transform, num_frames, decoder_sizes(files, options.stream));
  return plan;
}

// Frames of the run; many where the input does not tell.
inline std::size_t num_frames(const Input& input) {
  const std::int64_t expected = input.source->expected_frames();
  return static_cast<std::size_t>(expected > 0 ? expected : kMaxPastFrames);
}

// Past frames that the last frame of this run can see.
inline std::int64_t reachable_past_frames(const LiftOptions& options, const Input& input) {
  const std::int64_t expected = input.source->expected_frames();
  const std::int64_t past = options.stream.max_past_frames;
  return expected > 0 ? std::min(past, expected - 1) : past;
}

inline std::string breakdown(const Plan& plan) {
  return "weights " + cli::bytes_text(plan.model.weights) + ", cache of past frames " +
         cli::bytes_text(plan.model.cache) + ", work and outputs " +
         cli::bytes_text(plan.total - plan.model.weights - plan.model.cache);
}

// Narrower storage that the run could have, from the mildest to the narrowest.
inline std::vector<cli::MemoryChoice> storage_choices(const LiftOptions& options,
                                                      const PlanOf& plan_of) {
  std::vector<cli::MemoryChoice> choices;
  for (const auto& [weights, cache] : {std::pair{"", "bf16"},
                                       {"bf16", ""},
                                       {"bf16", "bf16"},
                                       {"", "int8"},
                                       {"bf16", "int8"},
                                       {"int8", "bf16"},
                                       {"int8", "int8"}}) {
    LiftOptions narrow = options;
    std::string words;
    if (*weights != 0) {
      narrow.weights.storage = StoragePolicy::of(parse_storage(weights, ""));
      words = concat("--weights-storage ", weights);
    }
    if (*cache != 0) {
      narrow.stream.cache_storage = parse_storage(cache, "");
      words += concat(words.empty() ? "" : " ", "--cache-storage ", cache);
    }
    choices.push_back({words, plan_of(narrow)});
  }
  return choices;
}

// Refuses the run when it needs more memory than it may have, and says which options would fit.
inline void check_plan(const Plan& plan, const ModelFiles& files, const LiftOptions& options,
                       const Input& input) {
  // What this process holds already is part of the plan.
  const cli::MemoryLimit limit = cli::memory_limit(options.memory_limit, cli::resident_bytes());
  const std::int64_t past = reachable_past_frames(options, input);
  const auto total = [&](const LiftOptions& changed, const ImageTransform& transform,
                         std::int64_t frames) {
    return plan_run(files, changed, transform, frames, num_frames(input)).total;
  };
  std::vector<cli::MemoryKnob> knobs;
  knobs.push_back({"--max-past-frames", 1, std::max<std::int64_t>(past, 1), 1,
                   [&](std::int64_t frames) { return total(options, input.transform, frames); }});
  const auto choices = storage_choices(
      options, [&](const LiftOptions& narrow) { return total(narrow, input.transform, past); });
  LiftOptions narrowest = options;
  narrowest.weights.storage = StoragePolicy::of(Storage::kI8);
  narrowest.stream.cache_storage = Storage::kI8;
  const bool storage_fits =
      std::any_of(choices.begin(), choices.end(),
                  [&](const cli::MemoryChoice& choice) { return choice.bytes <= limit.bytes; });
  if (!storage_fits)
    knobs.push_back({"--weights-storage int8 --cache-storage int8 --max-past-frames", 1,
                     std::max<std::int64_t>(past, 1), 1, [&](std::int64_t frames) {
                       return total(narrowest, input.transform, frames);
                     }});
  if (options.preprocess.mode != FrameMode::kOriginal)
    knobs.push_back(
        {"--size", 4 * kPatchSize, options.preprocess.size, kPatchSize, [&](std::int64_t size) {
           PreprocessOptions smaller = options.preprocess;
           smaller.size = static_cast<int>(size);
           const Image& image = input.next->image;
           return total(options, plan_frame(image.width(), image.height(), smaller), past);
         }});
  cli::check_memory(plan.total, limit, breakdown(plan), knobs, choices);
}

// How long the frames of the run will take, from a few layers timed on this machine.
inline void print_times(const LiftOptions& options, const Input& input, const ModelFiles& files,
                        int threads) {
  StreamOptions stream = options.stream;
  stream.max_past_frames = reachable_past_frames(options, input);
  Context ctx(threads);
  const auto plan_with = [&](const ModelConfig& config, bool decoder) {
    StreamOptions some = stream;
    some.decoder = decoder;
    return plan_time(
        config, input.transform.height, input.transform.width, some,
        [&](const std::string& weight) {
          if (!decoder || &config == &files.checkpoint().config())
            return files.checkpoint().storage_of(weight);
          return is_decoder_tensor(weight) ? files.state()->storage_of(weight)
                                           : files.checkpoint().storage_of(weight);
        },
        ctx);
  };
  TimePlan plan =
      plan_with(files.checkpoint().config(), stream.decoder && files.checkpoint().has_decoder());
  if (stream.decoder && files.state() != nullptr) {
    const double decoder = std::max(0.0, plan_with(files.state()->config(), true).first_frame -
                                             plan_with(files.state()->config(), false).first_frame);
    plan.first_frame += decoder;
    plan.full_window += decoder;
  }
  const auto text = [](double seconds) { return cli::fixed(seconds, seconds < 1 ? 3 : 1) + " s"; };
  std::printf(
      "time          about %s of model time for the first frame, %s with %lld past frames\n",
      text(plan.first_frame).c_str(), text(plan.full_window).c_str(),
      static_cast<long long>(stream.max_past_frames));
}

// "with the decoder", "with the decoder and the state decoder", ...
inline std::string decoders_in_words(const DecoderSizes& sizes) {
  if (sizes.maps() == 0) return "geometry only";
  std::string words;
  if (sizes.levels > 0)
    words = concat("with the decoder (", sizes.levels, " x ", sizes.dim, " values a pixel)");
  if (sizes.state_levels > 0)
    words += concat(words.empty() ? "with" : " and", " the state decoder (", sizes.state_levels,
                    " x ", sizes.state_dim, ")");
  return words;
}

inline void print_plan(const LiftOptions& options, const Input& input, const Plan& plan,
                       const ModelFiles& files, const cli::ThreadChoice& threads) {
  const ModelConfig& config = files.checkpoint().config();
  const DecoderSizes decoders = decoder_sizes(files, options.stream);
  const ImageTransform& t = input.transform;
  const std::int64_t frames = input.source->expected_frames();
  std::printf("input         %s: %s frames of %d x %d\n", options.video.c_str(),
              frames < 0 ? "an unknown number of" : std::to_string(frames).c_str(),
              t.original_width, t.original_height);
  std::printf("model frames  %d x %d (mode %s)\n", t.width, t.height, options.mode.c_str());
  std::printf("model         %lld aggregator layers of width %lld, %s\n",
              static_cast<long long>(config.agg_depth), static_cast<long long>(config.embed_dim),
              decoders_in_words(decoders).c_str());
  if (options.outputs.codes && decoders.maps() > 0)
    std::printf(
        "codes         %s a frame, for queries\n",
        cli::bytes_text(2 * static_cast<std::size_t>(decoders.values() * t.width * t.height))
            .c_str());
  std::printf("past frames   %lld at most\n",
              static_cast<long long>(options.stream.max_past_frames));
  std::printf("threads       %d (%s)\n", threads.threads, threads.reason.c_str());
  std::printf("memory        about %s (%s)\n", cli::bytes_text(plan.total).c_str(),
              breakdown(plan).c_str());
  std::printf("available     %s\n", cli::bytes_text(cli::available_memory().bytes).c_str());
}

}  // namespace lift_plan
