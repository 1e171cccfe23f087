// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/autoencoder_trainer.h"

#include <algorithm>
#include <cmath>
#include <string>

#include "kernels/grain.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/batch_norm2d.h"
#include "lvggt/kernels/linear.h"

namespace lvggt {
namespace {

constexpr std::int64_t kEvaluateRows = 1024;

View<const float, 4> as_map(View<const float, 2> rows) {
  return rows.reshaped(Shape{std::int64_t{1}, rows.extent(0), std::int64_t{1}, rows.extent(1)});
}
View<float, 4> as_map(View<float, 2> rows) {
  return rows.reshaped(Shape{std::int64_t{1}, rows.extent(0), std::int64_t{1}, rows.extent(1)});
}

// Views of a store's tensors under their published names.
template <class T>
AutoencoderParameters<T> bind(ParameterStore& store, const AutoencoderShape& shape) {
  constexpr bool kWeights = std::is_const_v<T>;
  const StoreRole role = kWeights ? StoreRole::kWeights : StoreRole::kGradients;
  AutoencoderParameters<T> bound;
  for (std::size_t i = 0; i < shape.encoder.size(); ++i) {
    const std::string name = concat("encoder.", 3 * i), norm = concat("encoder.", 3 * i + 1);
    const bool normed = i + 1 < shape.encoder.size();
    bound.encoder.push_back({store.view<2>(role, name + ".weight"), {}});
    if (kWeights || !normed) bound.encoder.back().bias = store.view<1>(role, name + ".bias");
    if (!normed) continue;
    bound.norms.push_back(
        {store.view<1>(role, norm + ".weight"), store.view<1>(role, norm + ".bias"), {}, {}});
    if (!kWeights) continue;
    bound.norms.back().running_mean = store.view<1>(StoreRole::kBuffers, norm + ".running_mean");
    bound.norms.back().running_var = store.view<1>(StoreRole::kBuffers, norm + ".running_var");
  }
  for (std::size_t i = 0; i < shape.decoder.size(); ++i) {
    const std::string name = concat("decoder.", 2 * i);
    bound.decoder.push_back(
        {store.view<2>(role, name + ".weight"), store.view<1>(role, name + ".bias")});
  }
  return bound;
}

void check_options(const AutoencoderTrainOptions& o) {
  const auto usage = [](bool ok, const auto&... message) {
    if (!ok) fail(ErrorKind::kUsage, "autoencoder: ", message...);
  };
  usage(o.learning_rate > 0 && std::isfinite(o.learning_rate), "the learning rate is ",
        o.learning_rate, ", not above 0");
  usage(o.cosine_weight >= 0 && std::isfinite(o.cosine_weight), "the weight of the cosine is ",
        o.cosine_weight, ", not at least 0");
  usage(o.adam.beta1 >= 0 && o.adam.beta1 < 1 && o.adam.beta2 >= 0 && o.adam.beta2 < 1,
        "Adam's betas ", o.adam.beta1, " and ", o.adam.beta2, " do not lie in [0, 1)");
}

// Of one row: its sum of squared differences, the cosine, and the lengths.
struct RowTerms {
  double squares = 0, cosine = 0, y_length = 0, x_length = 0;
};

RowTerms row_terms(const float* y, const float* x, std::int64_t D) {
  double squares = 0, yy = 0, xx = 0, xy = 0;
  for (std::int64_t c = 0; c < D; ++c) {
    const double a = y[c], b = x[c];
    squares += (a - b) * (a - b);
    yy += a * a;
    xx += b * b;
    xy += a * b;
  }
  const double lengths = std::sqrt(yy) * std::sqrt(xx);
  return {squares, lengths > 0 ? xy / lengths : 0, std::sqrt(yy), std::sqrt(xx)};
}

// Calls f(n, terms of row n) for all rows in parallel and adds up the loss in their order.
template <class F>
AutoencoderLoss loss_of_rows(View<const float, 2> y, View<const float, 2> x, const F& f,
                             Context& ctx) {
  const auto [N, D] = x.shape();
  LVGGT_CHECK(y.shape() == x.shape() && N >= 1, "autoencoder: the loss of ", y.shape(), " and ",
              x.shape());
  Arena::Scope scope(ctx.arena());
  const View<RowTerms, 1> terms = ctx.arena().alloc<RowTerms>(Shape{N});
  const std::int64_t width = D;
  parallel_rows(
      N, kernels::rows_per_chunk(D),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) {
          terms[n] = row_terms(y[n].data(), x[n].data(), width);
          f(n, terms[n]);
        }
      },
      ctx);
  AutoencoderLoss loss;
  for (std::int64_t n = 0; n < N; ++n) {
    loss.l2 += terms[n].squares;
    loss.cos += 1 - terms[n].cosine;
  }
  loss.l2 /= static_cast<double>(N) * static_cast<double>(D);
  loss.cos /= static_cast<double>(N);
  return loss;
}

}  // namespace

