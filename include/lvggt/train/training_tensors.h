// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "lvggt/io/hash.h"
#include "lvggt/train/checkpoint.h"
#include "lvggt/train/parameter_store.h"

namespace lvggt {

// What a training checkpoint holds of a store: weights and running statistics under their published
// names, and as train.first_moment.NAME, train.second_moment.NAME and train.average.NAME what the
// optimiser keeps for each parameter. The views are the store's own memory.
inline std::vector<TrainingTensor> training_tensors(ParameterStore& store) {
  std::vector<TrainingTensor> tensors;
  const auto add = [&](StoreRole role, const std::string& prefix) {
    store.for_each(role, [&](const ParameterEntry& entry, std::span<float> values) {
      tensors.push_back({prefix + entry.name, entry.shape, values});
    });
  };
  add(StoreRole::kWeights, "");
  add(StoreRole::kBuffers, "");
  add(StoreRole::kFirstMoments, "train.first_moment.");
  add(StoreRole::kSecondMoments, "train.second_moment.");
  if (store.has_average()) add(StoreRole::kAverage, "train.average.");
  return tensors;
}

// SHA-256 over everything training_tensors() lists: equal on two ranks only if they are in the same
// state.
inline std::string training_sha256(ParameterStore& store) {
  std::string sums;
  for (const TrainingTensor& tensor : training_tensors(store))
    sums += tensor.name + ' ' + sha256(std::as_bytes(tensor.values)) + '\n';
  return sha256(std::as_bytes(std::span(sums.data(), sums.size())));
}

}  // namespace lvggt
