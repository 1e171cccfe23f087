// SPDX-License-Identifier: Apache-2.0
#include "examples/check_reference/encoder_cases.h"

#include <cmath>
#include <map>
#include <utility>

#include "lvggt/language/clip.h"
#include "lvggt/language/crops.h"
#include "lvggt/language/mistral.h"

namespace check_reference {
namespace {

using namespace lvggt;

// Keeps what is observed under "PREFIX.name" or "PREFIX.nameN".
class Watcher : public Observer {
 public:
  // With `layers` everything inside of layer N is "PREFIX.layerN.name".
  Watcher(std::string prefix, bool layers) : prefix_(std::move(prefix)), layers_(layers) {}

  void observe(std::string_view name, std::int64_t idx, View<const float, 2> rows) override {
    std::vector<float>& values = values_[full_name(std::string(name), idx)];
    for (std::int64_t n = 0; n < rows.extent(0); ++n)
      values.insert(values.end(), rows[n].data(), rows[n].data() + rows.extent(1));
  }

  // The patch embedding of every picture, [n, h*w, C], as planes.
  void turn_to_planes(const std::string& name, std::int64_t patches) {
    std::vector<float>& rows = values_[prefix_ + "." + name];
    std::vector<float> planes;
    const std::size_t P = static_cast<std::size_t>(patches);
    const std::size_t C = channels_, n = rows.size() / (P * C);
    for (std::size_t i = 0; i < n; ++i)
      for (std::size_t c = 0; c < C; ++c)
        for (std::size_t p = 0; p < P; ++p) planes.push_back(rows[(i * P + p) * C + c]);
    rows = std::move(planes);
  }
  void set_channels(std::int64_t channels) { channels_ = static_cast<std::size_t>(channels); }

  void compare(Comparison& comparison) const {
    for (const auto& [name, values] : values_) comparison.compare(name, values);
  }

 private:
  std::string full_name(const std::string& name, std::int64_t idx) const {
    const std::string last = name.substr(name.rfind('.') + 1);
    const std::string number = std::to_string(idx);
    if (layers_) {  // mistral: layer0, layer0.attn
      if (last == "layer") return prefix_ + ".layer" + number;
      const bool part = last == "attn" || last == "mlp" || last == "input_layernorm";
      return prefix_ + (part ? ".layer" + number : "") + "." + last;
    }
    const bool numbered = last == "attn" || last == "fc" || last == "act" || last == "block";
    return prefix_ + "." + name + (numbered ? number : "");
  }