AutoencoderLoss autoencoder_loss(View<const float, 2> y, View<const float, 2> x, Context& ctx) {
  return loss_of_rows(
      y, x, [](std::int64_t, const RowTerms&) {}, ctx);
}

AutoencoderLoss autoencoder_loss_backward(View<float, 2> dy, View<const float, 2> y,
                                          View<const float, 2> x, double cosine_weight,
                                          Context& ctx) {
  LVGGT_CHECK(dy.shape() == y.shape(), "autoencoder: dy is ", dy.shape(), " but y is ", y.shape());
  const std::int64_t D = x.extent(1);
  const double rows = static_cast<double>(x.extent(0));
  const double l2_scale = 2 / (rows * static_cast<double>(D)), cos_scale = cosine_weight / rows;
  // d cosine / dy = x / (|y| |x|) - cosine y / |y|^2
  return loss_of_rows(
      y, x,
      [&](std::int64_t n, const RowTerms& row) {
        const double lengths = row.y_length * row.x_length;
        const double of_x = lengths > 0 ? cos_scale / lengths : 0;
        const double of_y =
            lengths > 0 ? cos_scale * row.cosine / (row.y_length * row.y_length) : 0;
        const float* a = y[n].data();
        const float* b = x[n].data();
        float* out = dy[n].data();
        for (std::int64_t c = 0; c < D; ++c)
          out[c] = static_cast<float>(l2_scale * (static_cast<double>(a[c]) - b[c]) - of_x * b[c] +
                                      of_y * a[c]);
      },
      ctx);
}

void normalise_rows_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> y,
                             View<const float, 1> length, Context& ctx) {
  const auto [N, C] = y.shape();
  LVGGT_CHECK(dx.shape() == y.shape() && dy.shape() == y.shape() && length.extent(0) == N,
              "normalise_rows_backward: y is ", y.shape(), " but dx is ", dx.shape(), ", dy ",
              dy.shape(), ", length ", length.shape());
  const std::int64_t width = C;
  parallel_rows(
      N, kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) {
          const float* unit = y[n].data();
          const float* from = dy[n].data();
          float* to = dx[n].data();
          double along = 0;
          for (std::int64_t c = 0; c < width; ++c) along += static_cast<double>(unit[c]) * from[c];
          const double scale = length[n] > 0 ? 1 / static_cast<double>(length[n]) : 0;
          for (std::int64_t c = 0; c < width; ++c)
            to[c] = static_cast<float>((from[c] - unit[c] * along) * scale);
        }
      },
      ctx);
}

// What the backward pass reads of a forward pass.
struct AutoencoderTrainer::Kept {
  std::vector<View<float, 2>> sums;    // of the encoder's linear layers, before their norms
  std::vector<View<float, 2>> normed;  // after norm and ReLU: inputs of the layers after the first
  std::vector<View<float, 1>> mean, rstd;
  View<float, 2> codes;
  View<float, 1> code_length;
  std::vector<View<float, 2>> outputs;  // of the decoder's layers, after their ReLUs
  View<float, 2> decoded;
  View<float, 1> decoded_length;
};

AutoencoderTrainer::AutoencoderTrainer(ParameterStore& store, const AutoencoderShape& shape,
                                       const AutoencoderTrainOptions& options, Context& ctx)
    : store_(store), shape_(shape), options_(options), ctx_(ctx) {
  check_options(options);
  LVGGT_CHECK(!shape.encoder.empty(), "autoencoder: ", to_text(shape), " has nothing to train");
  weights_ = bind<const float>(store, shape);
  gradients_ = bind<float>(store, shape);
}

