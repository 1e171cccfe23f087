// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/decoder_trainer.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "lvggt/core/parallel.h"
#include "lvggt/model/parameters.h"
#include "lvggt/train/decoder.h"

namespace lvggt {
namespace {

void validate(const TrainOptions& o, const ParameterStore& store) {
  const auto usage = [](bool ok, const auto&... message) {
    if (!ok) fail(ErrorKind::kUsage, "training: ", message...);
  };
  validate_schedule(o.schedule);
  const auto weight = [](double w) { return w >= 0 && std::isfinite(w); };
  usage(weight(o.loss.l1) && weight(o.loss.cos) && weight(o.loss.img_l1) && weight(o.loss.img_l2),
        "the loss weights ", o.loss.l1, ", ", o.loss.cos, ", ", o.loss.img_l1, ", ", o.loss.img_l2,
        " are not all finite and at least 0");
  usage(o.adamw.beta1 >= 0 && o.adamw.beta1 < 1 && o.adamw.beta2 >= 0 && o.adamw.beta2 < 1,
        "AdamW's betas ", o.adamw.beta1, " and ", o.adamw.beta2, " do not lie in [0, 1)");
  usage(o.adamw.eps > 0, "AdamW's eps is ", o.adamw.eps, ", not above 0");
  usage(o.adamw.weight_decay >= 0, "the weight decay is ", o.adamw.weight_decay,
        ", not at least 0");
  usage(o.max_grad_norm >= 0, "the gradient norm to clip to is ", o.max_grad_norm,
        ", not at least 0");
  usage(o.ema_decay >= 0 && o.ema_decay < 1, "the decay of the moving average is ", o.ema_decay,
        ", not in [0, 1)");
  usage(o.ema_decay == 0 || store.has_average(),
        "a moving average is wanted, but the store was made without one");
  usage(o.accumulate >= 1, "a batch cannot be processed in ", o.accumulate, " parts");
}

// What a batch holds: labelled pixels of this rank's frames, and sums over all ranks.
struct BatchCounts {
  std::vector<std::int64_t> labelled;
  double frames = 0, labelled_pixels = 0, unlabelled_frames = 0;
};

BatchCounts count(const DecoderBatch& batch, Communicator& communicator, Context& ctx) {
  const auto [B, levels, H, W] = batch.mask.shape();
  BatchCounts counts;
  counts.labelled.resize(static_cast<std::size_t>(B));
  parallel_chunks(
      B,
      [&, num_levels = levels, rows = H, columns = W](std::int64_t b, int) {
        std::int64_t pixels = 0;
        for (std::int64_t l = 0; l < num_levels; ++l)
          for (std::int64_t y = 0; y < rows; ++y) {
            const float* row = batch.mask[b][l][y].data();
            pixels += std::count_if(row, row + columns, [](float m) { return m > 0; });
          }
        counts.labelled[static_cast<std::size_t>(b)] = pixels;
      },
      ctx);
  std::array<double, 3> sums{static_cast<double>(B), 0, 0};
  for (const std::int64_t pixels : counts.labelled) {
    sums[1] += static_cast<double>(pixels);
    sums[2] += pixels == 0 ? 1 : 0;
  }
  communicator.sum(std::span<double>(sums));
  counts.frames = sums[0];
  counts.labelled_pixels = sums[1];
  counts.unlabelled_frames = sums[2];
  return counts;
}

// The part of each frame of a batch in the means over all.
FrameShares shares_of(const BatchCounts& counts) {
  return {1 / counts.frames, 1 / std::max(1.0, counts.frames - counts.unlabelled_frames),
          counts.labelled};
}

void check_batch(const DecoderBatch& batch, const ModelConfig& config) {
  const std::int64_t B = batch.taps[3].extent(0), H = batch.height(), W = batch.width();
  LVGGT_CHECK(B >= 1 && batch.h >= 1 && batch.w >= 1, "training: a batch of ", B, " frames of ",
              batch.h, " x ", batch.w, " patches");
  const Shape tap{B, batch.h * batch.w, 2 * config.embed_dim};
  for (std::size_t i = config.sbd_dpt ? 0 : 3; i < 4; ++i)
    LVGGT_CHECK(batch.taps[i].shape() == tap, "training: tap ", i, " is ", batch.taps[i].shape(),
                ", expected ", tap);
  const Shape features{B, config.sbd_levels, H, W, config.lang_dim};
  LVGGT_CHECK(batch.features.shape() == features, "training: the target features are ",
              batch.features.shape(), ", expected ", features);
  const Shape mask{B, config.sbd_levels, H, W};
  LVGGT_CHECK(batch.mask.shape() == mask, "training: the mask is ", batch.mask.shape(),
              ", expected ", mask);
  const Shape images{B, H, W, std::int64_t{3}};
  LVGGT_CHECK(!config.sbd_rgb || batch.images.shape() == images, "training: the target images are ",
              batch.images.shape(), ", expected ", images);
  LVGGT_CHECK(config.sbd_head == DecoderHead::kMlp || batch.h * config.patch_size >= 8,
              "training: a UNet needs maps of at least 8 x 8 pixels");
}

void clear(std::span<float> values, Context& ctx) {
  constexpr std::int64_t kGrain = std::int64_t{1} << 16;  // 256 KiB
  parallel_rows(
      std::ssize(values), kGrain,
      [&](std::int64_t begin, std::int64_t end) {
        std::fill_n(values.data() + begin, end - begin, 0.0f);
      },
      ctx);
}

// "the loss term cos is nan", or nothing.
std::optional<std::string> nonfinite_term(const LossTerms& loss) {
  const std::array<std::pair<const char*, double>, 5> terms{{{"l1", loss.l1},
                                                             {"cos", loss.cos},
                                                             {"img_l1", loss.img_l1},
                                                             {"img_l2", loss.img_l2},
                                                             {"total", loss.total}}};
  for (const auto& [name, value] : terms)
    if (!std::isfinite(value)) return concat("the loss term ", name, " is ", value);
  return std::nullopt;
}

// A store's weights as something the inference loaders read.
class StoredDecoder {
 public:
  StoredDecoder(const ParameterStore& store, bool averaged) : store_(store), averaged_(averaged) {}

