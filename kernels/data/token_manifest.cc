// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <filesystem>
#include <set>
#include <string_view>

#include "lvggt/core/error.h"
#include "lvggt/data/token_cache.h"
#include "lvggt/io/cameras_json.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"

namespace lvggt {

namespace {

constexpr std::int64_t kFormatVersion = 1;

std::string sha256_text(std::string_view text) {
  return sha256(std::as_bytes(std::span(text.data(), text.size())));
}

// Keys of the configuration that the encoder's values depend on.
constexpr std::array<std::string_view, 16> kEncoderKeys{
    "img_size",   "patch_size",  "image_mean",          "image_std",    "embed_dim",   "dino_depth",
    "dino_heads", "mlp_ratio",   "num_register_tokens", "dino_qk_norm", "dino_ln_eps", "agg_depth",
    "agg_heads",  "agg_qk_norm", "agg_ln_eps",          "rope_freq"};

bool is_encoder_key(std::string_view key) {
  return key == "taps" ||
         std::find(kEncoderKeys.begin(), kEncoderKeys.end(), key) != kEncoderKeys.end();
}

void write_json(JsonWriter& json, const Json& value) {
  if (value.is_bool()) return json.value(value.as_bool(""));
  if (value.is_integer()) return json.value(value.as_int64(""));
  if (value.is_number()) return json.value(value.as_double(""));
  if (value.is_string()) return json.value(value.as_string(""));
  if (value.is_array()) {
    json.begin_array();
    for (const Json& element : value.as_array("")) write_json(json, element);
    return json.end_array();
  }
  if (!value.is_object()) return json.null();
  json.begin_object();
  for (const auto& [key, member] : value.as_object("")) {
    json.key(key);
    write_json(json, member);
  }
  json.end_object();
}

// The encoder's part of a configuration as JSON text, and back.
std::string encoder_json(const ModelConfig& config) {
  const Json all = Json::parse(to_json(config), "the configuration");
  Json::Object kept;
  for (const auto& [key, value] : all.as_object("the configuration"))
    if (is_encoder_key(key)) kept.emplace_back(key, value);
  JsonWriter json;
  write_json(json, Json(std::move(kept)));
  return json.take();
}

std::string_view yes_no(bool flag) { return flag ? "yes" : "no"; }

// Name and value of every setting but the configuration.
std::vector<std::pair<std::string, std::string>> settings_list(const TokenSettings& s) {
  return {{"encoder_sha256", s.encoder_sha256},
          {"mode", std::string(frame_mode_name(s.preprocess.mode))},
          {"size", std::to_string(s.preprocess.size)},
          {"rotate_to_portrait", std::string(yes_no(s.preprocess.rotate_to_portrait))},
          {"max_past_frames", std::to_string(s.max_past_frames)},
          {"keep_first_frame", std::string(yes_no(s.window.keep_first))},
          {"keep_every", std::to_string(s.window.keep_every)},
          {"weights_storage", s.weights_storage},
          {"cache_storage", std::string(storage_name(s.cache_storage))},
          {"storage", std::string(dtype_name(s.storage))}};
}

// The members of an object, each looked up by name and checked.
class Members {
 public:
  Members(const Json& object, std::string place) : object_(object), place_(std::move(place)) {
    object_.as_object(place_);
  }

  const Json& at(const char* key) const {
    const Json* value = object_.find(key);
    if (value == nullptr) fail(ErrorKind::kFormat, place_, ": has no \"", key, "\"");
    return *value;
  }
  std::string place(const char* key) const { return place_ + ": " + key; }
  std::string text(const char* key) const { return at(key).as_string(place(key)); }
  std::int64_t number(const char* key) const { return at(key).as_int64(place(key)); }
  Members members(const char* key) const { return {at(key), place(key)}; }

  // A number in [low, high].
  std::int64_t number(const char* key, std::int64_t low, std::int64_t high) const {
    const std::int64_t value = number(key);
    if (value < low || value > high)
      fail(ErrorKind::kFormat, place(key), " is ", value, ", not from ", low, " to ", high);
    return value;
  }
  bool yes(const char* key) const {
    const std::string value = text(key);
    if (value != "yes" && value != "no")
      fail(ErrorKind::kFormat, place(key), " is '", value, "', not yes or no");
    return value == "yes";
  }