  std::string prefix_;
  bool layers_;
  std::size_t channels_ = 0;
  std::map<std::string, std::vector<float>> values_;
};

// The reference's JSON says "false or true" where a model's says which.
ClipConfig clip_config(const std::string& path) {
  if (path.empty()) return {};
  const Json json = Json::read(path);
  const Json* section = json.find("open_clip");
  if (section == nullptr) return parse_clip_config(json, path);
  Json::Object members;
  for (const auto& [key, value] : section->as_object(path + ": open_clip"))
    if (key != "quick_gelu") members.emplace_back(key, value);
  return parse_clip_config(Json(std::move(members)), path);
}

// The pictures normalised by our own code, compared with the reference's.   result: [n, S, S, 3]
Tensor<float, 4> clip_pixels(Comparison& comparison) {
  const Safetensors& file = comparison.file();
  const TensorEntry& entry = file.at("images");
  LVGGT_CHECK(entry.shape.size() == 4, file.path(), ": images are no batch of pictures");
  const std::int64_t n = entry.shape[0], S = entry.shape[2], plane = S * S;
  const std::vector<std::int64_t> bytes = file.read_int64("images");
  Tensor<std::uint8_t, 4> images(Shape{n, S, S, std::int64_t{3}});
  Tensor<float, 4> pixels(images.shape());
  std::vector<float> planes(bytes.size());
  for (std::int64_t i = 0; i < n; ++i) {
    for (std::int64_t k = 0; k < 3 * plane; ++k)
      images.data()[i * 3 * plane + k % plane * 3 + k / plane] =
          static_cast<std::uint8_t>(bytes[static_cast<std::size_t>(i * 3 * plane + k)]);
    clip_normalize(pixels[i], std::as_const(images)[i]);
    for (std::int64_t k = 0; k < 3 * plane; ++k)
      planes[static_cast<std::size_t>(i * 3 * plane + k)] =
          pixels.data()[i * 3 * plane + k % plane * 3 + k / plane];
  }
  comparison.accept("images");
  comparison.compare("pixels", planes);
  return pixels;
}

// softmax over phrases of 100 * cosine
std::vector<float> probabilities(const Tensor<float, 2>& images, const Tensor<float, 2>& phrases) {
  std::vector<float> result;
  for (std::int64_t i = 0; i < images.extent(0); ++i) {
    std::vector<double> weights;
    double sum = 0;
    for (std::int64_t p = 0; p < phrases.extent(0); ++p) {
      double cosine = 0;
      for (std::int64_t c = 0; c < images.extent(1); ++c)
        cosine += double{images(i, c)} * phrases(p, c);
      weights.push_back(std::exp(100 * (cosine - 1)));
      sum += weights.back();
    }
    for (const double weight : weights) result.push_back(static_cast<float>(weight / sum));
  }
  return result;
}

}  // namespace

void check_clip_towers(Comparison& comparison, const std::string& weights,
                       const std::string& config_path, Context& ctx) {
  const Safetensors file = Safetensors::open(weights);
  ClipConfig config = clip_config(config_path);
  const Tensor<float, 4> pixels = clip_pixels(comparison);
  const TensorEntry& entry = comparison.file().at("tokens");
  LVGGT_CHECK(entry.shape.size() == 2, comparison.file().path(), ": tokens are no batch");
  const std::vector<std::int64_t> ids = comparison.file().read_int64("tokens");
  const View<const std::int64_t, 2> tokens(ids.data(), Shape{entry.shape[0], entry.shape[1]});
  comparison.accept("tokens");
  for (const bool quick : {false, true}) {
    config.quick_gelu = quick;
    const ClipText text = load_clip_text(file, config);
    const ClipImage image = load_clip_image(file, config);
    Watcher watcher(quick ? "quickgelu" : "gelu", false);
    Tensor<float, 2> phrases(Shape{tokens.extent(0), text.width()}), again(phrases.shape());
    Tensor<float, 2> pictures(Shape{pixels.extent(0), image.width()});
    clip_text_forward(phrases, tokens, text, &watcher, ctx);
    clip_image_forward(pictures, pixels, image, &watcher, ctx);
    watcher.set_channels(image.class_embedding.extent(0));
    watcher.turn_to_planes("visual.conv1", image.positional_embedding.extent(0) - 1);
    watcher.compare(comparison);
    // As programs run it: nobody watches, and what follows the end tokens is left out.
    clip_text_forward(again, tokens, text, nullptr, ctx);
    comparison.compare(quick ? "quickgelu.text_embedding" : "gelu.text_embedding", again);
    clip_image_forward(pictures, pixels, image, nullptr, ctx);
    comparison.compare(quick ? "quickgelu.image_embedding" : "gelu.image_embedding", pictures);
    if (!quick) comparison.compare("probability", probabilities(pictures, again));
  }
}

void check_mistral(Comparison& comparison, const std::string& weights,
                   const std::string& config_path, Context& ctx) {
  const Safetensors& file = comparison.file();
  MistralConfig config;
  if (!config_path.empty()) {
    const Json json = Json::read(config_path);
    const Json* section = json.find("huggingface");
    config = parse_mistral_config(section == nullptr ? json : *section, config_path);
  }
  const Mistral model = Mistral::open(Safetensors::open(weights), config);
  std::vector<std::vector<std::int64_t>> sequences;
  for (std::size_t s = 0; comparison.wants(concat("seq", s, ".input_ids")); ++s) {
    const std::string prefix = concat("seq", s);
    sequences.push_back(file.read_int64(prefix + ".input_ids"));
    comparison.accept(prefix + ".input_ids");
    Watcher watcher(prefix, true);
    Tensor<float, 2> alone(Shape{std::int64_t{1}, model.width()});
    model.forward(alone, std::span(sequences).last(1), &watcher, ctx);
    watcher.compare(comparison);
  }
  comparison.accept("input_ids");
  comparison.accept("attention_mask");
  const auto n = static_cast<std::int64_t>(sequences.size());
  Tensor<float, 2> embeddings(Shape{n, model.width()});
  struct Pooled : Observer {
    std::vector<float> values;
    void observe(std::string_view name, std::int64_t, View<const float, 2> rows) override {
      if (name == "pooled") values.assign(rows.data(), rows.data() + rows.size());
    }
  } pooled;
  model.forward(embeddings, sequences, &pooled, ctx);
  comparison.compare("pooled", pooled.values);
  comparison.compare("embedding", embeddings);
  std::vector<float> cosines;
  for (std::int64_t i = 0; i < n; ++i)
    for (std::int64_t j = 0; j < n; ++j) {
      double cosine = 0;
      for (std::int64_t c = 0; c < model.width(); ++c)
        cosine += double{embeddings(i, c)} * embeddings(j, c);
      cosines.push_back(static_cast<float>(cosine));
    }
  comparison.compare("cosine", cosines);
}

}  // namespace check_reference
