// SPDX-License-Identifier: Apache-2.0
#include <array>

#include "examples/check_reference/query_cases.h"
#include "lvggt/language/autoencoder.h"
#include "lvggt/language/autoencoder_trainer.h"

namespace check_reference {
namespace {

using namespace lvggt;

// The reference is a float64 run. Adam's steps have the size of the learning rate whatever the
// gradient, so that after them single values whose gradient is near 0 differ more.
constexpr double kGradient = 2e-4, kUpdate = 1e-3, kStatistics = 2e-5;

constexpr const char* kCancelled =
    "a bias before a batch norm: its gradient is exactly 0, the reference holds rounding";

std::vector<float> one(double value) { return {static_cast<float>(value)}; }

template <int R>
std::span<const float> flat(const Tensor<float, R>& tensor) {
  return {tensor.data(), static_cast<std::size_t>(tensor.size())};
}

class AutoencoderCase {
 public:
  AutoencoderCase(Comparison& comparison, Context& ctx)
      : comparison_(comparison),
        ctx_(ctx),
        shape_(infer_autoencoder_shape(comparison.file(), "weight.")),
        store_(autoencoder_tensors(shape_)),
        x_(comparison.file().read<2>("in.x")),
        codes_(Shape{x_.extent(0), shape_.code}),
        decoded_(Shape{x_.extent(0), shape_.features}),
        trainer_(store_, shape_, {.learning_rate = 1e-4}, ctx) {
    comparison.accept("in.x");
    for (const StoreRole role : {StoreRole::kWeights, StoreRole::kBuffers})
      store_.for_each(role, [&](const ParameterEntry& entry, std::span<float> values) {
        comparison.file().read_into("weight." + entry.name, values);
      });
  }

  void check_inference() {
    const Autoencoder autoencoder = Autoencoder::from(comparison_.file(), "weight.");
    autoencoder.encode(codes_, x_, ctx_);
    comparison_.compare("eval.code", codes_);
    autoencoder.decode(decoded_, codes_, ctx_);
    comparison_.compare("eval.decoded", decoded_);
  }

  void check_gradients() {
    const AutoencoderLoss loss = trainer_.gradients(codes_, decoded_, x_);
    comparison_.compare("train.code", codes_);
    comparison_.compare("train.decoded", decoded_);
    comparison_.compare_within("loss.l2", one(loss.l2), 1e-5);
    comparison_.compare_within("loss.cos", one(loss.cos), 1e-5);
    comparison_.compare_within("loss.total", one(loss.total(1e-3)), 1e-5);
    for_each_weight(StoreRole::kGradients, "grad.",
                    [&](const std::string& name, std::span<const float> values, std::int64_t) {
                      comparison_.compare_l2(name, values, kGradient);
                    });
    compare_statistics(1);
  }

  // Three steps on the same batch, from the weights and statistics the file starts with.
  void check_steps() {
    store_.for_each(StoreRole::kBuffers, [&](const ParameterEntry& entry, std::span<float> values) {
      comparison_.file().read_into("weight." + entry.name, values);
    });
    const std::span<const float> weights = store_.block(StoreRole::kWeights);
    const std::vector<float> before(weights.begin(), weights.end());
    std::vector<float> losses;
    const auto num_losses = static_cast<std::int64_t>(comparison_.file().at("steps.loss").size());
    for (std::int64_t step = 1; step < num_losses; ++step) {
      losses.push_back(static_cast<float>(trainer_.step(x_).total(1e-3)));
      const std::string kind = concat("after", step, ".");
      for_each_weight(
          StoreRole::kWeights, kind,
          [&](const std::string& name, std::span<const float> values, std::int64_t offset) {
            comparison_.compare_moved(
                name, values,
                std::span(before).subspan(static_cast<std::size_t>(offset), values.size()),
                kUpdate);
          });
      comparison_.end_moved(concat("after", step, ", all together"), kUpdate);
      compare_statistics(step);
    }
    losses.push_back(static_cast<float>(trainer_.gradients({}, {}, x_).total(1e-3)));
    comparison_.compare_steps("steps.loss", losses, 1e-4);
  }

 private:
  template <class Compare>
  void for_each_weight(StoreRole role, const std::string& kind, const Compare& compare) {
    store_.for_each(role, [&](const ParameterEntry& entry, std::span<const float> values) {
      const std::string layer = entry.name.substr(0, entry.name.rfind('.'));
      const std::string last = concat("encoder.", 3 * (shape_.encoder.size() - 1));
      const bool linear = comparison_.file().at("weight." + layer + ".weight").shape.size() == 2;
      if (linear && layer.starts_with("encoder.") && layer != last &&
          entry.name.ends_with(".bias")) {
        comparison_.skip(kind + entry.name, kCancelled);
      } else {
        compare(kind + entry.name, values, entry.offset);
      }
    });
  }

  void compare_statistics(std::int64_t pass) {
    store_.for_each(StoreRole::kBuffers,
                    [&](const ParameterEntry& entry, std::span<const float> values) {
                      comparison_.compare_within(concat("bn", pass, ".", entry.name), values,
                                                 pass == 1 ? kStatistics : kUpdate);
                    });
  }

  Comparison& comparison_;
  Context& ctx_;
  AutoencoderShape shape_;
  ParameterStore store_;
  Tensor<float, 2> x_, codes_, decoded_;
  AutoencoderTrainer trainer_;
};

}  // namespace

void check_autoencoder(Comparison& comparison, Context& ctx) {
  AutoencoderCase run(comparison, ctx);
  run.check_inference();
  run.check_gradients();
  run.check_steps();
}

}  // namespace check_reference
