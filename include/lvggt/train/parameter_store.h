// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/model/config.h"
#include "lvggt/model/tensor_list.h"

namespace lvggt {

// One tensor of the store: a parameter, or a buffer (running statistics of a batch norm).
struct ParameterEntry {
  std::string name;  // in the published checkpoint
  std::vector<std::int64_t> shape;
  std::int64_t offset = 0;  // in the flat block, a multiple of kStoreAlignment
  std::int64_t size = 0;
  bool decays = false;  // weight decay: rank above 1 and not a bias
};

// Floats from one tensor's start to the next are a multiple of this: a cache line.
inline constexpr std::int64_t kStoreAlignment = kAlignment / sizeof(float);

// The flat blocks. All but the buffers have the same layout.
enum class StoreRole {
  kWeights,
  kGradients,
  kFirstMoments,   // m of AdamW
  kSecondMoments,  // v
  kAverage,        // exponential moving average of the weights; empty unless asked for
  kBuffers,        // running statistics
};

// The decoder's parameters and everything training keeps for each, one flat float32 block a role,
// tensors in the order of decoder_tensors(); the gaps between tensors are and stay 0.
class ParameterStore {
 public:
  // All zero but the running variances, which are 1. `average`: with the moving average.
  explicit ParameterStore(const ModelConfig& config, bool average = false);

  // The same for tensors of any names and shapes, without a configuration.
  explicit ParameterStore(const std::vector<TensorSpec>& tensors, bool average = false);

  const ModelConfig& config() const { return config_; }
  bool has_average() const { return !average_.empty(); }

  const std::vector<ParameterEntry>& parameters() const { return parameters_; }
  const std::vector<ParameterEntry>& buffers() const { return buffers_; }
  const std::vector<ParameterEntry>& entries(StoreRole role) const {
    return role == StoreRole::kBuffers ? buffers_ : parameters_;
  }

  // A whole block, with the gaps.
  std::span<float> block(StoreRole role);
  std::span<const float> block(StoreRole role) const;

  // One tensor's values in a block; a name the role does not have is a kMismatch Error.
  std::span<float> values(StoreRole role, std::string_view name);
  std::span<const float> values(StoreRole role, std::string_view name) const;

  template <int R>
  View<float, R> view(StoreRole role, std::string_view name) {
    return View<float, R>(values(role, name).data(), shape_of<R>(role, name));
  }
  template <int R>
  View<const float, R> view(StoreRole role, std::string_view name) const {
    return View<const float, R>(values(role, name).data(), shape_of<R>(role, name));
  }

  // The part of a block that holds the parameters whose names start with `prefix`, which are
  // neighbours; empty when there are none.
  std::span<float> range(StoreRole role, std::string_view prefix);

  // calls f(entry, values) for every tensor of a role.
  template <class F>
  void for_each(StoreRole role, const F& f) {
    for (const ParameterEntry& entry : entries(role))
      f(entry, block(role).subspan(static_cast<std::size_t>(entry.offset),
                                   static_cast<std::size_t>(entry.size)));
  }

  // PyTorch's default initialisation: weights and biases of convolutions and linear layers uniform
  // in +-1/sqrt(fan in), norms 1 and 0, running mean 0 and variance 1. A function of names and
  // seed.
  void initialise(std::uint64_t seed, Context& ctx);

  // The deterministic rule (deterministic_values), running statistics included.
  void initialise_deterministic(std::uint64_t seed, Context& ctx);

  // Weights and running statistics from a checkpoint that has them under their published names; its
  // other tensors are not looked at. One kMismatch error lists all that is missing or misshapen;
  // kFormat when a value is not finite. Either everything is read or nothing.
  void load(const Safetensors& file);

  // Declares weights and running statistics, then writes them; the caller sets metadata before and
  // finishes after. `averaged`: the moving average in place of the weights.
  void write(SafetensorsWriter& out, bool averaged = false) const;

  // Copies the weights into the moving average.
  void start_average();

  // Floats in memory, all blocks together, in bytes.
  std::size_t num_bytes() const;

 private:
  const ParameterEntry& find(StoreRole role, std::string_view name) const;
  Tensor<float, 1>& tensor(StoreRole role);
  void check_rank(const ParameterEntry& entry, int rank) const;

  template <int R>
  Shape<R> shape_of(StoreRole role, std::string_view name) const {
    const ParameterEntry& entry = find(role, name);
    check_rank(entry, R);
    Shape<R> shape;
    for (int axis = 0; axis < R; ++axis) shape[axis] = entry.shape[static_cast<std::size_t>(axis)];
    return shape;
  }

  ModelConfig config_;
  std::vector<ParameterEntry> parameters_, buffers_;
  std::map<std::string, std::size_t, std::less<>> by_name_;  // index in either list
  Tensor<float, 1> weights_, gradients_, first_moments_, second_moments_, average_, running_;
};

}  // namespace lvggt
