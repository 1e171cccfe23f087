// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/parameter_store.h"

#include <algorithm>
#include <array>
#include <cmath>

#include "lvggt/core/parallel.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/model/deterministic_weights.h"
#include "lvggt/model/tensor_list.h"

namespace lvggt {
namespace {

bool is_buffer(std::string_view name) {
  return name.ends_with(".running_mean") || name.ends_with(".running_var");
}

std::int64_t aligned(std::int64_t floats) {
  return (floats + kStoreAlignment - 1) / kStoreAlignment * kStoreAlignment;
}

void append(std::vector<ParameterEntry>& entries, const TensorSpec& spec) {
  const std::int64_t offset =
      entries.empty() ? 0 : entries.back().offset + aligned(entries.back().size);
  const bool decays = spec.shape.size() > 1 && !spec.name.ends_with(".bias");
  entries.push_back({spec.name, spec.shape, offset, spec.volume(), decays});
}

Tensor<float, 1> block_for(const std::vector<ParameterEntry>& entries) {
  return Tensor<float, 1>(
      Shape{entries.empty() ? 0 : entries.back().offset + aligned(entries.back().size)});
}

std::span<float> flat(Tensor<float, 1>& tensor) {
  return {tensor.data(), static_cast<std::size_t>(tensor.size())};
}

std::span<float> part(std::span<float> block, const ParameterEntry& entry) {
  return block.subspan(static_cast<std::size_t>(entry.offset),
                       static_cast<std::size_t>(entry.size));
}

// Inputs that one output of the layer sums; of a transposed convolution PyTorch counts the outputs.
// A bias has the fan of the weight before it.
double fan_in(const std::vector<std::int64_t>& weight_shape) {
  double fan = 1;
  for (std::size_t axis = 1; axis < weight_shape.size(); ++axis)
    fan *= static_cast<double>(weight_shape[axis]);
  return fan;
}

}  // namespace

ParameterStore::ParameterStore(const ModelConfig& config, bool average)
    : ParameterStore(decoder_tensors(config), average) {
  config_ = config;
}

ParameterStore::ParameterStore(const std::vector<TensorSpec>& tensors, bool average) {
  for (const TensorSpec& spec : tensors) {
    std::vector<ParameterEntry>& entries = is_buffer(spec.name) ? buffers_ : parameters_;
    by_name_.emplace(spec.name, entries.size());
    append(entries, spec);
  }
  weights_ = block_for(parameters_);
  gradients_ = block_for(parameters_);
  first_moments_ = block_for(parameters_);
  second_moments_ = block_for(parameters_);
  if (average) average_ = block_for(parameters_);
  running_ = block_for(buffers_);
  for (const ParameterEntry& entry : buffers_)
    if (entry.name.ends_with(".running_var")) std::ranges::fill(part(flat(running_), entry), 1.0f);
}

Tensor<float, 1>& ParameterStore::tensor(StoreRole role) {
  const std::array<Tensor<float, 1>*, 6> blocks{&weights_,        &gradients_, &first_moments_,
                                                &second_moments_, &average_,   &running_};
  return *blocks[static_cast<std::size_t>(role)];
}

std::span<float> ParameterStore::block(StoreRole role) { return flat(tensor(role)); }

std::span<const float> ParameterStore::block(StoreRole role) const {
  return const_cast<ParameterStore*>(this)->block(role);
}

const ParameterEntry& ParameterStore::find(StoreRole role, std::string_view name) const {
  const bool buffer = role == StoreRole::kBuffers;
  const auto found = by_name_.find(name);
  LVGGT_CHECK(found != by_name_.end() && is_buffer(name) == buffer, "parameter store: the decoder ",
              "of this configuration has no ", buffer ? "buffer " : "parameter ", name);
  return entries(role)[found->second];
}

std::span<float> ParameterStore::values(StoreRole role, std::string_view name) {
  LVGGT_CHECK(role != StoreRole::kAverage || has_average(),
              "parameter store: it was made without a moving average");
  return part(block(role), find(role, name));
}

std::span<const float> ParameterStore::values(StoreRole role, std::string_view name) const {
  return const_cast<ParameterStore*>(this)->values(role, name);
}

std::span<float> ParameterStore::range(StoreRole role, std::string_view prefix) {
  const std::vector<ParameterEntry>& list = entries(role);
  const auto inside = [&](const ParameterEntry& entry) { return entry.name.starts_with(prefix); };
  const auto first = std::ranges::find_if(list, inside);
  const auto last = std::find_if_not(first, list.end(), inside);
  if (first == last) return {};
  const std::int64_t end = std::prev(last)->offset + aligned(std::prev(last)->size);
  return block(role).subspan(static_cast<std::size_t>(first->offset),
                             static_cast<std::size_t>(end - first->offset));
}

void ParameterStore::check_rank(const ParameterEntry& entry, int rank) const {
  LVGGT_CHECK(entry.shape.size() == static_cast<std::size_t>(rank), "parameter store: ", entry.name,
              " is ", shape_text(entry.shape), ", not of rank ", rank);
}

void ParameterStore::initialise(std::uint64_t seed, Context& ctx) {
  parallel_chunks(
      std::ssize(parameters_),
      [&](std::int64_t i, int) {
        const ParameterEntry& entry = parameters_[static_cast<std::size_t>(i)];
        const std::span<float> out = part(flat(weights_), entry);
        const bool bias = entry.name.ends_with(".bias");
        const std::string stem = entry.name.substr(0, entry.name.rfind('.'));
        const auto weight = by_name_.find(stem + ".weight");
        const std::vector<std::int64_t>& shape = parameters_[weight->second].shape;
        if (shape.size() == 1) {
          std::ranges::fill(out, bias ? 0.0f : 1.0f);
          return;
        }
        const double bound = 1 / std::sqrt(fan_in(shape));
        deterministic_uniform(entry.name, seed, -bound, bound, out);
      },
      ctx);
  for (const ParameterEntry& entry : buffers_)
    std::ranges::fill(part(flat(running_), entry),
                      entry.name.ends_with(".running_var") ? 1.0f : 0.0f);
}

void ParameterStore::initialise_deterministic(std::uint64_t seed, Context& ctx) {
  for (const StoreRole role : {StoreRole::kWeights, StoreRole::kBuffers})
    for_each(role, [&](const ParameterEntry& entry, std::span<float> values) {
      deterministic_values(entry.name, entry.shape, seed, values, ctx);
    });
}

void ParameterStore::load(const Safetensors& file) {
  std::string missing, misshapen;
  for (const auto* list : {&parameters_, &buffers_}) {
    for (const ParameterEntry& entry : *list) {
      const TensorEntry* found = file.find(entry.name);
      if (found == nullptr) {
        missing += (missing.empty() ? "" : ", ") + entry.name;
      } else if (found->shape != entry.shape) {
        misshapen += concat(misshapen.empty() ? "" : ", ", entry.name, " is ",
                            shape_text(found->shape), ", not ", shape_text(entry.shape));
      }
    }
  }
  LVGGT_CHECK(missing.empty() && misshapen.empty(), file.path(),
              ": not a decoder of this configuration; ",
              missing.empty() ? "" : "missing: ", missing,
              missing.empty() || misshapen.empty() ? "" : "; ", misshapen);
  Tensor<float, 1> weights = block_for(parameters_), running = block_for(buffers_);
  for (auto& [entries, tensor] :
       {std::pair(&parameters_, &weights), std::pair(&buffers_, &running)})
    for (const ParameterEntry& entry : *entries) {
      const std::span<float> values = part(flat(*tensor), entry);
      file.read_into(entry.name, values);
      const std::int64_t bad =
          find_nonfinite(View<const float, 1>(values.data(), Shape{entry.size}));
      if (bad >= 0)
        fail(ErrorKind::kFormat, file.path(), ": ", entry.name, " is ",
             values[static_cast<std::size_t>(bad)], " at element ", bad,
             "; training needs finite weights");
    }
  std::ranges::copy(flat(weights), weights_.data());
  std::ranges::copy(flat(running), running_.data());
}

void ParameterStore::write(SafetensorsWriter& out, bool averaged) const {
  const StoreRole weights = averaged ? StoreRole::kAverage : StoreRole::kWeights;
  for (const StoreRole role : {weights, StoreRole::kBuffers})
    for (const ParameterEntry& entry : entries(role))
      out.declare(entry.name, Dtype::kF32, entry.shape);
  for (const StoreRole role : {weights, StoreRole::kBuffers})
    for (const ParameterEntry& entry : entries(role))
      out.write(entry.name, values(role, entry.name));
}

void ParameterStore::start_average() {
  LVGGT_CHECK(has_average(), "parameter store: it was made without a moving average");
  std::ranges::copy(flat(weights_), average_.data());
}

std::size_t ParameterStore::num_bytes() const {
  return weights_.num_bytes() + gradients_.num_bytes() + first_moments_.num_bytes() +
         second_moments_.num_bytes() + average_.num_bytes() + running_.num_bytes();
}

}  // namespace lvggt
