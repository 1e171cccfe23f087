// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/cli/memory.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/train/checkpoint.h"

namespace train_decoder {

// What run.json says about a training.
struct RunRecord {
  std::string version;
  std::vector<std::string> arguments;
  std::string status = "running";  // then "complete", "interrupted" or "failed"
  std::string error;               // the sentence, if failed
  lvggt::TrainingState::Named settings, data;
  std::int64_t steps = 0, total_steps = 0;
  std::int64_t refused_steps = 0, frames_without_label = 0;
  std::optional<std::int64_t> best_step;
  double best_score = 0;
  int threads = 0, ranks = 1;
  std::size_t planned_bytes = 0;
  double seconds = 0;  // of this process
  std::vector<std::string> warnings;

  std::string json() const {
    lvggt::JsonWriter json;
    const auto list = [&](const char* key, const std::vector<std::string>& texts) {
      json.key(key);
      json.begin_array();
      for (const std::string& text : texts) json.value(text);
      json.end_array();
    };
    const auto named = [&](const char* key, const lvggt::TrainingState::Named& values) {
      json.key(key);
      json.begin_object();
      for (const auto& [name, value] : values) json.field(name, value);
      json.end_object();
    };
    json.begin_object();
    json.field("format_version", 1);
    json.field("tool", "train_decoder");
    json.field("version", version);
    json.field("status", status);
    if (!error.empty()) json.field("error", error);
    list("arguments", arguments);
    json.field("steps", steps);
    json.field("total_steps", total_steps);
    json.field("refused_steps", refused_steps);
    json.field("frames_without_label", frames_without_label);
    if (best_step) {
      json.field("best_step", *best_step);
      json.field("best_score", best_score);
    }
    named("settings", settings);
    named("data", data);
    json.field("threads", threads);
    json.field("ranks", ranks);
    json.field("planned_memory_bytes", planned_bytes);
    json.field("peak_memory_bytes", lvggt::cli::peak_resident_bytes());
    json.field("seconds", seconds);
    list("warnings", warnings);
    json.end_object();
    return json.take();
  }
};

}  // namespace train_decoder
