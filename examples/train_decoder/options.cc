// SPDX-License-Identifier: Apache-2.0
#include "examples/train_decoder/options.h"

#include <map>

#include "lvggt/core/error.h"
#include "lvggt/data/scene.h"
#include "lvggt/data/supervision.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/safetensors.h"

namespace train_decoder {

using namespace lvggt;

void Options::settle() {
  if (force && resume && dry_run)
    fail(ErrorKind::kUsage, "--dry-run starts nothing, so it needs neither --resume nor --force");
  if (output.empty() && !dry_run)
    fail(ErrorKind::kUsage, "--output is required (except with --dry-run)");
  if (!list.empty())
    for (const std::string& scene : read_list_file(list)) scenes.push_back(scene);
  if (!decoder.empty()) decoder_sha256 = sha256_file(decoder);
  if (scenes.empty()) fail(ErrorKind::kUsage, "no scene is given: name folders, or use --list");
  if (steps > 0 && epochs > 0) fail(ErrorKind::kUsage, "--steps and --epochs exclude each other");
  if (steps == 0 && epochs == 0) epochs = 100;
  train.loss.l1 *= alpha;
  train.loss.cos *= alpha;
  train.loss.img_l1 *= beta;
  train.loss.img_l2 *= beta;
  train.cosine_over_width = cosine_axis == "width";
  train.schedule.decay = schedule == "cosine" ? Decay::kCosine : Decay::kConstant;
  train.activations =
      checkpoint_activations ? CheckpointActivations::kRecompute : CheckpointActivations::kKeep;
  train.synchronise_batch_norm = batch_norm == "synchronised";
  train.frozen_batch_norm = batch_norm == "frozen";
  if (batch % train.accumulate != 0)
    fail(ErrorKind::kUsage, "--accumulate: ", train.accumulate, " parts do not divide a batch of ",
         batch);
}

TrainingSetOptions Options::training_set() const {
  TrainingSetOptions set;
  set.scenes = scenes;
  set.tokens = tokens;
  set.supervision.kind = parse_supervision(supervision);
  const bool dynamic = set.supervision.kind == Supervision::kDynamic;
  set.supervision.dim = dim > 0 ? dim : dynamic ? 6 : 3;
  if (!train_frames.empty()) set.split.train = FrameRanges::parse(train_frames, "--train-frames");
  if (!held_out_frames.empty())
    set.split.held_out = FrameRanges::parse(held_out_frames, "--held-out-frames");
  set.split.hold_out_every = hold_out_every;
  set.target = target == "original" ? TargetSize::kOriginal : TargetSize::kModelFrame;
  set.check_labels = !skip_label_check;
  return set;
}

ModelConfig Options::decoder_config(const ModelConfig& encoder) const {
  ModelConfig result;
  std::string source = "the published configuration";
  if (!config.empty()) {
    result = load_config(config);
    source = config;
  } else if (!decoder.empty()) {
    const Safetensors file = Safetensors::open(decoder);
    if (const auto text = file.metadata().find("config"); text != file.metadata().end()) {
      source = decoder + ": configuration in the metadata";
      result = parse_config(text->second, source);
    }
  }
  // Without a configuration the decoder's own sizes are the published ones; with one, it must be
  // that of the encoder.
  const bool given = source != "the published configuration";
  LVGGT_CHECK(!given || (result.embed_dim == encoder.embed_dim &&
                         result.patch_size == encoder.patch_size && result.taps == encoder.taps),
              source, ": is for an encoder with embed_dim ", result.embed_dim,
              ", but the tokens were made with embed_dim ", encoder.embed_dim, " and patches of ",
              encoder.patch_size);
  const ModelConfig decoder_sizes = result;
  result = encoder;
  result.name = decoder_sizes.name;
  result.sbd_features = features > 0 ? features : decoder_sizes.sbd_features;
  result.sbd_hidden_dim = hidden > 0 ? hidden : decoder_sizes.sbd_hidden_dim;
  result.sbd_out_channels = decoder_sizes.sbd_out_channels;
  if (!out_channels.empty())
    for (std::size_t i = 0; i < 4; ++i) result.sbd_out_channels[i] = out_channels[i];
  result.sbd_rgb = decoder_sizes.sbd_rgb && !no_rgb;
  result.sbd_dpt = decoder_sizes.sbd_dpt && !no_dpt;
  result.sbd_head = head.empty()    ? decoder_sizes.sbd_head
                    : head == "mlp" ? DecoderHead::kMlp
                                    : DecoderHead::kUnet;
  result.bn_eps = decoder_sizes.bn_eps;
  result.bn_momentum = decoder_sizes.bn_momentum;
  result.dpt_ln_eps = decoder_sizes.dpt_ln_eps;
  const SupervisionSpec spec = training_set().supervision;
  result.lang_dim = spec.dim;
  result.sbd_levels = spec.levels();
  // What the decoder does not read stays as published or as the configuration has it.
  result.cam_heads = decoder_sizes.cam_heads;
  result.cam_trunk_depth = decoder_sizes.cam_trunk_depth;
  result.dpt_features = decoder_sizes.dpt_features;
  result.dpt_out_channels = decoder_sizes.dpt_out_channels;
  result.dpt_head_features_2 = decoder_sizes.dpt_head_features_2;
  validate_config(result, source);
  return result;
}

TrainingState::Named Options::settings() const {
  const auto number = [](auto value) {
    std::string text;
    append_number(text, value);
    return text;
  };
  const Schedule& s = train.schedule;
  TrainingState::Named named{{"loss_l1", number(train.loss.l1)},
                             {"loss_cos", number(train.loss.cos)},
                             {"loss_rgb_l1", number(train.loss.img_l1)},
                             {"loss_rgb_l2", number(train.loss.img_l2)},
                             {"cosine_axis", cosine_axis},
                             {"learning_rate", number(s.learning_rate)},
                             {"warmup_steps", number(s.warmup_steps)},
                             {"schedule", schedule},
                             {"weight_decay", number(train.adamw.weight_decay)},
                             {"beta1", number(train.adamw.beta1)},
                             {"beta2", number(train.adamw.beta2)},
                             {"eps", number(train.adamw.eps)},
                             {"max_grad_norm", number(train.max_grad_norm)},
                             {"ema", number(train.ema_decay)},
                             {"batch", number(batch)},
                             {"accumulate", number(train.accumulate)},
                             {"batch_norm", batch_norm},
                             {"seed", number(seed)},
                             {"last_batch", keep_last_batch ? "kept" : "dropped"},
                             {"outlier_z", number(outlier_z)},
                             {"started_from", decoder.empty() ? "seed" : decoder_sha256}};
  // A constant rate does not depend on when training ends, so that it may go on for longer.
  if (s.decay == Decay::kCosine) {
    named.emplace_back("total_steps", number(s.total_steps));
    named.emplace_back("min_learning_rate", number(s.min_learning_rate));
  }
  return named;
}

}  // namespace train_decoder
