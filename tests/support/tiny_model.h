// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "lvggt/io/safetensors.h"
#include "lvggt/model/deterministic_weights.h"
#include "lvggt/model/stream.h"
#include "tests/support/golden.h"
#include "tests/support/paths.h"
#include "tests/support/temp_dir.h"

namespace lvggt::test {

// A tensor on its way into a weights file; a test may change it.
struct WeightTensor {
  std::string name;
  std::vector<std::int64_t> shape;
  std::vector<float> values;
  bool keep = true;
};
using ChangeWeight = std::function<void(WeightTensor&)>;

// The configuration of the reference dumps.
inline ModelConfig tiny_config() { return load_config(test_data("golden/config_tiny.json")); }

// Writes tensors with the values of the deterministic rule, seed 1, as the reference dumps used
// them.
inline void write_tensors(const std::string& path, const std::vector<TensorSpec>& specs,
                          const ModelConfig* config, const ChangeWeight& change = {}) {
  SafetensorsWriter out(path);
  if (config != nullptr) out.set_metadata("config", to_json(*config));
  for (const TensorSpec& spec : specs) {
    WeightTensor tensor{spec.name, spec.shape,
                        std::vector<float>(static_cast<std::size_t>(spec.volume()))};
    deterministic_values(spec.name, spec.shape, 1, tensor.values);
    if (change) change(tensor);
    if (tensor.keep) out.add(tensor.name, tensor.shape, tensor.values);
  }
  out.finish();
}

inline std::vector<TensorSpec> all_tensors(const ModelConfig& config) {
  std::vector<TensorSpec> specs = geometry_tensors(config);
  for (TensorSpec& spec : decoder_tensors(config)) specs.push_back(std::move(spec));
  return specs;
}

// A small model from a file of its own.
struct TinyModel {
  explicit TinyModel(const ModelConfig& config = tiny_config(), const ChangeWeight& change = {},
                     bool allow_nonfinite = false)
      : ctx(2), model(make(config, change, allow_nonfinite)) {}

  TempDir dir;
  Context ctx;
  LangVggt model;

 private:
  LangVggt make(const ModelConfig& config, const ChangeWeight& change, bool allow_nonfinite) {
    const std::string path = dir / "model.safetensors";
    write_tensors(path, all_tensors(config), &config, change);
    LoadOptions options;
    options.weights = path;
    options.allow_nonfinite = allow_nonfinite;
    return LangVggt::load(options, ctx);
  }
};

// What a frame's views show, copied before the next push.
template <int R>
Tensor<float, R> copy_of(View<const float, R> view) {
  Tensor<float, R> copy(view.shape());
  std::copy_n(view.data(), view.size(), copy.data());
  return copy;
}

}  // namespace lvggt::test
