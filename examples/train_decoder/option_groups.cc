// SPDX-License-Identifier: Apache-2.0
#include "examples/train_decoder/option_groups.h"

#include <limits>

#include "lvggt/cli/threads.h"

namespace train_decoder {
namespace {

using lvggt::cli::Program;

constexpr std::int64_t kMany = std::int64_t{1} << 40;

CLI::Option* add_word(Program& program, const std::string& option, std::string& value,
                      const std::vector<std::string>& words, const std::string& description) {
  return program.app()
      .add_option(option, value, description)
      ->check(CLI::IsMember(words))
      ->type_name("WORD");
}

void add_data(Program& program, Options& o) {
  CLI::App& app = program.app();
  app.add_option("SCENE", o.scenes,
                 "Folders of labelled scenes (rgb/2x/000001.png, clip_features.../000001_s.npy)");
  app.add_option("--list", o.list, "A file that names more scenes, one a line")->type_name("FILE");
  app.add_option("--tokens", o.tokens,
                 "Folder of the tokens that make_tokens wrote: that of the only scene, or one that "
                 "holds a folder named as each scene; otherwise SCENE/lvggt_tokens")
      ->type_name("DIR");
  app.add_option("--weights", o.weights,
                 "Refuse tokens that were not made with these geometry weights")
      ->type_name("FILE");
  add_word(program, "--supervision", o.supervision, {"clip", "dynamic"},
           "What is learned: clip (time-agnostic, three levels) or dynamic (the state of each "
           "object in each frame, one level)")
      ->capture_default_str();
  program.add_number<std::int64_t>("--dim", o.dim, "Numbers a compact code has (..._dim3)", 1, 512)
      ->default_str("3 for clip, 6 for dynamic");
  app.add_option("--train-frames", o.train_frames,
                 "Frames to train on, by the numbers in their file names, as in 1-48,60; otherwise "
                 "all that are not held out")
      ->type_name("RANGES");
  app.add_option("--held-out-frames", o.held_out_frames,
                 "Frames to test on and never to train on, as in 49-72")
      ->type_name("RANGES");
  program.add_number<std::int64_t>("--hold-out-every", o.hold_out_every,
                                   "Hold out every N-th frame of each scene instead; 0: none", 0,
                                   kMany);
  add_word(program, "--target", o.target, {"frame", "original"},
           "Pixels the loss is taken over: those the encoder saw, or those of the picture")
      ->capture_default_str();
  app.add_flag("--skip-label-check", o.skip_label_check,
               "Do not read every label map before training starts");
}

void add_model(Program& program, Options& o) {
  CLI::App& app = program.app();
  app.add_option("--config", o.config,
                 "The model's configuration; its sbd_... keys describe the decoder")
      ->type_name("JSON");
  app.add_option("--decoder", o.decoder,
                 "Start from this decoder instead of random weights: safetensors, also a release's "
                 ".pth that weights_convert converted")
      ->type_name("FILE");
  program
      .add_number<std::int64_t>("--features", o.features, "Channels of the DPT features", 2, 8192)
      ->default_str("the configuration's, 128 as published");
  program
      .add_number<std::int64_t>("--hidden", o.hidden, "Channels of the UNets' first stage", 1, 4096)
      ->default_str("the configuration's, 32 as published");
  app.add_option("--out-channels", o.out_channels, "Channels of the four maps the DPT starts from")
      ->expected(4)
      ->delimiter(',')
      ->check(CLI::Range(1, 65536).description(""))
      ->type_name("N")
      ->default_str("the configuration's, 256,512,1024,1024 as published");
  add_word(program, "--head", o.head, {"unet", "mlp"},
           "Heads: UNets, or the paper's ablation with 1x1 convolutions")
      ->default_str("unet");
  app.add_flag("--no-dpt", o.no_dpt,
               "Ablation: the last tap's tokens projected by a 1x1 convolution instead of the DPT");
  app.add_flag("--no-rgb", o.no_rgb, "Ablation: no RGB head and no RGB loss");
}

void add_losses(Program& program, Options& o) {
  lvggt::LossWeights& loss = o.train.loss;
  program.add_number<double>("--alpha", o.alpha, "Weight of the language loss", 0, 1e6);
  program.add_number<double>("--beta", o.beta, "Weight of the RGB loss", 0, 1e6);
  program.add_number<double>("--loss-l1", loss.l1, "Weight of L1 in the language loss", 0, 1e6);
  program.add_number<double>("--loss-cos", loss.cos, "Weight of 1 - cosine in it", 0, 1e6);
  program.add_number<double>("--loss-rgb-l1", loss.img_l1, "Weight of L1 in the RGB loss", 0, 1e6);
  program.add_number<double>("--loss-rgb-l2", loss.img_l2, "Weight of L2 in it", 0, 1e6);
  add_word(program, "--cosine-axis", o.cosine_axis, {"feature", "width"},
           "Axis of the cosine: that of the features, as in the paper, or the image's width, as "
           "the released script has it")
      ->capture_default_str();
}

void add_optimiser(Program& program, Options& o) {
  lvggt::Schedule& s = o.train.schedule;
  lvggt::AdamWOptions& adamw = o.train.adamw;
  program.add_number<double>("--learning-rate", s.learning_rate, "After the warm-up", 1e-12, 10);
  add_word(program, "--schedule", o.schedule, {"constant", "cosine"},
           "The learning rate after the warm-up")
      ->capture_default_str();
  program.add_number<double>("--min-learning-rate", s.min_learning_rate, "Where the cosine ends", 0,
                             10);
  program.add_number<double>("--warmup-epochs", o.warmup_epochs, "Epochs over which the rate rises",
                             0, 1e6);
  program.add_number<std::int64_t>("--warmup-steps", o.warmup_steps, "The same in steps", 0, kMany)
      ->default_str("");
  program.add_number<double>("--weight-decay", adamw.weight_decay, "Of weights, not of biases", 0,
                             10);
  program.add_number<double>("--beta1", adamw.beta1, "Decay of AdamW's first moment", 0, 0.999999);
  program.add_number<double>("--beta2", adamw.beta2, "Decay of its second moment", 0, 0.9999999);
  program.add_number<double>("--eps", adamw.eps, "AdamW's guard against division by 0", 1e-30, 1);
  program.add_number<double>("--max-grad-norm", o.train.max_grad_norm,
                             "Clip the gradient to this global norm; 0: do not", 0, 1e12);
  program.add_number<double>("--ema", o.train.ema_decay,
                             "Decay of a moving average of the weights, which is then what is "
                             "tested and saved as the decoder; 0: none",
                             0, 0.9999999);
  program.add_number<std::int64_t>("--batch", o.batch, "Frames a step, over all ranks", 1, 65536);
  program.add_number<std::int64_t>(
      "--accumulate", o.train.accumulate,
      "Process a batch in N parts to save memory; batch norms then see "
      "the statistics of one part only",
      1, 65536);
  add_word(program, "--batch-norm", o.batch_norm, {"synchronised", "per-rank", "frozen"},
           "synchronised: batch statistics, with several ranks over all of them; per-rank: each "
           "its own, as the release; frozen: the running statistics, which stay as they are")
      ->capture_default_str();
  program.add_number<std::int64_t>("--epochs", o.epochs, "Passes over the frames", 1, kMany)
      ->default_str("100");
  program.add_number<std::int64_t>("--steps", o.steps, "Or this many steps", 1, kMany)
      ->default_str("");
  program.add_number<std::uint64_t>("--seed", o.seed, "Of the weights and of the frames' order", 0,
                                    std::numeric_limits<std::uint64_t>::max());
  program.app().add_flag("--keep-last-batch", o.keep_last_batch,
                         "Also train on the frames left over at the end of an epoch");
}

void add_running(Program& program, Options& o) {
  CLI::App& app = program.app();
  app.add_option("--output", o.output,
                 "Folder for checkpoints, log and pictures; its parent exists")
      ->type_name("DIR");
  app.add_flag("--resume", o.resume, "Go on from the newest intact checkpoint in that folder");
  app.add_flag(
      "--force", o.force,
      "Replace an earlier run in that folder; with --resume, go on although settings differ");
  app.add_flag("--dry-run", o.dry_run, "Check the data, print the plan and stop");
  program
      .add_number<std::int64_t>("--evaluate-every", o.evaluate_every,
                                "Steps between tests on the held-out frames, each with a contact "
                                "sheet",
                                1, kMany)
      ->default_str("ten times a run");
  program
      .add_number<std::int64_t>("--checkpoint-every", o.checkpoint_every,
                                "Steps between checkpoints", 1, kMany)
      ->default_str("as --evaluate-every");
  program.add_number<std::int64_t>("--keep", o.keep, "Checkpoints to keep, beside the best one", 1,
                                   kMany);
  program.add_number<std::int64_t>("--sheet-columns", o.sheet_columns, "Frames on a contact sheet",
                                   1, 64);
  app.add_flag("--csv", o.csv, "Also write the log as a table, log.csv, at the end");
  app.add_flag("--checkpoint-activations", o.checkpoint_activations,
               "Recompute activations in the backward pass: less memory, more time");
  program.add_number<double>("--outlier-z", o.outlier_z,
                             "Refuse a step whose loss or gradient norm is this many standard "
                             "deviations above the last 128; 0: never",
                             0, 1e6);
  program.add_number<std::int64_t>("--max-refused", o.max_refused,
                                   "Stop after so many refused steps in a row", 1, kMany);
  program.add_number<std::int64_t>("--loader-threads", o.loader_threads,
                                   "Threads that read frames ahead", 1, 256);
  lvggt::cli::add_threads_option(program, o.threads);
  program.add_number<double>("--rank-timeout", o.rank_timeout,
                             "With several ranks: seconds to wait for the others", 1, 1e6);
  program.add_bytes("--memory-limit", o.memory_limit,
                    "Refuse to start if more is needed; otherwise what is free");
}

// Puts the options that were added since the last call under a heading of their own.
void name_group(Program& program, const std::string& heading) {
  for (CLI::Option* option : program.app().get_options()) {
    const bool positional = option->get_positional();
    const std::string name = option->get_name();
    if (!positional && name != "--help" && name != "-h,--help" && name != "--version" &&
        option->get_group() == "Options")
      option->group(heading);
  }
}

}  // namespace

void add_options(Program& program, Options& options) {
  add_data(program, options);
  name_group(program, "Data");
  add_model(program, options);
  name_group(program, "Decoder");
  add_losses(program, options);
  name_group(program, "Losses");
  add_optimiser(program, options);
  name_group(program, "Optimiser and schedule");
  add_running(program, options);
  name_group(program, "Running");
  program.app().footer(
      "A run, from labelled scene to language field:\n"
      "  make_tokens scene --weights model.safetensors            once: what the frozen encoder "
      "sees\n"
      "  train_decoder scene --held-out-frames 49-72 --output run\n"
      "  lift_video clip.mp4 --weights model.safetensors --decoder run/decoder.safetensors --out "
      "clip\n"
      "\n"
      "In the output folder: decoder.safetensors and best.safetensors (by held-out score) for\n"
      "lift_video, checkpoints/, log.jsonl, held_out_*.png, loss.png, run.json.\n"
      "Ctrl-C or SIGTERM writes a checkpoint and stops; --resume goes on, bit for bit.\n"
      "Several processes: mpirun -n 4 train_decoder ... (the batch is divided among them).\n"
      "\n"
      "Exit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input, 4 memory or a\n"
      "limit, 130 interrupted.");
}

}  // namespace train_decoder
