// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/clip_config.h"

#include <filesystem>

#include "lvggt/core/error.h"

namespace lvggt {
namespace {

namespace fs = std::filesystem;

constexpr std::int64_t kMostHeads = 1024;

// A positive number of heads, or 0 when the key is not there.
std::int64_t heads_of(const Json& section, const char* key, const std::string& source) {
  const Json* value = section.find(key);
  if (value == nullptr) return 0;
  const std::int64_t heads = value->as_int64(concat(source, ": ", key));
  if (heads < 1 || heads > kMostHeads)
    fail(ErrorKind::kFormat, source, ": ", key, " is ", heads, ", expected 1 to ", kMostHeads);
  return heads;
}

ClipConfig parse_open_clip(const Json& json, const std::string& source) {
  ClipConfig config;
  config.source = source;
  const Json* vision = json.find("vision_cfg");
  const Json* text = json.find("text_cfg");
  if (const Json* quick = json.find("quick_gelu"))
    config.quick_gelu = quick->as_bool(source + ": quick_gelu");
  else
    config.quick_gelu = false;  // as OpenCLIP does
  if (text != nullptr) config.text_heads = heads_of(*text, "heads", source);
  if (vision == nullptr) return config;
  const Json* width = vision->find("width");
  if (width == nullptr) return config;
  const std::int64_t head_width = heads_of(*vision, "head_width", source);
  const std::int64_t C = width->as_int64(source + ": vision_cfg.width");
  const std::int64_t D = head_width == 0 ? 64 : head_width;
  if (C < D || C % D != 0)
    fail(ErrorKind::kFormat, source, ": vision_cfg.width ", C, " is not a multiple of the head's ",
         D);
  config.image_heads = C / D;
  return config;
}

// Whether the activation that Hugging Face names is QuickGELU.
bool quick_gelu_of(const Json& section, const std::string& source) {
  const Json* act = section.find("hidden_act");
  if (act == nullptr) return true;  // their default
  const std::string& name = act->as_string(source + ": hidden_act");
  if (name == "quick_gelu") return true;
  if (name == "gelu") return false;
  fail(ErrorKind::kUnsupported, source, ": hidden_act \"", name,
       "\" is neither gelu nor quick_gelu");
}

ClipConfig parse_hugging_face(const Json& json, const std::string& source) {
  ClipConfig config;
  config.source = source;
  const Json* vision = json.find("vision_config");
  const Json* text = json.find("text_config");
  // A checkpoint of one tower has that tower's settings at the top.
  const Json& image_section = vision != nullptr ? *vision : json;
  const Json& text_section = text != nullptr ? *text : json;
  config.image_heads = heads_of(image_section, "num_attention_heads", source);
  config.text_heads = heads_of(text_section, "num_attention_heads", source);
  config.quick_gelu = quick_gelu_of(text_section, source);
  if (quick_gelu_of(image_section, source) != *config.quick_gelu)
    fail(ErrorKind::kUnsupported, source,
         ": the two towers have different activations (hidden_act)");
  return config;
}

}  // namespace

std::int64_t clip_heads(std::int64_t width) {
  if (width == 1280 || width == 1408 || width == 1664) return 16;
  return width % 64 == 0 ? width / 64 : 1;
}

ClipConfig parse_clip_config(const Json& json, const std::string& source) {
  if (const Json* model = json.find("model_cfg")) return parse_open_clip(*model, source);
  if (json.find("vision_cfg") != nullptr || json.find("text_cfg") != nullptr)
    return parse_open_clip(json, source);
  const Json* type = json.find("model_type");
  const std::string name =
      type != nullptr && type->is_string() ? type->as_string(source + ": model_type") : "";
  if (name != "clip" && name != "clip_text_model" && name != "clip_vision_model")
    fail(ErrorKind::kMismatch, source,
         ": is not a configuration of CLIP: it has no model_cfg, and ", "its model_type is ",
         name.empty() ? "missing" : "\"" + name + "\"");
  return parse_hugging_face(json, source);
}

ClipConfig find_clip_config(const std::string& path) {
  std::error_code ignored;
  const fs::path folder =
      fs::is_directory(path, ignored) ? fs::path(path) : fs::path(path).parent_path();
  for (const char* name : {"open_clip_config.json", "config.json"}) {
    const std::string candidate = (folder / name).string();
    if (fs::exists(candidate, ignored)) return parse_clip_config(Json::read(candidate), candidate);
  }
  ClipConfig config;
  config.notes.push_back(concat(
      path, ": there is no open_clip_config.json or config.json beside the weights, so GELU (erf) ",
      "is assumed, as in OpenCLIP's own weights; OpenAI's need QuickGELU, which their "
      "configuration says"));
  return config;
}

}  // namespace lvggt
