// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/checkpoint.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <set>

#include "lvggt/core/error.h"
#include "lvggt/model/quantized_linear.h"

namespace lvggt {
namespace {

constexpr std::size_t kMostNamed = 12;  // names listed in a warning; errors list all

// Share of denormal values from which a tensor is odd enough to be mentioned.
constexpr double kDenormalShare = 0.01;

std::string join(const std::vector<std::string>& names, std::size_t most) {
  std::string text;
  for (std::size_t i = 0; i < std::min(names.size(), most); ++i)
    text += (i == 0 ? "" : ", ") + names[i];
  if (names.size() > most) text += " and " + std::to_string(names.size() - most) + " more";
  return text;
}

bool any_name(const Safetensors& file, bool (*predicate)(std::string_view)) {
  return std::any_of(file.entries().begin(), file.entries().end(),
                     [&](const TensorEntry& entry) { return predicate(entry.name); });
}

bool geometry_name(std::string_view name) {
  return name.starts_with("aggregator.") || name.starts_with("camera_head.");
}
bool point_head_name(std::string_view name) { return name.starts_with("point_head."); }

// What a file that is neither a geometry model nor a decoder looks like.
std::string resemblance(const Safetensors& file) {
  if (file.entries().empty()) return "it holds no tensors";
  if (file.find("cls_token") && file.find("pos_embed"))
    return "it looks like a DINOv2 encoder alone";
  if (file.find("encoder.0.weight") && file.find("decoder.0.weight"))
    return "it looks like a 4DLangSplat autoencoder";
  for (const TensorEntry& entry : file.entries()) {
    const std::size_t at = entry.name.find("aggregator.");
    if (at != std::string::npos && at > 0)
      return "its names begin with \"" + entry.name.substr(0, at) +
             "\", which the weight converter removes";
  }
  return "its first tensor is " + file.entries().front().name;
}

bool looks_transposed(const std::vector<std::int64_t>& found,
                      const std::vector<std::int64_t>& expected) {
  if (found.size() != expected.size() || found.size() < 2) return false;
  std::vector<std::int64_t> swapped = found;
  std::swap(swapped[0], swapped[1]);
  return swapped == expected || std::vector<std::int64_t>(found.rbegin(), found.rend()) == expected;
}

bool is_floating(Dtype dtype) {
  return dtype == Dtype::kF32 || dtype == Dtype::kF16 || dtype == Dtype::kBF16 ||
         dtype == Dtype::kF64;
}

// The storage that keeps values of a file's type as they are, as far as there is one.
Storage storage_of_dtype(Dtype dtype) {
  switch (dtype) {
    case Dtype::kBF16:
      return Storage::kBf16;
    case Dtype::kF16:
      return Storage::kF16;
    case Dtype::kI8:
      return Storage::kI8;
    default:
      return Storage::kF32;
  }
}

// The type of a file's values in that storage.
Dtype dtype_of(Storage storage) {
  switch (storage) {
    case Storage::kBf16:
      return Dtype::kBF16;
    case Storage::kF16:
      return Dtype::kF16;
    case Storage::kI8:
      return Dtype::kI8;
    default:
      return Dtype::kF32;
  }
}

// Whether the tensor is packed for products and not kept as float32.
bool is_weight(const TensorSpec& spec) {
  return spec.shape.size() >= 2 && spec.name.ends_with(".weight");
}

// Why the tensor cannot be read as the one of that shape and name, or empty.
std::string dtype_fault(const Safetensors& file, const TensorEntry& entry, const TensorSpec& spec) {
  if (is_floating(entry.dtype)) return {};
  if (entry.dtype == Dtype::kI8 && is_weight(spec)) return quantized_linear_fault(file, entry);
  return spec.name + " holds " + std::string(dtype_name(entry.dtype)) +
         " values where floating-point ones are expected";
}

}  // namespace

struct Checkpoint::Problems {
  std::vector<std::string> missing, misshapen, extra;
  bool empty() const { return missing.empty() && misshapen.empty() && extra.empty(); }
};

Checkpoint::Checkpoint(const LoadOptions& options)
    : geometry_(Safetensors::open(options.weights)),
      storage_(options.storage),
      skip_points_(!options.points),
      allow_nonfinite_(options.allow_nonfinite) {
  if (!options.decoder.empty()) decoder_ = Safetensors::open(options.decoder);
  if (!options.overrides.empty()) overrides_ = Safetensors::open(options.overrides);
  refuse_other_models();
  has_decoder_ = decoder_.has_value() || any_name(geometry_, is_decoder_tensor);
  has_point_head_ = options.points && any_name(geometry_, point_head_name);
  settle_config(options);
  if (overrides_ && has_decoder_) {
    const TensorEntry* last = overrides_->find("weight." + language_decoder_names(config_).front() +
                                               ".final_conv.weight");
    if (last != nullptr && last->shape.size() == 4 && last->shape[0] > 0)
      config_.lang_dim = last->shape[0];
  }

  check_tensors(options.strict);
}

Checkpoint::Checkpoint(const LoadOptions& options, const ModelConfig& geometry)
    : geometry_(Safetensors::open(options.decoder)),
      storage_(options.storage),
      has_decoder_(true),
      decoder_only_(true),
      allow_nonfinite_(options.allow_nonfinite) {
  if (!any_name(geometry_, is_decoder_tensor))
    fail(ErrorKind::kMismatch, geometry_.path(), ": not a semantic bridging decoder: ",
         any_name(geometry_, geometry_name) ? "it is a geometry model" : resemblance(geometry_));
  config_ = infer_decoder_config(geometry_, geometry);
  check_tensors(options.strict);
}

void Checkpoint::check_tensors(bool strict) {
  const std::vector<TensorSpec> expected = expected_tensors();
  Problems problems;
  check_shapes(expected, problems);
  check_extra(expected, strict, problems);
  if (!problems.empty()) report(problems);
  describe_storage(expected);
}

// Counts the storages of the weights and says which tensors do not stay as the files have them.
void Checkpoint::describe_storage(const std::vector<TensorSpec>& expected) {
  std::vector<std::string> widened, rounded_before;
  for (const TensorSpec& spec : expected) {
    const Dtype dtype = look_up(spec.name).entry->dtype;
    const bool weight = is_weight(spec);
    const Storage storage = weight ? storage_of(spec.name) : Storage::kF32;
    if (weight) ++storage_counts_[storage];
    if (dtype == Dtype::kF32 || dtype == dtype_of(storage)) continue;
    (dtype == Dtype::kI8 ? rounded_before : widened)
        .push_back(concat(spec.name, " (", dtype_name(dtype), ")"));
  }
  if (!widened.empty())
    warnings_.push_back(std::to_string(widened.size()) +
                        " tensors are widened to float32: " + join(widened, kMostNamed));
  if (!rounded_before.empty())
    warnings_.push_back(concat(rounded_before.size(),
                               " weights are int8 in the file and kept in another type in ",
                               "memory, which does not bring back what rounding took: ",
                               join(rounded_before, kMostNamed)));
}

Storage Checkpoint::storage_of(const std::string& weight) const {
  if (storage_) return storage_->of_weight(weight);
  if (layer_kind(weight) == kUnetKind) return Storage::kF32;
  return storage_of_dtype(find(weight).entry->dtype);
}

std::string Checkpoint::storage_summary() const {
  std::string text;
  for (const auto& [storage, count] : storage_counts_)
    text += concat(text.empty() ? "" : ", ", count, text.empty() ? " weights as " : " as ",
                   storage_name(storage));
  return text;
}

PackedMatrix Checkpoint::read_linear(const std::string& name) const {
  const Found found = find(name);
  const Storage storage = storage_of(name);
  if (found.entry->dtype != Dtype::kI8 || storage != Storage::kI8)
    return pack_linear(read<2>(name), storage);
  const QuantizedLinear quantized = read_quantized_linear(*found.file, *found.entry);
  return pack_linear(quantized.integers.view(), quantized.scales.view());
}

Tensor<float, 2> Checkpoint::read_widened_int8(const Found& found) const {
  const QuantizedLinear quantized = read_quantized_linear(*found.file, *found.entry);
  Tensor<float, 2> weights(quantized.integers.shape());
  dequantize(weights, quantized);
  return weights;
}

void Checkpoint::refuse_other_models() const {
  if (!any_name(geometry_, geometry_name)) {
    if (any_name(geometry_, is_decoder_tensor))
      fail(ErrorKind::kMismatch, geometry_.path(),
           ": this is a semantic bridging decoder, not a geometry ",
           "model; give it as the decoder and the geometry model as the weights");
    fail(ErrorKind::kMismatch, geometry_.path(),
         ": not a geometry model: ", resemblance(geometry_));
  }
  if (decoder_ && !any_name(*decoder_, is_decoder_tensor)) {
    if (any_name(*decoder_, geometry_name))
      fail(ErrorKind::kMismatch, decoder_->path(),
           ": this is a geometry model, not a semantic bridging ",
           "decoder; give it as the weights");
    fail(ErrorKind::kMismatch, decoder_->path(),
         ": not a semantic bridging decoder: ", resemblance(*decoder_));
  }
}

void Checkpoint::settle_config(const LoadOptions& options) {
  if (!options.config.empty()) {
    config_ = load_config(options.config);
    return;
  }
  // The decoder's own configuration, where there is one, knows more about it than the geometry's.
  for (const Safetensors* file : {decoder_ ? &*decoder_ : nullptr, &geometry_}) {
    if (file == nullptr) continue;
    const auto found = file->metadata().find("config");
    if (found == file->metadata().end() || !found->second.starts_with('{')) continue;
    config_ = parse_config(found->second, file->path() + ": metadata \"config\"");
    return;
  }
  config_ = infer_config(geometry_, decoder_ ? &*decoder_ : nullptr);
  validate_config(config_, geometry_.path() + ": the configuration that its shapes tell");
}

std::vector<TensorSpec> Checkpoint::expected_tensors() const {
  std::vector<TensorSpec> expected;
  if (!decoder_only_) expected = geometry_tensors(config_);
  if (has_decoder_)
    for (TensorSpec& spec : decoder_tensors(config_)) expected.push_back(std::move(spec));
  std::erase_if(expected, [&](const TensorSpec& spec) {
    return known_unused_tensor(spec.name) || (!has_point_head_ && point_head_name(spec.name));
  });
  return expected;
}

Checkpoint::Found Checkpoint::look_up(const std::string& name) const {
  if (overrides_)
    if (const TensorEntry* entry = overrides_->find("weight." + name)) return {&*overrides_, entry};
  if (decoder_ && is_decoder_tensor(name)) return {&*decoder_, decoder_->find(name)};
  return {&geometry_, geometry_.find(name)};
}

Checkpoint::Found Checkpoint::find(const std::string& name) const {
  const Found found = look_up(name);
  LVGGT_CHECK(found.entry != nullptr, found.file->path(), ": tensor ", name, " is missing");
  return found;
}

void Checkpoint::check_shapes(const std::vector<TensorSpec>& expected, Problems& problems) const {
  for (const TensorSpec& spec : expected) {
    const Found found = look_up(spec.name);
    if (found.entry == nullptr) {
      problems.missing.push_back(spec.name);
    } else if (found.entry->shape != spec.shape) {
      problems.misshapen.push_back(
          spec.name + " is " + shape_text(found.entry->shape) + " where " + shape_text(spec.shape) +
          " is expected" +
          (looks_transposed(found.entry->shape, spec.shape) ? " (it looks transposed)" : ""));
    } else if (std::string fault = dtype_fault(*found.file, *found.entry, spec); !fault.empty()) {
      problems.misshapen.push_back(std::move(fault));
    }
  }
}

void Checkpoint::check_extra(const std::vector<TensorSpec>& expected, bool strict,
                             Problems& problems) {
  std::set<std::string_view> names;
  for (const TensorSpec& spec : expected) names.insert(spec.name);
  std::vector<std::string> extra;
  std::size_t other_decoder = 0;
  const auto scan = [&](const Safetensors& file, bool takes_decoder_names) {
    for (const TensorEntry& entry : file.entries()) {
      const bool used =
          names.contains(entry.name) && is_decoder_tensor(entry.name) == takes_decoder_names;
      if (used || known_unused_tensor(entry.name) || is_scale_of_int8(file, entry.name) ||
          (skip_points_ && point_head_name(entry.name)))
        continue;
      if (!decoder_ && names.contains(entry.name)) continue;
      if (decoder_ && !takes_decoder_names && !strict && is_decoder_tensor(entry.name))
        ++other_decoder;
      else
        extra.push_back(entry.name);
    }
  };
  scan(geometry_, false);
  if (decoder_) scan(*decoder_, true);
  if (other_decoder > 0)
    warnings_.push_back(concat(geometry_.path(), ": its own decoder (", other_decoder,
                               " tensors) is not used, because another one is given"));
  if (extra.empty()) return;
  if (strict) {
    problems.extra = std::move(extra);
  } else {
    warnings_.push_back(
        std::to_string(extra.size()) +
        " tensors are not part of the configuration and are ignored: " + join(extra, extra.size()));
  }
}

void Checkpoint::report(const Problems& problems) const {
  std::string text = geometry_.path();
  if (decoder_) text += " and " + decoder_->path();
  const char* separator = ": ";
  const auto add = [&](const std::vector<std::string>& list, const char* what) {
    if (list.empty()) return;
    text += separator + std::to_string(list.size()) + what + join(list, list.size());
    separator = "; ";
  };
  add(problems.missing, " tensors are missing: ");
  add(problems.misshapen, " tensors do not fit the configuration: ");
  add(problems.extra, " tensors are not part of the configuration: ");
  if (decoder_only_) fail(ErrorKind::kMismatch, text);
  ModelConfig found = infer_config(geometry_, decoder_ ? &*decoder_ : nullptr, config_);
  // Shapes do not tell these.
  found.dino_heads = config_.dino_heads;
  found.cam_heads = config_.cam_heads;
  found.taps = config_.taps;
  if (!found.agg_qk_norm) found.agg_heads = config_.agg_heads;
  const std::string difference = config_difference(found, config_);
  if (!difference.empty())
    text +=
        std::string("; the files look like another model than the configuration: ") + difference;
  fail(ErrorKind::kMismatch, text);
}

void Checkpoint::inspect(const std::string& name, const Safetensors& file,
                         std::span<const float> values) const {
  std::size_t nonfinite = 0, zero = 0, denormal = 0;
  for (const float value : values) {
    const float magnitude = std::abs(value);
    nonfinite += !(magnitude <= std::numeric_limits<float>::max());
    zero += magnitude == 0;
    denormal += magnitude < std::numeric_limits<float>::min();
  }
  denormal -= zero;
  if (nonfinite > 0 && !allow_nonfinite_)
    fail(ErrorKind::kFormat, file.path(), ": tensor ", name, " has ", nonfinite, " values of ",
         values.size(), " that are NaN or infinite");
  const std::lock_guard lock(mutex_);
  if (nonfinite > 0) nonfinite_.push_back(name);
  if (!values.empty() && zero == values.size()) all_zero_.push_back(name);
  if (static_cast<double>(denormal) > kDenormalShare * static_cast<double>(values.size()))
    denormal_.push_back(name);
}

std::vector<std::string> Checkpoint::warnings() const {
  std::vector<std::string> result = warnings_;
  const std::lock_guard lock(mutex_);
  // Loading in parallel finds them in any order.
  for (auto* names : {&all_zero_, &denormal_, &nonfinite_}) std::sort(names->begin(), names->end());
  const auto add = [&](const std::vector<std::string>& names, const char* what) {
    if (!names.empty())
      result.push_back(std::to_string(names.size()) + what + join(names, kMostNamed));
  };
  add(all_zero_, " tensors are all zero: ");
  add(denormal_, " tensors have many denormal values, which compute slowly: ");
  add(nonfinite_, " tensors have NaN or infinite values: ");
  return result;
}

}  // namespace lvggt
