// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <filesystem>

#include "kernels/language/named_tensors.h"
#include "lvggt/language/mistral.h"

namespace lvggt {
namespace {

constexpr const char* kWhat = "the Mistral model";

// "model." or nothing, as the checkpoint was saved.
std::string name_prefix(const Safetensors& file) {
  return file.find("model.embed_tokens.weight") != nullptr ? "model." : "";
}

double positive(const Json& json, const char* key, double otherwise, const std::string& source) {
  const Json* value = json.find(key);
  if (value == nullptr || value->is_null()) return otherwise;
  const double number = value->as_double(concat(source, ": ", key));
  if (!(number > 0) || number > 1e12)
    fail(ErrorKind::kFormat, source, ": ", key, " is ", number, ", expected a positive number");
  return number;
}

}  // namespace

MistralConfig parse_mistral_config(const Json& json, const std::string& source) {
  const Json* type = json.find("model_type");
  LVGGT_CHECK(
      type != nullptr && type->is_string() && type->as_string(source + ": model_type") == "mistral",
      source, ": is not a configuration of Mistral (model_type)");
  if (const Json* act = json.find("hidden_act");
      act != nullptr && act->as_string(source + ": hidden_act") != "silu")
    fail(ErrorKind::kUnsupported, source, ": hidden_act is \"", act->as_string("hidden_act"),
         "\", expected silu");
  MistralConfig config;
  config.source = source;
  config.rms_norm_eps = static_cast<float>(positive(json, "rms_norm_eps", 1e-5, source));
  config.rope_theta = positive(json, "rope_theta", 10000, source);
  const double heads = positive(json, "num_attention_heads", 32, source);
  const double width = positive(json, "hidden_size", 4096, source);
  config.head_dim = static_cast<std::int64_t>(positive(json, "head_dim", width / heads, source));
  return config;
}

bool is_mistral(const Safetensors& file) {
  return file.find(name_prefix(file) + "embed_tokens.weight") != nullptr &&
         file.find(name_prefix(file) + "layers.0.mlp.gate_proj.weight") != nullptr;
}

// Finds the tensors in mapped files.
class MistralLoader {
 public:
  MistralLoader(const Safetensors& file, const MistralConfig& config)
      : file_(file), tensors_(file, kWhat), prefix_(name_prefix(file)) {
    model_.config_ = config;
    model_.path_ = file.path();
  }

  Mistral load() {
    const std::size_t layers = count_layers();
    tensors_.require(all_names(layers));
    for (const std::string& path : file_.files()) model_.files_.emplace_back(path);
    settle_sizes();
    model_.embed_tokens_ = matrix("embed_tokens.weight", kAnyExtent, model_.C_);
    for (std::size_t i = 0; i < layers; ++i) model_.layers_.push_back(layer(i));
    model_.norm_ = tensors_.read<1>(prefix_ + "norm.weight", Shape{model_.C_});
    return std::move(model_);
  }

 private:
  std::string in_layer(std::size_t i, const char* name) const {
    return concat("layers.", i, ".", name, ".weight");
  }

  std::size_t count_layers() const {
    std::size_t layers = 0;
    while (tensors_.has(prefix_ + in_layer(layers, "input_layernorm"))) ++layers;
    return layers;
  }

  std::vector<std::string> all_names(std::size_t layers) const {
    std::vector<std::string> names = {prefix_ + "embed_tokens.weight", prefix_ + "norm.weight"};
    for (std::size_t i = 0; i < std::max<std::size_t>(layers, 1); ++i)
      for (const char* part : {"input_layernorm", "self_attn.q_proj", "self_attn.k_proj",
                               "self_attn.v_proj", "self_attn.o_proj", "post_attention_layernorm",
                               "mlp.gate_proj", "mlp.up_proj", "mlp.down_proj"})
        names.push_back(prefix_ + in_layer(i, part));
    return names;
  }

