// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <string>
#include <vector>

#include "lvggt/exact/kernels.h"
#include "lvggt/exact/parameters.h"
#include "lvggt/train/decoder.h"
#include "lvggt/train/decoder_trainer.h"

namespace lvggt {

// DecoderTrainer in float64: the same layers, losses, clipping and AdamW on plain kernels, alone
// and on whole batches. What it computes differs from exact arithmetic by about 1e-13, so that a
// reference can be compared without the ReLU inputs that float32 puts on the other side of zero.
class ExactDecoderTrainer {
 public:
  // Parameters and context are borrowed. A moving average or a judge of steps is refused.
  ExactDecoderTrainer(ExactParameters& parameters, const TrainOptions& options, Context& ctx)
      : parameters_(parameters), options_(options), ctx_(ctx) {
    if (options.ema_decay != 0 || options.judge)
      fail(ErrorKind::kUsage, "exact training: there is neither a moving average nor a judge");
  }

  // As DecoderTrainer::evaluate(): the losses of a batch, its predictions and gradients.
  LossTerms evaluate(const BasicDecoderBatch<double>& batch,
                     const BasicDecoderOutputs<double>& outputs, bool gradients,
                     const TapGradients<double>& dtaps = {}) {
    const ModelConfig& config = parameters_.config();
    const std::span<double> buffers = parameters_.block(StoreRole::kBuffers);
    running_.assign(buffers.begin(), buffers.end());
    if (gradients) std::ranges::fill(parameters_.block(StoreRole::kGradients), 0.0);
    const auto weights = bind_decoder(ParameterBinder<const double, ExactParameters>(
        parameters_, running_.data(), !options_.frozen_batch_norm));
    const auto dweights = bind_decoder(ParameterBinder<double, ExactParameters>(
        parameters_, nullptr, !options_.frozen_batch_norm));
    TrainingPass pass{ctx_};
    pass.frozen_statistics = options_.frozen_batch_norm;
    pass.recompute = options_.activations == CheckpointActivations::kRecompute;
    pass.bn_eps = config.bn_eps;
    pass.bn_momentum = config.bn_momentum;
    const std::vector<std::int64_t> labelled = labelled_pixels(batch.mask);
    const std::int64_t B = batch.num_frames(), parts = std::min(options_.accumulate, B);
    const auto with_label = static_cast<double>(B - std::ranges::count(labelled, std::int64_t{0}));
    LossTerms terms;
    for (std::int64_t part = 0; part < parts; ++part) {
      const std::int64_t begin = B * part / parts, end = B * (part + 1) / parts;
      const auto narrowed = [&](auto view) { return view ? view.narrow(0, begin, end) : view; };
      const BasicDecoderBatch<double> frames = frames_of(batch, begin, end);
      const FrameShares shares{1 / static_cast<double>(B), 1 / std::max(1.0, with_label),
                               std::span(labelled).subspan(static_cast<std::size_t>(begin),
                                                           static_cast<std::size_t>(end - begin))};
      const DecoderStep<double> step{frames,
                                     weights,
                                     gradients ? &dweights : nullptr,
                                     {narrowed(outputs.language), narrowed(outputs.rgb)},
                                     objective_of(options_),
                                     shares,
                                     batch.h * config.patch_size,
                                     batch.w * config.patch_size,
                                     config.dpt_ln_eps};
      TapGradients<double> dpart;
      for (std::size_t i = 0; i < 4; ++i) dpart[i] = narrowed(dtaps[i]);
      decoder_step(dpart, terms, step, language_decoder_names(config), pass);
    }
    add_up(terms, options_.loss);
    return terms;
  }

  // As DecoderTrainer::step(); it refuses nothing and takes no times.
  StepReport step(const BasicDecoderBatch<double>& batch) {
    StepReport report;
    report.learning_rate = learning_rate_at(options_.schedule, steps_);
    report.loss = evaluate(batch, {}, true);
    report.grad_norm = gradient_norm(parameters_);
    double scale = 1;
    if (options_.max_grad_norm > 0)
      scale = std::min(1.0, options_.max_grad_norm / (report.grad_norm + 1e-6));
    adamw_step(parameters_, ++steps_, report.learning_rate, scale, options_.adamw);
    std::ranges::copy(running_, parameters_.block(StoreRole::kBuffers).begin());
    return report;
  }

 private:
  static std::vector<std::int64_t> labelled_pixels(View<const double, 4> mask) {
    std::vector<std::int64_t> pixels(static_cast<std::size_t>(mask.extent(0)));
    exact_for_each_element(mask, [&](auto b, auto l, auto y, auto x) {
      pixels[static_cast<std::size_t>(b)] += mask(b, l, y, x) > 0 ? 1 : 0;
    });
    return pixels;
  }

  ExactParameters& parameters_;
  TrainOptions options_;
  Context& ctx_;
  std::vector<double> running_;  // running statistics as the last pass moved them
  std::int64_t steps_ = 0;
};

}  // namespace lvggt
