// SPDX-License-Identifier: Apache-2.0
#include "examples/check_reference/recorder.h"

#include <algorithm>
#include <set>

namespace check_reference {

using lvggt::Shape;
using lvggt::View;

namespace {

std::vector<float> dense(View<const float, 2> rows) {
  std::vector<float> values;
  values.reserve(static_cast<std::size_t>(rows.size()));
  for (std::int64_t i = 0; i < rows.extent(0); ++i)
    values.insert(values.end(), rows[i].data(), rows[i].data() + rows.extent(1));
  return values;
}

}  // namespace

void Recorder::add(const std::string& name, std::span<const float> values) {
  if (comparison_.wants(name)) {
    auto& whole = outputs_[name];
    whole.insert(whole.end(), values.begin(), values.end());
  }
  const std::string of_frame = name + ".f" + std::to_string(std::max<std::int64_t>(frame_, 0));
  if (comparison_.wants(of_frame)) outputs_[of_frame].assign(values.begin(), values.end());
}

void Recorder::add_planes(const std::string& name, View<const float, 3> map) {
  std::vector<float> planes;
  planes.reserve(static_cast<std::size_t>(map.size()));
  for (std::int64_t c = 0; c < map.extent(2); ++c)
    for (std::int64_t i = 0; i < map.extent(0); ++i)
      for (std::int64_t j = 0; j < map.extent(1); ++j)
        planes.push_back(map.data()[i * map.stride(0) + j * map.stride(1) + c]);
  add(name, planes);
}

void Recorder::observe(std::string_view name, std::int64_t idx, View<const float, 2> rows) {
  if (name == "dino.tokens_in") ++frame_;  // the first value of every frame
  const std::string numbered = std::string(name) + std::to_string(idx);
  if (name == "agg.frame_block") {
    frame_rows_ = dense(rows);
  } else if (name == "agg.global_block") {
    observe_layer(idx, rows);
  } else if (name == "qkv") {
    observe_qkv(idx, rows);
  } else if (name == "agg.camera_token") {
    const std::vector<float> token = dense(rows);
    camera_tokens_.insert(camera_tokens_.end(), token.begin(), token.end());
  } else if (name == "cam.pose_enc") {
    add("cam.cached.pose_enc", dense(rows));
  } else if (name == "sbd.dpt_features") {
    add_planes(std::string(name), View<const float, 3>(rows.data(), Shape{H_, W_, rows.extent(1)},
                                                       {W_ * rows.stride(0), rows.stride(0), 1}));
  } else if (name.ends_with("_encoder.down")) {
    const std::int64_t H = H_ >> (idx - 1),
                       W = W_ >> (idx - 1);  // every stage halves, rounding down
    add_planes(numbered, View<const float, 3>(rows.data(), Shape{H, W, rows.extent(1)},
                                              {W * rows.stride(0), rows.stride(0), 1}));
  } else {
    add(name == "dino.block" ? numbered : std::string(name), dense(rows));
  }
}

// A layer's output is the tokens after its frame block beside those after its global block.
void Recorder::observe_layer(std::int64_t layer, View<const float, 2> global_rows) {
  const std::string name = "agg.layer" + std::to_string(layer);
  if (!comparison_.wants(name)) return;
  const auto [N, C] = global_rows.shape();
  std::vector<float> joined;
  joined.reserve(static_cast<std::size_t>(2 * N * C));
  for (std::int64_t n = 0; n < N; ++n) {
    joined.insert(joined.end(), frame_rows_.begin() + n * C, frame_rows_.begin() + (n + 1) * C);
    joined.insert(joined.end(), global_rows[n].data(), global_rows[n].data() + C);
  }
  add(name, joined);
}

void Recorder::observe_qkv(std::int64_t layer, View<const float, 2> qkv) {
  const std::string prefix = "kv.layer" + std::to_string(layer);
  if (!comparison_.wants(prefix + ".k") && !comparison_.wants(prefix + ".v")) return;
  const std::int64_t C = qkv.extent(1) / 3;
  cached_.push_back(
      {layer, qkv.extent(0), dense(qkv.narrow(1, C, 2 * C)), dense(qkv.narrow(1, 2 * C, 3 * C))});
}

void Recorder::compare(Comparison& comparison) const {
  for (const auto& [name, values] : outputs_) comparison.compare(name, values);
}

void Recorder::compare_cache(Comparison& comparison, std::int64_t num_cached) const {
  std::set<std::int64_t> layers;
  for (const CachedFrame& frame : cached_) layers.insert(frame.layer);
  for (const std::int64_t layer : layers) {
    std::vector<const CachedFrame*> frames;
    for (const CachedFrame& frame : cached_)
      if (frame.layer == layer) frames.push_back(&frame);
    frames.erase(frames.begin(),
                 frames.end() - std::min<std::ptrdiff_t>(num_cached, std::ssize(frames)));
    for (const bool keys : {true, false}) {
      std::vector<float> values;
      for (std::int64_t head = 0; head < num_heads_; ++head) {
        for (const CachedFrame* frame : frames) {
          const std::vector<float>& source = keys ? frame->keys : frame->values;
          const std::int64_t C = std::ssize(source) / frame->num_tokens, D = C / num_heads_;
          for (std::int64_t p = 0; p < frame->num_tokens; ++p) {
            const auto begin = source.begin() + p * C + head * D;
            values.insert(values.end(), begin, begin + D);
          }
        }
      }
      comparison.compare("kv.layer" + std::to_string(layer) + (keys ? ".k" : ".v"), values);
    }
  }
}

}  // namespace check_reference