void AutoencoderTrainer::encode(Kept& kept, View<const float, 2> x) {
  Arena& arena = ctx_.arena();
  const std::int64_t N = x.extent(0);
  View<const float, 2> input = x;
  for (std::size_t i = 0; i < weights_.encoder.size(); ++i) {
    const LinearParameters<const float>& layer = weights_.encoder[i];
    const std::int64_t width = layer.weight.extent(0);
    const View<float, 2> sums = arena.alloc(Shape{N, width});
    linear_forward(sums, input, layer.weight, Epilogue<2>{.bias = layer.bias}, ctx_);
    kept.sums.push_back(sums);
    if (i + 1 == weights_.encoder.size()) break;
    const BatchNormParameters<const float>& norm = weights_.norms[i];
    kept.mean.push_back(arena.alloc(Shape{width}));
    kept.rstd.push_back(arena.alloc(Shape{width}));
    kept.normed.push_back(arena.alloc(Shape{N, width}));
    batch_norm2d_forward(as_map(kept.normed.back()), kept.mean.back(), kept.rstd.back(),
                         norm.running_mean, norm.running_var, as_map(sums), norm.gamma, norm.beta,
                         options_.bn_eps, options_.bn_momentum, Activation::kRelu, ctx_);
    input = kept.normed.back();
  }
  kept.codes = arena.alloc(kept.sums.back().shape());
  kept.code_length = arena.alloc(Shape{N});
  normalise_rows(kept.codes, kept.code_length, kept.sums.back(), ctx_);
}

void AutoencoderTrainer::forward(Kept& kept, View<const float, 2> x) {
  encode(kept, x);
  Arena& arena = ctx_.arena();
  const std::int64_t N = x.extent(0);
  View<const float, 2> input = kept.codes;
  for (std::size_t i = 0; i < weights_.decoder.size(); ++i) {
    const LinearParameters<const float>& layer = weights_.decoder[i];
    const bool last = i + 1 == weights_.decoder.size();
    kept.outputs.push_back(arena.alloc(Shape{N, layer.weight.extent(0)}));
    linear_forward(
        kept.outputs.back(), input, layer.weight,
        Epilogue<2>{.bias = layer.bias, .activation = last ? Activation::kNone : Activation::kRelu},
        ctx_);
    input = kept.outputs.back();
  }
  kept.decoded = arena.alloc(kept.outputs.back().shape());
  kept.decoded_length = arena.alloc(Shape{N});
  normalise_rows(kept.decoded, kept.decoded_length, kept.outputs.back(), ctx_);
}

View<float, 2> AutoencoderTrainer::decoder_backward(Kept& kept, View<float, 2> ddecoded) {
  View<float, 2> dy = ddecoded;
  normalise_rows_backward(dy, dy, kept.decoded, kept.decoded_length, ctx_);
  for (std::size_t i = weights_.decoder.size(); i-- > 0;) {
    if (i + 1 < weights_.decoder.size()) relu_backward(dy, dy, kept.outputs[i], ctx_);
    const View<const float, 2> input = i > 0 ? kept.outputs[i - 1] : kept.codes;
    const View<float, 2> dx = ctx_.arena().alloc(input.shape());
    linear_backward(dx, gradients_.decoder[i].weight, gradients_.decoder[i].bias, dy, input,
                    weights_.decoder[i].weight, ctx_);
    dy = dx;
  }
  return dy;
}

void AutoencoderTrainer::backward(Kept& kept, View<float, 2> ddecoded, View<const float, 2> x) {
  View<float, 2> dy = decoder_backward(kept, ddecoded);
  normalise_rows_backward(dy, dy, kept.codes, kept.code_length, ctx_);
  for (std::size_t i = weights_.encoder.size(); i-- > 0;) {
    if (i + 1 < weights_.encoder.size()) {
      const BatchNormParameters<const float>& norm = weights_.norms[i];
      batch_norm2d_backward(as_map(dy), gradients_.norms[i].gamma, gradients_.norms[i].beta,
                            as_map(View<const float, 2>(dy)), kept.mean[i], kept.rstd[i],
                            as_map(View<const float, 2>(kept.sums[i])), norm.gamma, norm.beta,
                            Activation::kRelu, ctx_);
    }
    const View<const float, 2> input = i > 0 ? View<const float, 2>(kept.normed[i - 1]) : x;
    View<float, 2> dx;  // of the features themselves: not wanted
    if (i > 0) dx = ctx_.arena().alloc(input.shape());
    linear_backward(dx, gradients_.encoder[i].weight, gradients_.encoder[i].bias, dy, input,
                    weights_.encoder[i].weight, ctx_);
    dy = dx;
  }
}

