// SPDX-License-Identifier: Apache-2.0
#include "examples/train_autoencoder/options.h"

#include <limits>

#include "lvggt/cli/threads.h"
#include "lvggt/data/scene.h"

namespace train_autoencoder {

using namespace lvggt;

void Options::settle() {
  const auto usage = [](bool ok, const auto&... message) {
    if (!ok) fail(ErrorKind::kUsage, message...);
  };
  if (!list.empty())
    for (std::string& scene : read_list_file(list)) scenes.push_back(std::move(scene));
  usage(!scenes.empty(), "give at least one scene, as an argument or in --list");
  kind();
  usage(!output.empty(), "--output names the folder of the training");
  usage(encode_root.empty() || encode, "--encode-root needs --encode");
  usage(!resume || !force, "--resume and --force exclude each other");
  usage(candidates <= epochs, "--candidates is ", candidates, " of only ", epochs, " epochs");
  if (learning_rate == 0) learning_rate = kind() == Supervision::kClip ? 7e-4 : 7e-5;
  if (cosine_weight < 0) cosine_weight = kind() == Supervision::kClip ? 1e-3 : 1e-2;
}

SplitOptions Options::split() const {
  SplitOptions split;
  if (!held_out_frames.empty())
    split.held_out = FrameRanges::parse(held_out_frames, "--held-out-frames");
  split.hold_out_every = hold_out_every;
  return split;
}

AutoencoderShape Options::shape(std::int64_t features) const {
  AutoencoderShape shape =
      kind() == Supervision::kClip ? AutoencoderShape::clip() : AutoencoderShape::dynamic();
  if (!encoder.empty()) {
    shape.encoder = encoder;
    shape.code = encoder.back();
  }
  if (!decoder.empty()) shape.decoder = decoder;
  shape.features = features;
  if (shape.decoder.back() != features)
    fail(ErrorKind::kUsage, "the features have ", features, " numbers, but the decoder (",
         decoder.empty() ? "published widths; --decoder-widths changes them" : "--decoder-widths",
         ") ends in ", shape.decoder.back());
  return shape;
}

AutoencoderTrainOptions Options::train() const {
  AutoencoderTrainOptions train;
  train.cosine_weight = cosine_weight;
  train.learning_rate = learning_rate;
  return train;
}

std::vector<std::pair<std::string, std::string>> Options::settings() const {
  const auto number = [](const auto& value) { return concat(value); };
  return {{"supervision", supervision},
          {"learning rate", number(learning_rate)},
          {"weight of the cosine", number(cosine_weight)},
          {"batch size", number(batch)},
          {"epochs", number(epochs)},
          {"candidates", number(candidates)},
          {"seed", number(seed)}};
}

namespace {

void add_training_options(cli::Program& program, Options& options) {
  CLI::App& app = program.app();
  const std::string group = "Training";
  constexpr std::int64_t kMany = 1'000'000;
  app.add_option("--encoder-widths", options.encoder,
                 "Outputs of the encoder's layers, the last one the code's; else as published")
      ->delimiter(',')
      ->check(CLI::Range(std::int64_t{1}, kMany))
      ->type_name("N,N,...")
      ->group(group);
  app.add_option("--decoder-widths", options.decoder,
                 "Outputs of the decoder's layers, the last one the features'; else as published")
      ->delimiter(',')
      ->check(CLI::Range(std::int64_t{1}, kMany))
      ->type_name("N,N,...")
      ->group(group);
  program
      .add_number("--learning-rate", options.learning_rate,
                  "Adam's; else 7e-4 for clip, 7e-5 for dynamic", 1e-12, 1e3, "LR")
      ->default_str("")
      ->group(group);
  program
      .add_number("--loss-cos", options.cosine_weight,
                  "Weight of 1 - cosine beside the mean squared error; else 1e-3 for clip, 1e-2 "
                  "for dynamic",
                  0.0, 1e6, "C")
      ->default_str("")
      ->group(group);
  program.add_number("--batch", options.batch, "Features in a step", std::int64_t{2}, kMany)
      ->group(group);
  program
      .add_number("--epochs", options.epochs, "Passes over all features", std::int64_t{1}, kMany)
      ->group(group);
  program
      .add_number("--candidates", options.candidates,
                  "The best of this many last epochs is kept, by mean squared error + 1 - cosine",
                  std::int64_t{1}, kMany)
      ->group(group);
  program
      .add_number("--seed", options.seed, "Of the starting weights and the order", std::uint64_t{0},
                  std::numeric_limits<std::uint64_t>::max())
      ->group(group);
}

void add_encoding_options(cli::Program& program, Options& options) {
  CLI::App& app = program.app();
  const std::string group = "Encoding";
  app.add_flag("--encode", options.encode,
               "Afterwards write the features of all frames in compact form, into the folder that "
               "train_decoder reads; make_features does so with an autoencoder from elsewhere")
      ->group(group);
  app.add_option("--encode-root", options.encode_root,
                 "Write them there instead of into the scene; for several scenes, into a folder of "
                 "each one's name")
      ->type_name("DIR")
      ->group(group);
}

}  // namespace

void add_options(cli::Program& program, Options& options) {
  CLI::App& app = program.app();
  app.add_option("scenes", options.scenes, "Labelled scenes with clip_features or video_features")
      ->type_name("SCENE");
  app.add_option("--list", options.list, "File that names more scenes, one a line")
      ->type_name("FILE");
  app.add_option("--supervision", options.supervision,
                 "clip: what objects are (clip_features); dynamic: what they do (video_features)")
      ->type_name("KIND")
      ->capture_default_str();
  app.add_option("--held-out-frames", options.held_out_frames,
                 "Frames that are not learnt from but tested on, such as 49-72")
      ->type_name("RANGES");
  program.add_number("--hold-out-every", options.hold_out_every,
                     "Every N-th frame of a scene is tested on", std::int64_t{0},
                     std::int64_t{1'000'000});
  app.add_option("--output", options.output, "Folder for autoencoder.safetensors, log and curve")
      ->type_name("DIR");
  add_training_options(program, options);
  add_encoding_options(program, options);
  program.add_number("--checkpoint-every", options.checkpoint_every, "Epochs between checkpoints",
                     std::int64_t{1}, std::int64_t{1'000'000});
  app.add_flag("--resume", options.resume, "Go on with an interrupted run");
  app.add_flag("--force", options.force, "Replace an earlier run and earlier codes");
  app.add_flag("--dry-run", options.dry_run, "Print data, shape and memory, and stop");
  program.add_bytes("--memory-limit", options.memory_limit,
                    "Refuse to start if more is needed; else what is free");
  cli::add_threads_option(program, options.threads);
  app.footer(
      "Exit status: 0 done, 1 failed, 2 wrong usage, 3 bad input, 4 memory, 130 interrupted "
      "(--resume goes on).");
}

}  // namespace train_autoencoder
