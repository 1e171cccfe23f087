// SPDX-License-Identifier: Apache-2.0
#include "kernels/train/training_state.h"

#include "lvggt/io/hash.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"

namespace lvggt {
namespace {

const Json& member(const Json& json, const char* key, const std::string& path) {
  const Json* found = json.find(key);
  if (found == nullptr)
    fail(ErrorKind::kFormat, path, ": is not a training checkpoint: its state has no '", key, "'");
  return *found;
}

void write_named(JsonWriter& json, const char* key, const TrainingState::Named& named) {
  json.key(key);
  json.begin_object();
  for (const auto& [name, value] : named) json.field(name, value);
  json.end_object();
}

TrainingState::Named read_named(const Json& json, const char* key, const std::string& path) {
  TrainingState::Named named;
  for (const auto& [name, value] : member(json, key, path).as_object(path + ": " + key))
    named.emplace_back(name, value.as_string(path + ": " + name));
  return named;
}

const std::string* find_named(const TrainingState::Named& named, const std::string& name) {
  for (const auto& [key, value] : named)
    if (key == name) return &value;
  return nullptr;
}

// Where two configurations, both JSON objects, are not the same.
void config_differences(const std::string& found, const std::string& wanted,
                        std::vector<std::string>& differences) {
  if (found == wanted) return;
  const Json before = Json::parse(found, "configuration of the checkpoint");
  const Json now = Json::parse(wanted, "configuration of the run");
  const auto text = [](const Json& value) {
    if (value.is_bool()) return std::string(value.as_bool("") ? "true" : "false");
    if (value.is_number()) return concat(value.as_double(""));
    if (value.is_string()) return value.as_string("");
    std::string list;
    if (value.is_array())
      for (const Json& item : value.as_array(""))
        list += (list.empty() ? "" : " ") +
                (item.is_number() ? concat(item.as_double("")) : std::string("?"));
    return "[" + list + "]";
  };
  const std::size_t count = differences.size();
  for (const auto& [key, value] : now.as_object("configuration of the run")) {
    const Json* old = before.find(key);
    // The name describes only.
    if (key == "name" || (old != nullptr && text(*old) == text(value))) continue;
    differences.push_back(concat("configuration: ", key, " was ",
                                 old == nullptr ? "absent" : text(*old), " and is ", text(value)));
  }
  if (differences.size() == count && before.as_object("").size() != now.as_object("").size())
    differences.push_back("configuration: the checkpoint's has other keys");
}

}  // namespace

std::vector<std::string> state_differences(const TrainingState& found,
                                           const TrainingState& wanted) {
  std::vector<std::string> differences;
  config_differences(found.config, wanted.config, differences);
  if (found.data_manifest != wanted.data_manifest)
    differences.push_back(concat("data set: its hash was ", found.data_manifest.substr(0, 12),
                                 " and is ", wanted.data_manifest.substr(0, 12)));
  for (const auto& [name, value] : wanted.settings) {
    const std::string* old = find_named(found.settings, name);
    if (old == nullptr || *old != value)
      differences.push_back(
          concat(name, " was ", old == nullptr ? "absent" : *old, " and is ", value));
  }
  for (const auto& [name, value] : found.settings)
    if (find_named(wanted.settings, name) == nullptr)
      differences.push_back(concat(name, " was ", value, " and is absent"));
  return differences;
}

namespace training {

std::string text_sum(const std::string& text) {
  return sha256(std::as_bytes(std::span(text.data(), text.size())));
}

std::string state_json(const TrainingState& state, const std::string& tool_version) {
  JsonWriter json;
  json.begin_object();
  json.field("format_version", kStateVersion);
  json.field("tool_version", tool_version);
  json.field("step", state.step);
  json.field("config_sha256", text_sum(state.config));
  json.field("data_manifest", state.data_manifest);
  write_named(json, "settings", state.settings);
  write_named(json, "surroundings", state.surroundings);
  write_named(json, "values", {state.values.begin(), state.values.end()});
  json.end_object();
  return json.take();
}

ParsedState parse_state(const std::map<std::string, std::string>& metadata,
                        const std::string& path) {
  const auto text = metadata.find(kStateKey);
  const auto config = metadata.find(kConfigKey);
  if (text == metadata.end() || config == metadata.end())
    fail(ErrorKind::kFormat, path, ": is not a training checkpoint: its metadata has no '",
         text == metadata.end() ? kStateKey : kConfigKey, "'");
  const Json json = Json::parse(text->second, path + ": training state");
  ParsedState parsed;
  parsed.tool_version = member(json, "tool_version", path).as_string(path + ": tool_version");
  const std::int64_t version =
      member(json, "format_version", path).as_int64(path + ": format_version");
  if (version > kStateVersion)
    fail(ErrorKind::kUnsupported, path, ": was written by version ", parsed.tool_version,
         " in format ", version, "; this version reads formats up to ", kStateVersion);
  TrainingState& state = parsed.state;
  state.config = config->second;
  state.step = member(json, "step", path).as_int64(path + ": step");
  state.data_manifest = member(json, "data_manifest", path).as_string(path + ": data_manifest");
  state.settings = read_named(json, "settings", path);
  state.surroundings = read_named(json, "surroundings", path);
  for (const auto& [name, value] : read_named(json, "values", path)) state.values[name] = value;
  if (state.step < 0 ||
      member(json, "config_sha256", path).as_string(path) != text_sum(state.config))
    fail(ErrorKind::kFormat, path, ": its training state does not fit its configuration");
  return parsed;
}

std::string sums_json(const std::map<std::string, std::string>& sums) {
  JsonWriter json;
  json.begin_object();
  for (const auto& [name, sum] : sums) json.field(name, sum);
  json.end_object();
  return json.take();
}

std::map<std::string, std::string> parse_sums(const std::string& text, const std::string& path) {
  std::map<std::string, std::string> sums;
  const Json json = Json::parse(text, path + ": tensor sums");
  for (const auto& [name, sum] : json.as_object(path + ": tensor sums"))
    sums[name] = sum.as_string(path + ": " + name);
  return sums;
}

std::string header_sum(std::span<const TensorEntry> entries,
                       const std::map<std::string, std::string>& metadata) {
  // Lengths before texts: no two headers have the same sum for moving a character.
  std::string text;
  const auto append = [&](std::string_view part) { text += concat(part.size(), ':', part, ';'); };
  for (const TensorEntry& entry : entries) {
    append(entry.name);
    append(dtype_name(entry.dtype));
    append(shape_text(entry.shape));
  }
  for (const auto& [key, value] : metadata) {
    if (key == kHeaderSumKey) continue;
    append(key);
    append(value);
  }
  return text_sum(text);
}

}  // namespace training
}  // namespace lvggt
