// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/adamw.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "lvggt/core/parallel.h"
#include "lvggt/kernels/elementwise.h"

namespace lvggt {
namespace {

// Elements of one chunk: 64 Ki floats of five blocks are 1.25 MiB, large against the cost of a task
// and small enough to share out the largest tensor.
constexpr std::int64_t kChunk = std::int64_t{1} << 16;

double sum_of_squares(const float* x, std::int64_t n) {
  std::array<double, 8> sums{};
  std::int64_t i = 0;
  for (; i + 8 <= n; i += 8)
    for (std::int64_t j = 0; j < 8; ++j)
      sums[static_cast<std::size_t>(j)] += static_cast<double>(x[i + j]) * x[i + j];
  for (; i < n; ++i) sums[0] += static_cast<double>(x[i]) * x[i];
  double total = 0;
  for (const double sum : sums) total += sum;
  return total;
}

// A piece of one parameter, at most kChunk elements.
struct Piece {
  std::int64_t begin = 0, end = 0;
  bool decays = false;
};

std::vector<Piece> pieces_of(const ParameterStore& store) {
  std::vector<Piece> pieces;
  for (const ParameterEntry& entry : store.parameters())
    for (std::int64_t begin = 0; begin < entry.size; begin += kChunk)
      pieces.push_back({entry.offset + begin, entry.offset + std::min(entry.size, begin + kChunk),
                        entry.decays});
  return pieces;
}

// The numbers of one step, the same for all elements.
struct Step {
  float gradient_scale, beta1, beta2, eps;
  float keep;     // 1 - lr decay
  float rate;     // lr / (1 - beta1^t)
  float inverse;  // 1 / sqrt(1 - beta2^t)
};

void update(float* w, float* m, float* v, const float* gradient, std::int64_t n, const Step& s) {
  for (std::int64_t i = 0; i < n; ++i) {
    const float g = s.gradient_scale * gradient[i];
    m[i] = s.beta1 * m[i] + (1 - s.beta1) * g;
    v[i] = s.beta2 * v[i] + (1 - s.beta2) * g * g;
    w[i] = s.keep * w[i] - s.rate * m[i] / (std::sqrt(v[i]) * s.inverse + s.eps);
  }
}

void follow(float* average, const float* w, std::int64_t n, float decay) {
  for (std::int64_t i = 0; i < n; ++i) average[i] += (1 - decay) * (w[i] - average[i]);
}

}  // namespace

double gradient_norm(const ParameterStore& store, Context& ctx) {
  const std::span<const float> gradient = store.block(StoreRole::kGradients);
  const auto n = static_cast<std::int64_t>(gradient.size());
  const std::int64_t num_chunks = (n + kChunk - 1) / kChunk;
  Arena::Scope scope(ctx.arena());
  const View<double, 1> sums = ctx.arena().alloc<double>(Shape{num_chunks});
  parallel_chunks(
      num_chunks,
      [&](std::int64_t chunk, int) {
        const std::int64_t begin = chunk * kChunk;
        sums[chunk] = sum_of_squares(gradient.data() + begin, std::min(kChunk, n - begin));
      },
      ctx);
  double total = 0;
  for (std::int64_t chunk = 0; chunk < num_chunks; ++chunk) total += sums[chunk];
  return std::sqrt(total);
}

const ParameterEntry* find_nonfinite_gradient(const ParameterStore& store) {
  const float* gradient = store.block(StoreRole::kGradients).data();
  for (const ParameterEntry& entry : store.parameters())
    if (find_nonfinite(View<const float, 1>(gradient + entry.offset, Shape{entry.size})) >= 0)
      return &entry;
  return nullptr;
}

void adamw_step(ParameterStore& store, std::int64_t t, double learning_rate, double gradient_scale,
                double ema_decay, const AdamWOptions& options, Context& ctx) {
  LVGGT_CHECK(t >= 1, "adamw: steps are counted from 1, this is step ", t);
  const auto count = static_cast<double>(t);
  Step step{};
  step.gradient_scale = static_cast<float>(gradient_scale);
  step.beta1 = static_cast<float>(options.beta1);
  step.beta2 = static_cast<float>(options.beta2);
  step.eps = static_cast<float>(options.eps);
  step.rate = static_cast<float>(learning_rate / (1 - std::pow(options.beta1, count)));
  step.inverse = static_cast<float>(1 / std::sqrt(1 - std::pow(options.beta2, count)));
  Step decaying = step;
  step.keep = 1;
  decaying.keep = static_cast<float>(1 - learning_rate * options.weight_decay);

  float* w = store.block(StoreRole::kWeights).data();
  float* m = store.block(StoreRole::kFirstMoments).data();
  float* v = store.block(StoreRole::kSecondMoments).data();
  float* average = store.block(StoreRole::kAverage).data();
  const float* gradient = store.block(StoreRole::kGradients).data();
  const std::vector<Piece> pieces = pieces_of(store);
  parallel_chunks(
      std::ssize(pieces),
      [&](std::int64_t i, int) {
        const Piece& piece = pieces[static_cast<std::size_t>(i)];
        const std::int64_t begin = piece.begin, n = piece.end - piece.begin;
        update(w + begin, m + begin, v + begin, gradient + begin, n,
               piece.decays ? decaying : step);
        if (store.has_average() && ema_decay > 0)
          follow(average + begin, w + begin, n, static_cast<float>(ema_decay));
      },
      ctx);
}

}  // namespace lvggt
