// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/config.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <utility>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/model/checkpoint.h"

namespace lvggt {
namespace {

constexpr std::size_t kMaxConfigBytes = std::size_t{1} << 20;
// Of any one size: the product of three stays within 64 bits.
constexpr std::int64_t kMaxExtent = 1 << 20;
constexpr std::int64_t kMaxDepth = 1000;

// Lists every field once, for reading and for writing.
template <class Config, class Visit>
void for_each_field(Config& c, Visit&& visit) {
  visit("name", c.name);
  visit("img_size", c.img_size);
  visit("patch_size", c.patch_size);
  visit("image_mean", c.image_mean);
  visit("image_std", c.image_std);
  visit("embed_dim", c.embed_dim);
  visit("dino_depth", c.dino_depth);
  visit("dino_heads", c.dino_heads);
  visit("mlp_ratio", c.mlp_ratio);
  visit("num_register_tokens", c.num_register_tokens);
  visit("dino_qk_norm", c.dino_qk_norm);
  visit("dino_ln_eps", c.dino_ln_eps);
  visit("agg_depth", c.agg_depth);
  visit("agg_heads", c.agg_heads);
  visit("agg_qk_norm", c.agg_qk_norm);
  visit("agg_ln_eps", c.agg_ln_eps);
  visit("rope_freq", c.rope_freq);
  visit("taps", c.taps);
  visit("cam_heads", c.cam_heads);
  visit("cam_trunk_depth", c.cam_trunk_depth);
  visit("cam_iterations", c.cam_iterations);
  visit("cam_qk_norm", c.cam_qk_norm);
  visit("cam_ln_eps", c.cam_ln_eps);
  visit("cam_adaln_eps", c.cam_adaln_eps);
  visit("dpt_features", c.dpt_features);
  visit("dpt_out_channels", c.dpt_out_channels);
  visit("dpt_head_features_2", c.dpt_head_features_2);
  visit("dpt_pos_embed_ratio", c.dpt_pos_embed_ratio);
  visit("dpt_ln_eps", c.dpt_ln_eps);
  visit("sbd_features", c.sbd_features);
  visit("sbd_out_channels", c.sbd_out_channels);
  visit("sbd_hidden_dim", c.sbd_hidden_dim);
  visit("lang_dim", c.lang_dim);
  visit("sbd_levels", c.sbd_levels);
  visit("sbd_rgb", c.sbd_rgb);
  visit("sbd_head", c.sbd_head);
  visit("sbd_dpt", c.sbd_dpt);
  visit("bn_eps", c.bn_eps);
  visit("bn_momentum", c.bn_momentum);
}

// Values as JSON.
template <class Number>
requires(std::integral<Number> || std::floating_point<Number>) std::string text_of(Number value) {
  std::string text;
  append_number(text, value);
  return text;
}
std::string text_of(bool value) { return value ? "true" : "false"; }
std::string text_of(const std::string& value) { return json_quote(value); }
std::string text_of(DecoderHead value) {
  return value == DecoderHead::kUnet ? "\"unet\"" : "\"mlp\"";
}
template <class T, std::size_t N>
std::string text_of(const std::array<T, N>& values) {
  std::string text;
  for (const T& value : values) text += (text.empty() ? "[" : ", ") + text_of(value);
  return text + "]";
}
std::string text_of(const Json& value) {
  if (value.is_bool()) return text_of(value.as_bool(""));
  if (value.is_integer()) return text_of(value.as_int64(""));
  if (value.is_number()) return text_of(value.as_double(""));
  if (value.is_string()) return text_of(value.as_string("").substr(0, 60));
  return std::string(value.kind_name());
}

// Options of the published code that are implemented with one value only, and that value as JSON.
constexpr std::pair<const char*, const char*> kFixedOptions[] = {
    {"interpolate_antialias", "true"}, {"interpolate_offset", "0"},
    {"depth_activation", "\"exp\""},   {"point_activation", "\"inv_log\""},
    {"conf_activation", "\"expp1\""},
};

bool describes_only(std::string_view key) {
  return key == "seed" || key.starts_with("ae_") || key.ends_with("_init_values");
}

std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::size_t> row(b.size() + 1);
  std::iota(row.begin(), row.end(), std::size_t{0});
  for (std::size_t i = 0; i < a.size(); ++i) {
    std::size_t diagonal = row[0];
    row[0] = i + 1;
    for (std::size_t j = 0; j < b.size(); ++j) {
      const std::size_t substituted = diagonal + (a[i] == b[j] ? 0 : 1);
      diagonal = row[j + 1];
      row[j + 1] = std::min({row[j] + 1, row[j + 1] + 1, substituted});
    }
  }
  return row.back();
}

// One value of the JSON object into one field.
class FieldReader {
 public:
  FieldReader(const Json& object, std::string_view source) : object_(object), source_(source) {}

  template <class Field>
  void operator()(const char* key, Field& field) {
    known_.emplace_back(key);
    if (const Json* value = object_.find(key)) read(key, *value, field);
  }
  const std::vector<std::string>& known() const { return known_; }

