// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <filesystem>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/cli/memory.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/cameras_json.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/preprocess.h"

namespace lvggt::cli {

// A file that a run reads.
struct RunInput {
  std::string role;  // "weights", ...
  std::string path;
  std::int64_t bytes = 0;
  std::string sha256;  // empty if not asked for
};

inline RunInput describe_input(const std::string& role, const std::string& path, bool with_hash) {
  RunInput input{role, path, 0, ""};
  std::error_code error;
  if (!std::filesystem::is_regular_file(path, error)) return input;  // a folder has no size
  input.bytes = static_cast<std::int64_t>(std::filesystem::file_size(path, error));
  if (with_hash) input.sha256 = sha256_file(path);
  return input;
}

// What run.json says about a run: enough to repeat it, to judge it, and to know whether it may be
// continued.
struct RunRecord {
  std::string tool, version;
  std::vector<std::string> arguments;
  std::string status = "running";  // then "complete", "partial", "interrupted" or "failed"
  std::string error;               // the sentence, if failed
  std::vector<RunInput> inputs;
  // What the results depend on, name and value; a run is continued only with the same ones.
  std::vector<std::pair<std::string, std::string>> settings;
  std::optional<ImageTransform> transform;
  std::int64_t frames = 0;            // complete
  std::int64_t expected_frames = -1;  // -1 if unknown
  std::vector<std::string> warnings;
  int threads = 0;
  std::vector<std::pair<std::string, double>> seconds;  // by stage
  std::size_t planned_bytes = 0;                        // memory estimated before the run
};

// What was read, what it was done with, and how long it took.
inline void write_details(JsonWriter& json, const RunRecord& record) {
  json.key("inputs");
  json.begin_array();
  for (const RunInput& input : record.inputs) {
    json.begin_object();
    json.field("role", input.role);
    json.field("path", input.path);
    json.field("bytes", input.bytes);
    if (!input.sha256.empty()) json.field("sha256", input.sha256);
    json.end_object();
  }
  json.end_array();
  json.key("settings");
  json.begin_object();
  for (const auto& [name, value] : record.settings) json.field(name, value);
  json.end_object();
  json.key("seconds");
  json.begin_object();
  for (const auto& [stage, seconds] : record.seconds) json.field(stage, seconds);
  json.end_object();
}

// The record as a JSON document, format 1.
inline std::string run_json(const RunRecord& record) {
  JsonWriter json;
  json.begin_object();
  json.field("format_version", 1);
  json.field("tool", record.tool);
  json.field("version", record.version);
  json.field("status", record.status);
  if (!record.error.empty()) json.field("error", record.error);
  json.key("arguments");
  json.begin_array();
  for (const std::string& argument : record.arguments) json.value(argument);
  json.end_array();
  json.field("frames", record.frames);
  json.key("expected_frames");
  if (record.expected_frames < 0)
    json.null();
  else
    json.value(record.expected_frames);
  json.key("preprocessing");
  if (record.transform)
    write_transform(json, *record.transform);
  else
    json.null();
  write_details(json, record);
  json.field("threads", record.threads);
  json.field("planned_memory_bytes", record.planned_bytes);
  json.field("peak_memory_bytes", peak_resident_bytes());
  json.key("warnings");
  json.begin_array();
  for (const std::string& warning : record.warnings) json.value(warning);
  json.end_array();
  json.end_object();
  return json.take();
}

// The status of an earlier run. Throws kUsage, listing the differences, when its settings are not
// those of `record`, and kFormat when the file is not a run.json of this format.
inline std::string check_same_settings(const std::string& path, const RunRecord& record) {
  const Json earlier = Json::read(path);
  const Json* version = earlier.find("format_version");
  const Json* settings = earlier.find("settings");
  const Json* status = earlier.find("status");
  const Json* tool = earlier.find("tool");
  if (version == nullptr || settings == nullptr || status == nullptr || tool == nullptr)
    fail(ErrorKind::kFormat, path, ": is not the record of a run");
  if (version->as_int64(path + ": format_version") != 1)
    fail(ErrorKind::kUnsupported, path, ": was written by another version of the program");
  std::string differences;
  if (tool->as_string(path + ": tool") != record.tool) differences = "the program; ";
  for (const auto& [name, value] : record.settings) {
    const Json* before = settings->find(name);
    const std::string old = before == nullptr ? "absent" : before->as_string(path + ": " + name);
    if (old != value) differences += name + " was " + old + " and is " + value + "; ";
  }
  if (!differences.empty())
    fail(ErrorKind::kUsage, path, ": cannot be resumed with other settings: ",
         differences.substr(0, differences.size() - 2));
  return status->as_string(path + ": status");
}

}  // namespace lvggt::cli