AutoencoderLoss AutoencoderTrainer::gradients(View<float, 2> codes, View<float, 2> decoded,
                                              View<const float, 2> x) {
  LVGGT_CHECK(x.extent(1) == shape_.features, "autoencoder: the batch is ", x.shape(),
              " but the features are ", shape_.features, " wide");
  Arena::Scope scope(ctx_.arena());
  Kept kept;
  forward(kept, x);
  const View<float, 2> ddecoded = ctx_.arena().alloc(x.shape());
  const AutoencoderLoss loss =
      autoencoder_loss_backward(ddecoded, kept.decoded, x, options_.cosine_weight, ctx_);
  if (codes) std::copy_n(kept.codes.data(), kept.codes.size(), codes.data());
  if (decoded) std::copy_n(kept.decoded.data(), kept.decoded.size(), decoded.data());
  std::ranges::fill(store_.block(StoreRole::kGradients), 0.0F);
  backward(kept, ddecoded, x);
  return loss;
}

AutoencoderLoss AutoencoderTrainer::step(View<const float, 2> x) {
  const AutoencoderLoss loss = gradients({}, {}, x);
  if (!std::isfinite(loss.total(1)))
    fail(ErrorKind::kNumeric, "autoencoder: the loss after ", steps_, " steps is ", loss.total(1));
  if (const ParameterEntry* entry = find_nonfinite_gradient(store_))
    fail(ErrorKind::kNumeric, "autoencoder: the gradient of ", entry->name, " after ", steps_,
         " steps is not finite");
  adamw_step(store_, ++steps_, options_.learning_rate, 1, 0, options_.adam, ctx_);
  return loss;
}

Autoencoder AutoencoderTrainer::autoencoder() const {
  return Autoencoder(shape_, [&](const TensorSpec& spec, std::span<float> values) {
    const bool buffer = spec.name.find(".running_") != std::string::npos;
    const StoreRole role = buffer ? StoreRole::kBuffers : StoreRole::kWeights;
    std::ranges::copy(std::as_const(store_).values(role, spec.name), values.begin());
  });
}

AutoencoderLoss evaluate_autoencoder(const Autoencoder& autoencoder, View<const float, 2> x,
                                     Context& ctx) {
  const std::int64_t N = x.extent(0);
  LVGGT_CHECK(N >= 1, "autoencoder: there are no rows to evaluate on");
  AutoencoderLoss sum;
  for (std::int64_t begin = 0; begin < N; begin += kEvaluateRows) {
    const std::int64_t end = std::min(begin + kEvaluateRows, N);
    Arena::Scope scope(ctx.arena());
    const View<float, 2> codes = ctx.arena().alloc(Shape{end - begin, autoencoder.code_width()});
    const View<float, 2> decoded =
        ctx.arena().alloc(Shape{end - begin, autoencoder.feature_width()});
    autoencoder.encode(codes, x.narrow(0, begin, end), ctx);
    autoencoder.decode(decoded, codes, ctx);
    const AutoencoderLoss part = autoencoder_loss(decoded, x.narrow(0, begin, end), ctx);
    const double share = static_cast<double>(end - begin) / static_cast<double>(N);
    sum.l2 += share * part.l2;
    sum.cos += share * part.cos;
  }
  return sum;
}

std::size_t plan_autoencoder(const AutoencoderShape& shape, std::int64_t batch) {
  std::int64_t values = 0, widths = 2 * shape.features;
  for (const TensorSpec& spec : autoencoder_tensors(shape)) values += spec.volume();
  for (const std::int64_t width : shape.encoder) widths += 4 * width;
  for (const std::int64_t width : shape.decoder) widths += 3 * width;
  // Weights, gradients and two moments; a copy of the best; the packed weights of an evaluation.
  return static_cast<std::size_t>(6 * values + std::max(batch, kEvaluateRows) * widths) *
         sizeof(float);
}

}  // namespace lvggt