 private:
  [[noreturn]] void wrong(const char* key, const Json& value, const char* wanted) const {
    fail(ErrorKind::kFormat, source_, ": \"", key, "\" must be ", wanted, ", not ", text_of(value));
  }
  void read(const char* key, const Json& value, std::int64_t& field) const {
    if (!value.is_integer()) wrong(key, value, "an integer");
    field = value.as_int64(key);
  }
  void read(const char* key, const Json& value, double& field) const {
    if (!value.is_number()) wrong(key, value, "a number");
    field = value.as_double(key);
  }
  void read(const char* key, const Json& value, bool& field) const {
    if (!value.is_bool()) wrong(key, value, "true or false");
    field = value.as_bool(key);
  }
  void read(const char* key, const Json& value, std::string& field) const {
    if (!value.is_string()) wrong(key, value, "a string");
    field = value.as_string(key);
  }
  void read(const char* key, const Json& value, DecoderHead& field) const {
    for (const DecoderHead head : {DecoderHead::kUnet, DecoderHead::kMlp}) {
      if (text_of(value) != text_of(head)) continue;
      field = head;
      return;
    }
    wrong(key, value, "\"unet\" or \"mlp\"");
  }
  template <class T, std::size_t N>
  void read(const char* key, const Json& value, std::array<T, N>& field) const {
    if (!value.is_array() || value.as_array(key).size() != N)
      wrong(key, value, N == 3 ? "a list of 3 values" : "a list of 4 values");
    for (std::size_t i = 0; i < N; ++i) read(key, value.as_array(key)[i], field[i]);
  }

  const Json& object_;
  std::string_view source_;
  std::vector<std::string> known_;
};

void refuse_unknown_keys(const Json& object, std::vector<std::string> known,
                         std::string_view source) {
  for (const auto& [key, implemented] : kFixedOptions) {
    known.emplace_back(key);
    const Json* value = object.find(key);
    if (value != nullptr && text_of(*value) != implemented)
      fail(ErrorKind::kUnsupported, source, ": \"", key, "\" is ", text_of(*value), ", but only ",
           implemented, " is implemented");
  }
  for (const auto& [key, value] : object.as_object(source)) {
    if (describes_only(key) || std::find(known.begin(), known.end(), key) != known.end()) continue;
    const std::string_view shown = std::string_view(key).substr(0, 100);
    const auto nearest =
        std::min_element(known.begin(), known.end(), [&](const auto& a, const auto& b) {
          return edit_distance(shown, a) < edit_distance(shown, b);
        });
    fail(ErrorKind::kFormat, source, ": unknown key \"", shown, "\" (the nearest known key is \"",
         *nearest, "\")");
  }
}

struct Range {
  const char* key;
  std::int64_t value, low, high;
};

void check_ranges(const ModelConfig& c, std::string_view source) {
  const Range ranges[] = {
      {"img_size", c.img_size, 1, kMaxExtent},
      {"patch_size", c.patch_size, 1, 256},
      {"embed_dim", c.embed_dim, 4, kMaxExtent},
      {"dino_depth", c.dino_depth, 0, kMaxDepth},
      {"dino_heads", c.dino_heads, 1, kMaxExtent},
      {"num_register_tokens", c.num_register_tokens, 0, 4096},
      {"agg_depth", c.agg_depth, 1, kMaxDepth},
      {"agg_heads", c.agg_heads, 1, kMaxExtent},
      {"cam_heads", c.cam_heads, 1, kMaxExtent},
      {"cam_trunk_depth", c.cam_trunk_depth, 0, kMaxDepth},
      {"cam_iterations", c.cam_iterations, 1, kMaxDepth},
      {"dpt_features", c.dpt_features, 2, kMaxExtent},
      {"dpt_head_features_2", c.dpt_head_features_2, 1, kMaxExtent},
      {"sbd_features", c.sbd_features, 1, kMaxExtent},
      {"sbd_hidden_dim", c.sbd_hidden_dim, 1, kMaxExtent / 8},
      {"lang_dim", c.lang_dim, 1, 4096},
  };
  for (const Range& r : ranges)
    LVGGT_CHECK(r.low <= r.value && r.value <= r.high, source, ": \"", r.key, "\" must lie in [",
                r.low, ", ", r.high, "], not ", r.value);
  for (const auto& channels : {c.dpt_out_channels, c.sbd_out_channels})
    for (const std::int64_t n : channels)
      LVGGT_CHECK(1 <= n && n <= kMaxExtent, source, ": output channels must lie in [1, ",
                  kMaxExtent, "], not ", n);
  for (const double eps :
       {c.dino_ln_eps, c.agg_ln_eps, c.cam_ln_eps, c.cam_adaln_eps, c.dpt_ln_eps, c.bn_eps})
    LVGGT_CHECK(eps > 0 && eps < 1, source, ": an eps must lie in (0, 1), not ", eps);
  for (const double deviation : c.image_std)
    LVGGT_CHECK(deviation > 0 && std::isfinite(deviation), source,
                ": \"image_std\" must be positive, not ", deviation);
  for (const double mean : c.image_mean)
    LVGGT_CHECK(std::isfinite(mean), source, ": \"image_mean\" must be finite");
  LVGGT_CHECK(c.mlp_ratio > 0 && c.mlp_ratio <= 64 && c.mlp_hidden(c.embed_dim) >= 1, source,
              ": \"mlp_ratio\" must lie in (0, 64], not ", c.mlp_ratio);
  LVGGT_CHECK(c.rope_freq > 1 && std::isfinite(c.rope_freq), source,
              ": \"rope_freq\" must be above 1, not ", c.rope_freq);
  LVGGT_CHECK(std::isfinite(c.dpt_pos_embed_ratio), source,
              ": \"dpt_pos_embed_ratio\" must be finite");
  LVGGT_CHECK(c.sbd_levels == 1 || c.sbd_levels == 3, source,
              ": \"sbd_levels\" must be 3 (small, middle, large) or 1, not ", c.sbd_levels);
}

}  // namespace