  const ModelConfig& config() const { return store_.config(); }

  template <int R>
  Tensor<float, R> read(const std::string& name) const {
    const bool running = name.ends_with(".running_mean") || name.ends_with(".running_var");
    const View<const float, R> stored = store_.view<R>(running     ? StoreRole::kBuffers
                                                       : averaged_ ? StoreRole::kAverage
                                                                   : StoreRole::kWeights,
                                                       name);
    Tensor<float, R> copy(stored.shape());
    std::copy_n(stored.data(), stored.size(), copy.data());
    return copy;
  }

 private:
  const ParameterStore& store_;
  bool averaged_;
};

Storage storage_of(const StoredDecoder&, const std::string&) { return Storage::kF32; }

}  // namespace

DecoderTrainer::DecoderTrainer(ParameterStore& store, const TrainOptions& options,
                               Communicator& communicator, Context& ctx)
    : store_(store),
      options_(options),
      communicator_(communicator),
      ctx_(ctx),
      level_names_(language_decoder_names(store.config())) {
  validate(options, store);
  running_ =
      Tensor<float, 1>(Shape{static_cast<std::int64_t>(store.block(StoreRole::kBuffers).size())});
}

LossTerms DecoderTrainer::run(const DecoderBatch& batch, const FrameShares& shares,
                              const DecoderOutputs& outputs, bool gradients,
                              const TapGradients<float>& dtaps, StepTimes& times) {
  const ModelConfig& config = store_.config();
  const bool batch_statistics = !options_.frozen_batch_norm;
  const auto weights =
      bind_decoder(ParameterBinder<const float>(store_, running_.data(), batch_statistics));
  const auto dweights = bind_decoder(ParameterBinder<float>(store_, nullptr, batch_statistics));
  TrainingPass pass{ctx_};
  if (communicator_.size() > 1 && options_.synchronise_batch_norm) pass.ranks = &communicator_;
  pass.frozen_statistics = options_.frozen_batch_norm;
  pass.recompute = options_.activations == CheckpointActivations::kRecompute;
  pass.bn_eps = config.bn_eps;
  pass.bn_momentum = config.bn_momentum;

  std::ranges::copy(std::as_const(store_).block(StoreRole::kBuffers), running_.data());
  if (gradients) clear(store_.block(StoreRole::kGradients), ctx_);
  LossTerms terms;
  const std::int64_t B = batch.num_frames(), parts = std::min(options_.accumulate, B);
  for (std::int64_t part = 0; part < parts; ++part) {
    const std::int64_t begin = B * part / parts, end = B * (part + 1) / parts;
    const auto narrowed = [&](auto view) { return view ? view.narrow(0, begin, end) : view; };
    if (gradients && part == parts - 1)
      pass.gradients_ready = [&](std::string_view prefix) {
        const std::span<float> bucket = store_.range(StoreRole::kGradients, prefix);
        if (!bucket.empty()) communicator_.start_sum(bucket);
      };
    TapGradients<float> dpart;
    for (std::size_t i = 0; i < 4; ++i) dpart[i] = narrowed(dtaps[i]);
    FrameShares part_shares = shares;
    part_shares.labelled_pixels = shares.labelled_pixels.subspan(
        static_cast<std::size_t>(begin), static_cast<std::size_t>(end - begin));
    const DecoderBatch frames_of_part = frames_of(batch, begin, end);
    const DecoderStep<float> step{frames_of_part,
                                  weights,
                                  gradients ? &dweights : nullptr,
                                  {narrowed(outputs.language), narrowed(outputs.rgb)},
                                  objective_of(options_),
                                  part_shares,
                                  batch.h * config.patch_size,
                                  batch.w * config.patch_size,
                                  static_cast<float>(config.dpt_ln_eps)};
    decoder_step(dpart, terms, step, level_names_, pass);
  }
  times.forward += pass.forward_seconds;
  times.backward += pass.backward_seconds;
  communicator_.finish_sums();
  std::array<double, 4> sums{terms.l1, terms.cos, terms.img_l1, terms.img_l2};
  communicator_.sum(std::span<double>(sums));
  terms = {sums[0], sums[1], sums[2], sums[3], 0};
  add_up(terms, options_.loss);
  return terms;
}

LossTerms DecoderTrainer::evaluate(const DecoderBatch& batch, const DecoderOutputs& outputs,
                                   bool gradients, const TapGradients<float>& dtaps) {
  check_batch(batch, store_.config());
  StepTimes times;
  const BatchCounts counts = count(batch, communicator_, ctx_);
  return run(batch, shares_of(counts), outputs, gradients, dtaps, times);
}

StepReport DecoderTrainer::step(const DecoderBatch& batch) {
  check_batch(batch, store_.config());
  StepReport report;
  const BatchCounts counts = count(batch, communicator_, ctx_);
  report.labelled_pixels = static_cast<std::int64_t>(counts.labelled_pixels);
  report.frames_without_label = static_cast<std::int64_t>(counts.unlabelled_frames);
  report.learning_rate = learning_rate_at(options_.schedule, steps_);
  report.loss = run(batch, shares_of(counts), {}, true, {}, report.times);

  const TimeInto time(report.times.optimiser);
  report.grad_norm = gradient_norm(store_, ctx_);
  report.refused = nonfinite_term(report.loss);
  if (!report.refused && !std::isfinite(report.grad_norm)) {
    const ParameterEntry* entry = find_nonfinite_gradient(store_);
    report.refused = entry ? "the gradient of " + entry->name + " is not finite"
                           : std::string("the norm of the gradient is not finite");
  }
  if (!report.refused && options_.judge)
    report.refused = options_.judge(report.loss, report.grad_norm);
  const bool refused_elsewhere = communicator_.any(report.refused.has_value());
  if (refused_elsewhere && !report.refused) report.refused = "another rank refused the step";
  if (report.refused) return report;

  // As torch.nn.utils.clip_grad_norm_.
  double scale = 1;
  if (options_.max_grad_norm > 0)
    scale = std::min(1.0, options_.max_grad_norm / (report.grad_norm + 1e-6));
  ++steps_;
  adamw_step(store_, steps_, report.learning_rate, scale, options_.ema_decay, options_.adamw, ctx_);
  commit_statistics();
  return report;
}

void DecoderTrainer::commit_statistics() {
  std::copy_n(running_.data(), running_.size(), store_.block(StoreRole::kBuffers).data());
}

void DecoderTrainer::predict(const DecoderOutputs& outputs, const DecoderBatch& batch,
                             bool averaged) {
  const ModelConfig& config = store_.config();
  const SemanticBridgingDecoder decoder =
      load_semantic_bridging_decoder(StoredDecoder(store_, averaged));
  const std::int64_t H = batch.h * config.patch_size, W = batch.w * config.patch_size;
  for (std::int64_t b = 0; b < batch.num_frames(); ++b) {
    std::array<View<const float, 2>, 4> taps;
    for (std::size_t i = 0; i < 4; ++i)
      if (batch.taps[i]) taps[i] = batch.taps[i][b];
    semantic_bridging_decoder_forward(outputs.language[b],
                                      outputs.rgb ? outputs.rgb[b] : View<float, 3>(), taps,
                                      batch.h, batch.w, H, W, decoder, nullptr, ctx_);
  }
}

}  // namespace lvggt
