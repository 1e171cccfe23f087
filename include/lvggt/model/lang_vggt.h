// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/model/checkpoint.h"
#include "lvggt/model/memory_plan.h"
#include "lvggt/model/parameters.h"
#include "lvggt/model/semantic_bridging_decoder.h"
#include "lvggt/model/stream_options.h"
#include "lvggt/model/stream_vggt.h"

namespace lvggt {

// The whole model, immutable once loaded: any number of streams may share it.
class LangVggt {
 public:
  // Checks every name and shape before any tensor is read and packs tensor by tensor, so that the
  // peak is the packed model and one tensor a thread. Throws kMismatch with all missing and
  // misshapen tensors, kFormat for weights that are not finite, and what Safetensors::open and
  // load_config throw.
  static LangVggt load(const LoadOptions& options, Context& ctx) {
    const Checkpoint checkpoint(options);
    LangVggt model;
    model.config_ = checkpoint.config();
    model.geometry_ = load_stream_vggt(checkpoint, ctx);
    if (checkpoint.has_decoder()) model.decoder_ = load_semantic_bridging_decoder(checkpoint);
    model.warnings_ = checkpoint.warnings();
    if (!options.state_decoder.empty()) model.load_state_decoder(options);
    return model;
  }
  static LangVggt load(const std::string& weights) {
    Context ctx;
    return load({.weights = weights}, ctx);
  }

  const ModelConfig& config() const { return config_; }
  bool has_decoder() const { return decoder_.has_value(); }
  bool has_point_head() const { return geometry_.point_head.has_value(); }
  // A second decoder, whose features change with what objects do; it reads the same tokens.
  bool has_state_decoder() const { return state_decoder_.has_value(); }
  const ModelConfig& state_config() const { return state_config_; }  // the decoder's part counts
  const SemanticBridgingDecoder& state_decoder() const {
    LVGGT_CHECK(has_state_decoder(), "model: no state decoder was loaded");
    return *state_decoder_;
  }
  // What was odd about the weights but did not stop the loading, one sentence each.
  const std::vector<std::string>& warnings() const { return warnings_; }

  // The modules, for programs that run them one by one, or change them while no stream runs.
  const StreamVggt& geometry() const { return geometry_; }
  StreamVggt& geometry() { return geometry_; }
  const SemanticBridgingDecoder& decoder() const {
    LVGGT_CHECK(has_decoder(), "model: no decoder was loaded");
    return *decoder_;
  }
  SemanticBridgingDecoder& decoder() {
    LVGGT_CHECK(has_decoder(), "model: no decoder was loaded");
    return *decoder_;
  }

 private:
  LangVggt() = default;

  void load_state_decoder(LoadOptions options) {
    options.decoder = options.state_decoder;
    const Checkpoint checkpoint(options, config_);
    state_config_ = checkpoint.config();
    state_decoder_ = load_semantic_bridging_decoder(checkpoint);
    for (const std::string& warning : checkpoint.warnings())
      warnings_.push_back("state decoder: " + warning);
  }

  ModelConfig config_, state_config_;
  StreamVggt geometry_;
  std::optional<SemanticBridgingDecoder> decoder_, state_decoder_;
  std::vector<std::string> warnings_;
};

}  // namespace lvggt