void validate_config(const ModelConfig& c, std::string_view source) {
  check_ranges(c, source);
  LVGGT_CHECK(c.img_size % c.patch_size == 0, source, ": \"img_size\" ", c.img_size,
              " is not a multiple of \"patch_size\" ", c.patch_size);
  const auto check_heads = [&](const char* key, std::int64_t dim, std::int64_t heads) {
    LVGGT_CHECK(dim % heads == 0, source, ": width ", dim, " cannot be split into \"", key, "\" ",
                heads);
  };
  check_heads("dino_heads", c.embed_dim, c.dino_heads);
  check_heads("agg_heads", c.embed_dim, c.agg_heads);
  check_heads("cam_heads", 2 * c.embed_dim, c.cam_heads);
  LVGGT_CHECK(c.embed_dim / c.agg_heads % 4 == 0, source,
              ": the rotary embedding needs heads of a ",
              "multiple of 4 values, but embed_dim / agg_heads is ", c.embed_dim / c.agg_heads);
  LVGGT_CHECK(c.dpt_features % 8 == 0, source, ": \"dpt_features\" must be a multiple of 8, not ",
              c.dpt_features);
  for (const std::int64_t n : c.dpt_out_channels)
    LVGGT_CHECK(n % 4 == 0, source, ": \"dpt_out_channels\" must be multiples of 4, not ", n);
  LVGGT_CHECK(
      std::is_sorted(c.taps.begin(), c.taps.end()) && c.taps[0] >= 0 && c.taps[3] < c.agg_depth,
      source, ": \"taps\" must ascend within the ", c.agg_depth, " layers of \"agg_depth\", not [",
      c.taps[0], ", ", c.taps[1], ", ", c.taps[2], ", ", c.taps[3], "]");
}

namespace {

ModelConfig config_of(const Json& object, std::string_view source) {
  if (!object.is_object())
    fail(ErrorKind::kFormat, source, ": a configuration is a JSON object, this is ",
         object.kind_name());
  ModelConfig config;
  FieldReader reader(object, source);
  for_each_field(config, reader);
  refuse_unknown_keys(object, reader.known(), source);
  validate_config(config, source);
  return config;
}

using Fields = std::vector<std::pair<std::string, std::string>>;  // key, value as JSON

Fields fields_of(const ModelConfig& config) {
  Fields fields;
  for_each_field(config, [&](const char* key, const auto& field) {
    fields.emplace_back(key, text_of(field));
  });
  return fields;
}

}  // namespace

ModelConfig parse_config(std::string_view json, std::string_view source) {
  if (json.size() > kMaxConfigBytes)
    fail(ErrorKind::kLimit, source, ": a configuration may have at most ", kMaxConfigBytes,
         " bytes, this has ", json.size());
  return config_of(Json::parse(json, std::string(source)), source);
}

ModelConfig load_config(const std::string& path) {
  Limits limits;
  limits.json_bytes = kMaxConfigBytes;
  return config_of(Json::read(path, limits), path);
}

std::string to_json(const ModelConfig& config) {
  Fields fields = fields_of(config);
  for (const auto& [key, value] : kFixedOptions) fields.emplace_back(key, value);
  std::string text;
  for (const auto& [key, value] : fields)
    text += (text.empty() ? "{\n \"" : ",\n \"") + key + "\": " + value;
  return text + "\n}";
}

std::string config_difference(const ModelConfig& found, const ModelConfig& expected) {
  const Fields ours = fields_of(found), theirs = fields_of(expected);
  std::string text;
  for (std::size_t i = 0; i < ours.size(); ++i)
    if (ours[i].first != "name" && ours[i].second != theirs[i].second)
      text += (text.empty() ? "" : "; ") + ours[i].first + " is " + ours[i].second + ", not " +
              theirs[i].second;
  return text;
}

}  // namespace lvggt
