// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/adamw.h"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>

#include "tests/support/random.h"
#include "tests/support/training.h"

namespace lvggt {
namespace {

void fill_random(std::span<float> values, std::uint32_t seed) {
  const auto noise = test::random_tensor(Shape{static_cast<std::int64_t>(values.size())}, seed);
  std::copy_n(noise.data(), values.size(), values.begin());
}

TEST_CASE("adamw: three steps follow the definition, with decay on weights only") {
  const ModelConfig config = test::small_decoder_config();
  Context ctx(2);
  ParameterStore store(config, true);
  store.initialise(1, ctx);
  store.start_average();
  std::vector<double> w, m, v, average;
  for (const float x : store.block(StoreRole::kWeights)) w.push_back(x);
  average = w;
  m.resize(w.size());
  v.resize(w.size());
  const AdamWOptions options{.weight_decay = 0.1};
  const double lr = 1e-2, scale = 0.5, ema = 0.75;
  for (std::int64_t t = 1; t <= 3; ++t) {
    for (const ParameterEntry& entry : store.parameters()) {
      const std::span<float> g = store.values(StoreRole::kGradients, entry.name);
      fill_random(g, static_cast<std::uint32_t>(17 * t));
      const bool decays = entry.shape.size() > 1 && !entry.name.ends_with(".bias");
      for (std::size_t j = 0; j < g.size(); ++j) {
        const std::size_t i = static_cast<std::size_t>(entry.offset) + j;
        const double gradient = scale * g[j];
        m[i] = 0.9 * m[i] + 0.1 * gradient;
        v[i] = 0.95 * v[i] + 0.05 * gradient * gradient;
        w[i] = w[i] * (1 - lr * (decays ? 0.1 : 0)) -
               lr * (m[i] / (1 - std::pow(0.9, t))) /
                   (std::sqrt(v[i] / (1 - std::pow(0.95, t))) + 1e-8);
        average[i] = ema * average[i] + (1 - ema) * w[i];
      }
    }
    adamw_step(store, t, lr, scale, ema, options, ctx);
  }
  double worst = 0, worst_average = 0;
  for (const ParameterEntry& entry : store.parameters())
    for (std::int64_t i = entry.offset; i < entry.offset + entry.size; ++i) {
      const auto n = static_cast<std::size_t>(i);
      worst = std::max(worst, std::abs(store.block(StoreRole::kWeights)[n] - w[n]));
      worst_average =
          std::max(worst_average, std::abs(store.block(StoreRole::kAverage)[n] - average[n]));
    }
  // Weights of at most 1, steps of 1e-2 good to a few roundings.
  CHECK(worst < 5e-7);
  CHECK(worst_average < 5e-7);
}

TEST_CASE("adamw: the norm is that of all gradients, and one that is not finite is found") {
  Context one(1), five(5);
  ParameterStore store(test::small_decoder_config());
  double sum = 0;
  for (const ParameterEntry& entry : store.parameters()) {
    const std::span<float> g = store.values(StoreRole::kGradients, entry.name);
    fill_random(g, 5);
    for (const float x : g) sum += static_cast<double>(x) * x;
  }
  CHECK(gradient_norm(store, one) == doctest::Approx(std::sqrt(sum)).epsilon(1e-12));
  CHECK(gradient_norm(store, one) == gradient_norm(store, five));
  CHECK(find_nonfinite_gradient(store) == nullptr);
  const std::string name = "rgb_encoder.down2.3.weight";
  store.values(StoreRole::kGradients, name)[3] = std::numeric_limits<float>::infinity();
  CHECK(!std::isfinite(gradient_norm(store, one)));
  REQUIRE(find_nonfinite_gradient(store) != nullptr);
  CHECK(find_nonfinite_gradient(store)->name == name);
}

}  // namespace
}  // namespace lvggt