 private:
  const Json& object_;
  std::string place_;
};

TokenSettings read_settings(const Members& root) {
  constexpr std::int64_t kMany = std::int64_t{1} << 40;
  const Members m = root.members("settings");
  TokenSettings s;
  s.encoder_sha256 = m.text("encoder_sha256");
  s.preprocess.mode = parse_frame_mode(m.text("mode"));
  const auto number_text = [&](const char* key, std::int64_t low, std::int64_t high) {
    const Json number = Json::parse(m.text(key), m.place(key));
    const std::int64_t value = number.as_int64(m.place(key));
    if (value < low || value > high)
      fail(ErrorKind::kFormat, m.place(key), " is ", value, ", not from ", low, " to ", high);
    return value;
  };
  s.preprocess.size = static_cast<int>(number_text("size", kPatchSize, kMaxFrameSize));
  s.preprocess.rotate_to_portrait = m.yes("rotate_to_portrait");
  s.max_past_frames = number_text("max_past_frames", 1, kMany);
  s.window.keep_first = m.yes("keep_first_frame");
  s.window.keep_every = number_text("keep_every", 0, kMany);
  s.weights_storage = m.text("weights_storage");
  s.cache_storage = parse_storage(m.text("cache_storage"), m.place("cache_storage"));
  const std::string storage = m.text("storage");
  if (storage != "BF16" && storage != "F32")
    fail(ErrorKind::kFormat, m.place("storage"), " is '", storage, "', not BF16 or F32");
  s.storage = storage == "F32" ? Dtype::kF32 : Dtype::kBF16;
  JsonWriter config;
  write_json(config, root.at("config"));
  s.config = encoder_config(parse_config(config.take(), root.place("config")));
  return s;
}

ImageTransform read_transform(const Members& m) {
  constexpr std::int64_t kMaxSide = (std::int64_t{1} << 31) - 1;
  const auto side = [&](const char* key) { return static_cast<int>(m.number(key, 1, kMaxSide)); };
  const auto pair = [&](const char* key, double& x, double& y) {
    const auto& values = m.at(key).as_array(m.place(key));
    if (values.size() != 2) fail(ErrorKind::kFormat, m.place(key), " is not a pair of numbers");
    x = values[0].as_double(m.place(key));
    y = values[1].as_double(m.place(key));
  };
  ImageTransform t;
  t.original_width = side("original_width");
  t.original_height = side("original_height");
  t.quarter_turns_ccw = static_cast<int>(m.number("quarter_turns_ccw", 0, 1));
  t.width = side("model_width");
  t.height = side("model_height");
  pair("scale", t.scale_x, t.scale_y);
  pair("offset", t.offset_x, t.offset_y);
  return t;
}

// A name that stays in the folder.
void check_name(const std::string& name, const std::string& place) {
  if (name.empty() || name[0] == '.' || name.find('/') != std::string::npos ||
      name.find('\0') != std::string::npos)
    fail(ErrorKind::kFormat, place, ": ", json_quote(name), " cannot be the name of a frame");
}

}  // namespace

ModelConfig encoder_config(const ModelConfig& config) {
  ModelConfig e;
  e.name = "encoder";
  e.img_size = config.img_size;
  e.patch_size = config.patch_size;
  e.image_mean = config.image_mean;
  e.image_std = config.image_std;
  e.embed_dim = config.embed_dim;
  e.dino_depth = config.dino_depth;
  e.dino_heads = config.dino_heads;
  e.mlp_ratio = config.mlp_ratio;
  e.num_register_tokens = config.num_register_tokens;
  e.dino_qk_norm = config.dino_qk_norm;
  e.dino_ln_eps = config.dino_ln_eps;
  e.agg_depth = config.agg_depth;
  e.agg_heads = config.agg_heads;
  e.agg_qk_norm = config.agg_qk_norm;
  e.agg_ln_eps = config.agg_ln_eps;
  e.rope_freq = config.rope_freq;
  e.taps = config.taps;
  return e;
}

std::string next_stream_sha256(const std::string& before, const TokenSettings& settings,
                               const std::string& name, const std::string& image_sha256) {
  std::string text = before;
  if (text.empty()) {
    for (const auto& [key, value] : settings_list(settings)) text += key + " " + value + "\n";
    text = sha256_text(text + encoder_json(settings.config));
  }
  return sha256_text(text + "\n" + name + "\n" + image_sha256 + "\n");
}

std::string token_difference(const TokenSettings& found, const TokenSettings& wanted) {
  std::string text = config_difference(found.config, wanted.config);
  const auto ours = settings_list(found), theirs = settings_list(wanted);
  for (std::size_t i = 0; i < ours.size(); ++i)
    if (ours[i].second != theirs[i].second)
      text += (text.empty() ? "" : "; ") + ours[i].first + " is " + ours[i].second + ", not " +
              theirs[i].second;
  return text;
}

std::string to_json(const TokenManifest& manifest) {
  JsonWriter json;
  json.begin_object();
  json.field("format_version", kFormatVersion);
  json.field("tool", "make_tokens");
  json.field("version", manifest.tool_version);
  json.field("status", manifest.complete ? "complete" : "partial");
  json.field("weights", manifest.weights);
  json.field("source", manifest.source);
  json.field("source_sha256", manifest.source_sha256);
  json.field("start", manifest.start);
  json.field("stride", manifest.stride);
  json.key("settings");
  json.begin_object();
  for (const auto& [name, value] : settings_list(manifest.settings)) json.field(name, value);
  json.end_object();
  json.key("config");
  write_json(json, Json::parse(encoder_json(manifest.settings.config), "the configuration"));
  json.key("transform");
  write_transform(json, manifest.transform);
  json.key("frames");
  json.begin_array();
  for (const TokenFrame& frame : manifest.frames) {
    json.begin_object();
    json.field("name", frame.name);
    json.field("image", frame.image);
    json.field("source_index", frame.source_index);
    json.field("image_sha256", frame.image_sha256);
    json.field("stream_sha256", frame.stream_sha256);
    json.end_object();
  }
  json.end_array();
  json.end_object();
  return json.take();
}

TokenManifest read_token_manifest(const std::string& path) {
  const Json document = Json::read(path);
  const Members root(document, path);
  if (root.number("format_version") != kFormatVersion)
    fail(ErrorKind::kUnsupported, path, ": is of format ", root.number("format_version"),
         ", but this version reads format ", kFormatVersion);
  TokenManifest manifest;
  manifest.tool_version = root.text("version");
  manifest.complete = root.text("status") == "complete";
  manifest.weights = root.text("weights");
  manifest.source = root.text("source");
  manifest.source_sha256 = root.text("source_sha256");
  manifest.start = root.number("start");
  manifest.stride = root.number("stride");
  manifest.settings = read_settings(root);
  manifest.transform = read_transform(root.members("transform"));
  const std::int64_t patch = manifest.settings.config.patch_size;
  if (manifest.transform.width % patch != 0 || manifest.transform.height % patch != 0)
    fail(ErrorKind::kFormat, path, ": frames of ", manifest.transform.width, " x ",
         manifest.transform.height, " pixels are not made of whole patches of ", patch);
  std::set<std::string> names;
  std::string stream;
  for (const Json& entry : root.at("frames").as_array(root.place("frames"))) {
    const Members m(entry, root.place("frames"));
    TokenFrame frame{m.text("name"), m.text("image"), m.number("source_index"),
                     m.text("image_sha256"), m.text("stream_sha256")};
    check_name(frame.name, root.place("frames"));
    if (!frame.image.empty()) check_name(frame.image, root.place("frames"));
    if (!names.insert(frame.name).second)
      fail(ErrorKind::kFormat, root.place("frames"), ": the frame ", json_quote(frame.name),
           " is there twice");
    stream = next_stream_sha256(stream, manifest.settings, frame.name, frame.image_sha256);
    if (stream != frame.stream_sha256)
      fail(ErrorKind::kFormat, path, ": the settings or frames up to ", json_quote(frame.name),
           " were changed after the tokens were made");
    manifest.frames.push_back(std::move(frame));
  }
  return manifest;
}

}  // namespace lvggt
