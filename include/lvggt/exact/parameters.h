// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <string>
#include <vector>

#include "lvggt/train/adamw.h"
#include "lvggt/train/parameter_store.h"

namespace lvggt {

// A store's blocks in float64, under the same names and offsets, starting from its weights and
// running statistics; moments and gradients are 0.
class ExactParameters {
 public:
  // `layout` is borrowed: it tells where each tensor lies. Its values are copied.
  explicit ExactParameters(ParameterStore& layout) : layout_(layout) {
    for (std::size_t i = 0; i < blocks_.size(); ++i)
      blocks_[i].resize(layout.block(static_cast<StoreRole>(i)).size());
    for (const StoreRole role : {StoreRole::kWeights, StoreRole::kBuffers})
      std::ranges::copy(layout.block(role), block(role).begin());
  }

  const ModelConfig& config() const { return layout_.config(); }
  std::span<double> block(StoreRole role) { return blocks_[static_cast<std::size_t>(role)]; }

  template <int R>
  View<double, R> view(StoreRole role, const std::string& name) {
    const View<float, R> there = layout_.view<R>(role, name);
    const std::int64_t offset = there.data() - layout_.block(role).data();
    return View<double, R>(block(role).data() + offset, there.shape());
  }

  // Calls f(entry, values) for every tensor of a role.
  template <class F>
  void for_each(StoreRole role, const F& f) {
    for (const ParameterEntry& entry : layout_.entries(role))
      f(entry, block(role).subspan(static_cast<std::size_t>(entry.offset),
                                   static_cast<std::size_t>(entry.size)));
  }

 private:
  ParameterStore& layout_;
  std::array<std::vector<double>, 6> blocks_;  // by StoreRole
};

// Euclidean norm of the whole gradient.
inline double gradient_norm(ExactParameters& parameters) {
  double sum = 0;
  for (const double g : parameters.block(StoreRole::kGradients)) sum += g * g;
  return std::sqrt(sum);
}

// One AdamW step, as adamw_step() of a ParameterStore but in float64 and without an average.
inline void adamw_step(ExactParameters& parameters, std::int64_t t, double learning_rate,
                       double gradient_scale, const AdamWOptions& options) {
  const double rate = learning_rate / (1 - std::pow(options.beta1, static_cast<double>(t)));
  const double correction = std::sqrt(1 - std::pow(options.beta2, static_cast<double>(t)));
  parameters.for_each(StoreRole::kWeights, [&](const ParameterEntry& entry, std::span<double> w) {
    const auto values = [&](StoreRole role) {
      return parameters.block(role).data() + entry.offset;
    };
    const double* gradient = values(StoreRole::kGradients);
    double* m = values(StoreRole::kFirstMoments);
    double* v = values(StoreRole::kSecondMoments);
    const double keep = entry.decays ? 1 - learning_rate * options.weight_decay : 1;
    for (std::size_t i = 0; i < w.size(); ++i) {
      const double g = gradient_scale * gradient[i];
      m[i] = options.beta1 * m[i] + (1 - options.beta1) * g;
      v[i] = options.beta2 * v[i] + (1 - options.beta2) * g * g;
      w[i] = keep * w[i] - rate * m[i] / (std::sqrt(v[i]) / correction + options.eps);
    }
  });
}

}  // namespace lvggt
