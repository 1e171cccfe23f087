// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>

#include "kernels/language/named_tensors.h"
#include "lvggt/language/clip.h"

namespace lvggt {
namespace {

constexpr float kEps = 1e-5f;
constexpr float kQuickGelu = 1.702f;

// The names of one tower's tensors in one of the published forms.
struct Names {
  bool hugging_face = false;
  std::string block;  // "visual.transformer.resblocks." or "vision_model.encoder.layers."
  // Of a block:
  std::string ln_1, ln_2, c_fc, c_proj, out_proj;

  static Names open_clip(const std::string& tower) {
    return {
        false,          tower + "transformer.resblocks.", "ln_1", "ln_2", "mlp.c_fc", "mlp.c_proj",
        "attn.out_proj"};
  }
  static Names of_hugging_face(const std::string& tower) {
    return {true,      tower + "encoder.layers.", "layer_norm1", "layer_norm2", "mlp.fc1",
            "mlp.fc2", "self_attn.out_proj"};
  }
  std::string in(std::size_t layer, const std::string& name) const {
    return block + std::to_string(layer) + "." + name;
  }
  // The joint projection, or those of q, k and v.
  std::vector<std::string> projections(const char* last) const {
    const std::string end = last;
    if (!hugging_face) return {"attn.in_proj_" + end};
    return {"self_attn.q_proj." + end, "self_attn.k_proj." + end, "self_attn.v_proj." + end};
  }
};

std::size_t count_layers(const NamedTensors& tensors, const Names& names) {
  std::size_t layers = 0;
  while (tensors.has(names.in(layers, names.ln_1 + ".weight"))) ++layers;
  return layers;
}

std::vector<std::string> block_names(const Names& names, std::size_t layers) {
  std::vector<std::string> all;
  for (std::size_t i = 0; i < std::max<std::size_t>(layers, 1); ++i) {
    for (const char* last : {"weight", "bias"}) {
      for (const std::string& part :
           {names.ln_1, names.ln_2, names.c_fc, names.c_proj, names.out_proj})
        all.push_back(names.in(i, part + "." + last));
      for (const std::string& part : names.projections(last)) all.push_back(names.in(i, part));
    }
  }
  return all;
}

// qkv as one layer, whether the file has it in one piece or in three.
Linear load_qkv(const NamedTensors& tensors, const Names& names, std::size_t layer,
                std::int64_t C) {
  const auto weights = names.projections("weight"), biases = names.projections("bias");
  const std::int64_t rows = 3 * C / static_cast<std::int64_t>(weights.size());
  Tensor<float, 2> weight(Shape{3 * C, C});
  Linear layer_weights;
  layer_weights.bias = Tensor<float, 1>(Shape{3 * C});
  for (std::size_t i = 0; i < weights.size(); ++i) {
    const auto part = tensors.read<2>(names.in(layer, weights[i]), Shape{rows, C});
    const auto bias = tensors.read<1>(names.in(layer, biases[i]), Shape{rows});
    const std::int64_t first = static_cast<std::int64_t>(i) * rows;
    std::copy_n(part.data(), part.size(), weight[first].data());
    std::copy_n(bias.data(), rows, layer_weights.bias.data() + first);
  }
  layer_weights.weight = pack_linear(weight, tensors.storage_of(names.in(layer, weights[0])));
  return layer_weights;
}

// c_fc, times 1.702 with QuickGELU (see ClipTransformer); the factor is rounded, so narrow weights
// become float32 then.
Linear load_fc(const NamedTensors& tensors, const std::string& prefix, std::int64_t N,
               std::int64_t C, bool quick_gelu) {
  if (!quick_gelu) return tensors.linear(prefix + ".weight", prefix + ".bias", N, C);
  Tensor<float, 2> weight = tensors.read<2>(prefix + ".weight", Shape{N, C});
  Tensor<float, 1> bias = tensors.read<1>(prefix + ".bias", Shape{N});
  for (float& w : std::span(weight.data(), static_cast<std::size_t>(weight.size())))
    w *= kQuickGelu;
  for (float& b : std::span(bias.data(), static_cast<std::size_t>(N))) b *= kQuickGelu;
  return {pack_linear(weight), std::move(bias)};
}

ClipTransformer load_transformer(const NamedTensors& tensors, const Names& names, std::int64_t C,
                                 std::int64_t heads, bool quick_gelu) {
  LVGGT_CHECK(heads >= 1 && C % heads == 0, tensors.path(), ": CLIP's width ", C,
              " does not divide into ", heads, " heads");
  ClipTransformer transformer;
  const std::size_t layers = count_layers(tensors, names);
  std::int64_t hidden = 0;
  for (std::size_t i = 0; i < layers; ++i) {
    ClipBlock block;
    hidden = tensors.extent(names.in(i, names.c_fc + ".weight"), 2, 0);
    block.ln_1 = tensors.layer_norm(names.in(i, names.ln_1), C, kEps);
    block.ln_2 = tensors.layer_norm(names.in(i, names.ln_2), C, kEps);
    block.attn.qkv = load_qkv(tensors, names, i, C);
    const std::string out = names.in(i, names.out_proj);
    block.attn.proj = tensors.linear(out + ".weight", out + ".bias", C, C);
    block.attn.num_heads = heads;
    block.mlp.fc1 = load_fc(tensors, names.in(i, names.c_fc), hidden, C, quick_gelu);
    const std::string c_proj = names.in(i, names.c_proj);
    block.mlp.fc2 = tensors.linear(c_proj + ".weight", c_proj + ".bias", C, hidden);
    transformer.resblocks.push_back(std::move(block));
  }
  if (quick_gelu) {
    transformer.quick_gelu = Tensor<float, 1>(Shape{hidden});
    std::fill_n(transformer.quick_gelu.data(), hidden, 1 / kQuickGelu);
  }
  return transformer;
}

// The projection to the common space, which OpenCLIP stores as [in, out] and Hugging Face as
// [out, in].
Linear load_projection(const NamedTensors& tensors, const std::string& name, bool hugging_face,
                       std::int64_t C) {
  Linear layer;
  if (hugging_face) {
    layer.weight =
        pack_linear(tensors.read<2>(name, Shape{kAnyExtent, C}), tensors.storage_of(name));
    return layer;
  }
  const Tensor<float, 2> stored = tensors.read<2>(name, Shape{C, kAnyExtent});
  Tensor<float, 2> weight(Shape{stored.extent(1), C});
  for (std::int64_t n = 0; n < weight.extent(0); ++n)
    for (std::int64_t k = 0; k < C; ++k) weight(n, k) = stored(k, n);
  layer.weight = pack_linear(weight, tensors.storage_of(name));
  return layer;
}

// Where the text tower's tensors begin in OpenCLIP's names: most models have them at the top.
std::string open_clip_text_prefix(const Safetensors& file) {
  return file.find("text.token_embedding.weight") != nullptr ? "text." : "";
}

constexpr const char* kHfText = "text_model.embeddings.token_embedding.weight";
constexpr const char* kHfImage = "vision_model.embeddings.patch_embedding.weight";

}  // namespace

bool is_clip_text(const Safetensors& file) {
  return file.find(kHfText) != nullptr ||
         file.find(open_clip_text_prefix(file) + "token_embedding.weight") != nullptr;
}

bool is_clip_image(const Safetensors& file) {
  return file.find(kHfImage) != nullptr || file.find("visual.conv1.weight") != nullptr;
}

ClipText load_clip_text(const Safetensors& file, const ClipConfig& config) {
  const bool hf = file.find(kHfText) != nullptr;
  const std::string top = hf ? "text_model." : open_clip_text_prefix(file);
  const Names names = hf ? Names::of_hugging_face(top) : Names::open_clip(top);
  const std::string token = hf ? kHfText : top + "token_embedding.weight";
  const std::string position =
      hf ? top + "embeddings.position_embedding.weight" : top + "positional_embedding";
  const std::string ln_final = top + (hf ? "final_layer_norm" : "ln_final");
  const std::string projection = hf ? "text_projection.weight" : top + "text_projection";

  const NamedTensors tensors(file, "CLIP's text tower");
  std::vector<std::string> needed = block_names(names, count_layers(tensors, names));
  needed.insert(needed.end(),
                {token, position, ln_final + ".weight", ln_final + ".bias", projection});
  tensors.require(needed);

  ClipText clip;
  const std::int64_t C = tensors.extent(token, 2, 1);
  clip.token_embedding = tensors.read<2>(token, Shape{kAnyExtent, C});
  clip.positional_embedding = tensors.read<2>(position, Shape{kAnyExtent, C});
  tensors.extent(position, 2, 0);
  clip.transformer =
      load_transformer(tensors, names, C, config.text_heads > 0 ? config.text_heads : clip_heads(C),
                       config.quick_gelu.value_or(false));
  clip.ln_final = tensors.layer_norm(ln_final, C, kEps);
  clip.text_projection = load_projection(tensors, projection, hf, C);
  return clip;
}

ClipImage load_clip_image(const Safetensors& file, const ClipConfig& config) {
  const bool hf = file.find(kHfImage) != nullptr;
  const std::string top = hf ? "vision_model." : "visual.";
  const std::string embeddings = hf ? top + "embeddings." : top;
  const Names names = hf ? Names::of_hugging_face(top) : Names::open_clip(top);
  const std::string conv1 = hf ? kHfImage : "visual.conv1.weight";
  const std::string position =
      embeddings + (hf ? "position_embedding.weight" : "positional_embedding");
  // Spelled so in the published files.
  const std::string ln_pre = top + (hf ? "pre_layrnorm" : "ln_pre");
  const std::string ln_post = top + (hf ? "post_layernorm" : "ln_post");
  const std::string projection = hf ? "visual_projection.weight" : "visual.proj";

  const NamedTensors tensors(file, "CLIP's image tower");
  std::vector<std::string> needed = block_names(names, count_layers(tensors, names));
  needed.insert(needed.end(),
                {conv1, position, embeddings + "class_embedding", ln_pre + ".weight",
                 ln_pre + ".bias", ln_post + ".weight", ln_post + ".bias", projection});
  tensors.require(needed);

  ClipImage clip;
  const std::int64_t C = tensors.extent(conv1, 4, 0), patch = tensors.extent(conv1, 4, 2);
  clip.conv1.weight = pack_conv2d(tensors.read<4>(conv1, Shape{C, std::int64_t{3}, patch, patch}),
                                  patch, 0, tensors.storage_of(conv1));
  clip.class_embedding = tensors.read<1>(embeddings + "class_embedding", Shape{C});
  clip.positional_embedding = tensors.read<2>(position, Shape{kAnyExtent, C});
  const std::int64_t P = clip.positional_embedding.extent(0);
  const auto side = static_cast<std::int64_t>(std::lround(std::sqrt(static_cast<double>(P - 1))));
  LVGGT_CHECK(side >= 1 && side * side + 1 == P, file.path(), ": ", position, " has ", P,
              " rows, which is not one more than a square number of patches");
  clip.image_size = side * patch;
  clip.ln_pre = tensors.layer_norm(ln_pre, C, kEps);
  clip.transformer = load_transformer(tensors, names, C,
                                      config.image_heads > 0 ? config.image_heads : clip_heads(C),
                                      config.quick_gelu.value_or(false));
  clip.ln_post = tensors.layer_norm(ln_post, C, kEps);
  clip.proj = load_projection(tensors, projection, hf, C);
  return clip;
}

}  // namespace lvggt