  // Widths and numbers of heads, from the first layer.
  void settle_sizes() {
    const std::int64_t D = model_.config_.head_dim;
    model_.C_ = tensors_.extent(prefix_ + "embed_tokens.weight", 2, 1);
    const std::int64_t rows = tensors_.extent(prefix_ + in_layer(0, "self_attn.q_proj"), 2, 0);
    const std::int64_t key_rows = tensors_.extent(prefix_ + in_layer(0, "self_attn.k_proj"), 2, 0);
    model_.hidden_ = tensors_.extent(prefix_ + in_layer(0, "mlp.gate_proj"), 2, 0);
    LVGGT_CHECK(
        D > 0 && D % 2 == 0 && rows % D == 0 && key_rows % D == 0 && rows % key_rows == 0,
        file_.path(), ": q_proj has ", rows, " rows and k_proj ", key_rows,
        ", which are not whole heads of ", D,
        model_.config_.source.empty() ? "; a config.json beside the weights may say more" : "");
    model_.heads_ = rows / D;
    model_.key_heads_ = key_rows / D;
  }

  MistralLayer layer(std::size_t i) {
    const std::int64_t C = model_.C_, D = model_.config_.head_dim, hidden = model_.hidden_;
    const std::int64_t rows = model_.heads_ * D, key_rows = model_.key_heads_ * D;
    MistralLayer result;
    result.input_layernorm = tensors_.read<1>(prefix_ + in_layer(i, "input_layernorm"), Shape{C});
    result.q_proj = matrix(in_layer(i, "self_attn.q_proj"), rows, C);
    result.k_proj = matrix(in_layer(i, "self_attn.k_proj"), key_rows, C);
    result.v_proj = matrix(in_layer(i, "self_attn.v_proj"), key_rows, C);
    result.o_proj = matrix(in_layer(i, "self_attn.o_proj"), C, rows);
    result.post_attention_layernorm =
        tensors_.read<1>(prefix_ + in_layer(i, "post_attention_layernorm"), Shape{C});
    result.gate_proj = matrix(in_layer(i, "mlp.gate_proj"), hidden, C);
    result.up_proj = matrix(in_layer(i, "mlp.up_proj"), hidden, C);
    result.down_proj = matrix(in_layer(i, "mlp.down_proj"), C, hidden);
    return result;
  }

  StoredMatrix matrix(const std::string& name, std::int64_t N, std::int64_t K) {
    const std::string full = prefix_ + name;
    tensors_.check_shape(full, Shape{N, K}.extents);
    const TensorEntry& entry = file_.at(full);
    if (entry.dtype != Dtype::kF32 && entry.dtype != Dtype::kF16 && entry.dtype != Dtype::kBF16)
      fail(ErrorKind::kUnsupported, file_.path(), ": ", full, " holds ", dtype_name(entry.dtype),
           " values; BF16, F16 and F32 can be used from the file");
    const auto bytes = model_.files_[entry.file_idx].bytes().subspan(
        static_cast<std::size_t>(entry.offset), static_cast<std::size_t>(entry.num_bytes));
    model_.num_bytes_ += entry.num_bytes;
    const std::byte* data = bytes.data();
    if (reinterpret_cast<std::uintptr_t>(data) %
            static_cast<std::uintptr_t>(dtype_size(entry.dtype)) !=
        0) {
      model_.realigned_.emplace_back(bytes.begin(), bytes.end());
      data = model_.realigned_.back().data();
    }
    return {data, tensors_.storage_of(full), entry.shape[0], entry.shape[1]};
  }

  const Safetensors& file_;
  NamedTensors tensors_;
  std::string prefix_;
  Mistral model_;
};

Mistral Mistral::open(const Safetensors& file, const MistralConfig& config) {
  return MistralLoader(file, config).load();
}

Mistral Mistral::open(const std::string& path, const std::string& config) {
  namespace fs = std::filesystem;
  std::error_code ignored;
  std::string found = config;
  if (found.empty()) {
    const fs::path folder =
        fs::is_directory(path, ignored) ? fs::path(path) : fs::path(path).parent_path();
    if (fs::exists(folder / "config.json", ignored)) found = (folder / "config.json").string();
  }
  return open(Safetensors::open(path),
              found.empty() ? MistralConfig{} : parse_mistral_config(Json::read(found), found));
}

}  // namespace lvggt
