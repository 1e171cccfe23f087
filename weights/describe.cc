// SPDX-License-Identifier: Apache-2.0
#include "weights/describe.h"

#include <algorithm>
#include <filesystem>
#include <set>
#include <string_view>

#include "lvggt/core/error.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/value_summary.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/quantized_linear.h"
#include "lvggt/model/tensor_list.h"

namespace lvggt {
namespace {

struct Contents {
  bool geometry = false;
  bool decoder = false;
  bool encoder = false;  // DINOv2 alone
  bool clip_text = false, clip_image = false;
  bool mistral = false;
  bool autoencoder = false;
};

bool any_starts(const std::vector<TensorEntry>& tensors,
                std::initializer_list<std::string_view> prefixes) {
  return std::any_of(tensors.begin(), tensors.end(), [&](const TensorEntry& tensor) {
    return std::any_of(prefixes.begin(), prefixes.end(),
                       [&](std::string_view prefix) { return tensor.name.starts_with(prefix); });
  });
}

Contents contents_of(const std::vector<TensorEntry>& tensors) {
  Contents contents;
  contents.geometry =
      any_starts(tensors, {"aggregator.", "camera_head.", "depth_head.", "point_head."});
  contents.decoder = any_starts(tensors, {"feature_extractor.", "lang_encoder.", "lang_decoder"});
  contents.clip_text = any_starts(tensors, {"token_embedding.weight", "text.token_embedding.weight",
                                            "text_model.embeddings.token_embedding.weight"});
  contents.clip_image = any_starts(
      tensors, {"visual.conv1.weight", "vision_model.embeddings.patch_embedding.weight"});
  contents.mistral =
      any_starts(tensors, {"model.layers.0.mlp.gate_proj.weight", "layers.0.mlp.gate_proj.weight"});
  contents.autoencoder =
      any_starts(tensors, {"encoder.0.weight"}) && any_starts(tensors, {"decoder.0.weight"});
  contents.encoder = !contents.geometry && any_starts(tensors, {"blocks.0.attn.qkv."}) &&
                     any_starts(tensors, {"patch_embed.proj."});
  return contents;
}

// What lvggt knows beside its own model.
std::string other_contents(const Contents& contents) {
  if (contents.clip_text && contents.clip_image)
    return "CLIP: encoders of phrases (--text-encoder) and pictures (--image-encoder)";
  if (contents.clip_text) return "CLIP's encoder of phrases (--text-encoder)";
  if (contents.clip_image) return "CLIP's encoder of pictures (--image-encoder)";
  if (contents.mistral)
    return "a language model of Mistral's kind, such as e5-mistral (--sentence-encoder)";
  if (contents.autoencoder) return "an autoencoder of language features, as 4DLangSplat's";
  if (contents.encoder) return "a DINOv2 encoder alone, which lvggt does not run";
  return "nothing lvggt knows: no aggregator, no heads, no decoder";
}

void name_contents(const Contents& contents, bool track_head, bool untrained,
                   WeightsDescription& d) {
  constexpr const char* kGeometry = "geometry of StreamVGGT or VGGT (both have the same tensors)";
  constexpr const char* kDecoder = "Semantic Bridging Decoder of 4DLangVGGT";
  if (contents.geometry && contents.decoder) {
    d.contents = std::string(kGeometry) + " and " + kDecoder;
  } else if (contents.geometry) {
    d.contents = kGeometry;
  } else if (contents.decoder) {
    d.contents = kDecoder;
  } else {
    d.contents = other_contents(contents);
  }
  if (track_head) d.contents += ", with a track head that is not used";
  if (untrained) {
    d.licence = "none needed: the values are computed, not trained";
  } else if (contents.geometry) {
    d.licence =
        "trained by others; VGGT-1B and StreamVGGT are for non-commercial use (VGGT-1B-Commercial "
        "has terms "
        "of its own), see the page it came from";
  } else {
    d.licence = "trained by others; see the page it came from";
  }
}

void count_tensors(const std::vector<TensorEntry>& tensors, WeightsDescription& d) {
  for (const TensorEntry& tensor : tensors) {
    ++d.num_tensors;
    // Sums over a validated file stay below its size.
    d.num_values += tensor.size();
    d.num_bytes += tensor.num_bytes;
    ++d.dtypes[std::string(dtype_name(tensor.dtype))];
    auto& part = d.parts[tensor.name.substr(0, tensor.name.find('.'))];
    ++part.num_tensors;
    part.num_values += tensor.size();
  }
}

bool is_scale_of_int8(std::string_view name,
                      const std::map<std::string_view, const TensorEntry*>& tensors) {
  if (!name.ends_with(".scale")) return false;
  const auto base = tensors.find(name.substr(0, name.rfind('.')));
  return base != tensors.end() && base->second->dtype == Dtype::kI8;
}

void compare_with_config(const std::vector<TensorEntry>& tensors, const Contents& contents,
                         WeightsDescription& d) {
  std::vector<TensorSpec> expected;
  if (contents.geometry) expected = geometry_tensors(*d.config);
  if (contents.decoder) {
    const std::vector<TensorSpec> decoder = decoder_tensors(*d.config);
    expected.insert(expected.end(), decoder.begin(), decoder.end());
  }
  std::map<std::string_view, const TensorEntry*> found;
  for (const TensorEntry& tensor : tensors) found.emplace(tensor.name, &tensor);
  std::set<std::string_view> names;
  for (const TensorSpec& spec : expected) {
    names.insert(spec.name);
    const auto it = found.find(spec.name);
    if (it == found.end()) {
      if (!known_unused_tensor(spec.name)) d.missing.push_back(spec.name);
    } else if (it->second->shape != spec.shape) {
      d.misshapen.push_back(spec.name + " is " + shape_text(it->second->shape) + ", not " +
                            shape_text(spec.shape));
    }
  }
  for (const TensorEntry& tensor : tensors)
    if (!names.contains(tensor.name) && !known_unused_tensor(tensor.name) &&
        !is_scale_of_int8(tensor.name, found))
      d.extra.push_back(tensor.name);
}

// Integers that no model can load, and why.
void check_quantized(const std::string& path, const std::vector<TensorEntry>& tensors,
                     WeightsDescription& d) {
  if (d.format != "safetensors" ||
      std::none_of(tensors.begin(), tensors.end(),
                   [](const TensorEntry& tensor) { return tensor.dtype == Dtype::kI8; }))
    return;
  const Safetensors file = Safetensors::open(path);
  for (const TensorEntry& entry : file.entries())
    if (entry.dtype == Dtype::kI8)
      if (std::string fault = quantized_linear_fault(file, entry); !fault.empty())
        d.misshapen.push_back(std::move(fault));
}

void settle_config(const std::string& path, const std::string& text, const Contents& contents,
                   WeightsDescription& d) {
  if (!text.empty()) {
    d.config = parse_config(text, path + ": configuration in the metadata");
    d.config_from_metadata = true;
  } else if (d.format == "safetensors" && (contents.geometry || contents.decoder)) {
    const Safetensors file = Safetensors::open(path);
    d.config = infer_config(file, contents.decoder ? &file : nullptr);
  }
}

// The values of an int8 weight against its scales.
void check_integers(const std::string& path, const TensorEntry& tensor, WeightsDescription& d) {
  const Safetensors file = Safetensors::open(path);
  try {
    read_quantized_linear(file, file.at(tensor.name));
  } catch (const Error& error) {
    d.suspicious.push_back(error.what());
  }
}

}  // namespace

WeightsDescription describe_weights(const std::string& path) {
  const auto source = WeightSource::open(path);
  WeightsDescription d;
  d.format = source->format();
  d.files = source->files();
  d.notes = source->notes();
  d.metadata = source->metadata();
  std::string config;
  // Other programs keep the name of a configuration there; only an object is one.
  if (const auto it = d.metadata.find("config");
      it != d.metadata.end() && it->second.starts_with("{")) {
    config = it->second;
    d.metadata.erase(it);
  }
  const std::vector<TensorEntry>& tensors = source->tensors();
  const Contents contents = contents_of(tensors);
  const auto origin = d.metadata.find("origin");
  name_contents(contents, any_starts(tensors, {"track_head."}),
                origin != d.metadata.end() && origin->second.starts_with("untrained"), d);
  count_tensors(tensors, d);
  settle_config(path, config, contents, d);
  if (d.config) compare_with_config(tensors, contents, d);
  check_quantized(path, tensors, d);
  return d;
}

void check_values(const std::string& path, WeightsDescription& description) {
  const auto source = WeightSource::open(path);
  std::vector<std::byte> stored;
  std::vector<float> values;
  for (std::size_t i = 0; i < source->tensors().size(); ++i) {
    const TensorEntry& tensor = source->tensors()[i];
    if (tensor.dtype == Dtype::kI8) check_integers(path, tensor, description);
    if (!dtype_is_float(tensor.dtype)) continue;
    stored.resize(static_cast<std::size_t>(tensor.num_bytes));
    values.resize(static_cast<std::size_t>(tensor.size()));
    source->read(i, stored);
    to_float32(tensor.dtype, stored, values);
    const ValueSummary summary = summarize_values(values);
    std::string reason = suspicion(summary);
    if (!summary.finite())
      reason = concat(summary.nan, " NaN and ", summary.infinite, " infinite values");
    if (!reason.empty()) description.suspicious.push_back(tensor.name + ": " + reason);
  }
  description.checked = true;
}

}  // namespace lvggt
