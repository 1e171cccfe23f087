// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/autoencoder.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>

#include "kernels/grain.h"
#include "lvggt/kernels/batch_norm2d.h"
#include "lvggt/kernels/elementwise.h"

namespace lvggt {
namespace {

// PyTorch's default, which the published autoencoder takes.
constexpr float kBatchNormEps = 1e-5F;

// Rows that pass through the layers together, which bounds the scratch.
constexpr std::int64_t kTileRows = 2048;

std::string linear_name(const char* part, std::int64_t layer) {
  const std::int64_t stride = std::string_view(part) == "encoder" ? 3 : 2;
  return concat(part, ".", layer * stride);
}

void append_linear(std::vector<TensorSpec>& tensors, const std::string& name, std::int64_t out,
                   std::int64_t in) {
  tensors.push_back({name + ".weight", {out, in}});
  tensors.push_back({name + ".bias", {out}});
}

// The outputs of the linear layers of one part, from the shapes of their weights; `input` receives
// what the first one takes.
std::vector<std::int64_t> infer_widths(std::span<const TensorSpec> tensors,
                                       const std::string& source, const std::string& prefix,
                                       const char* part, std::int64_t& input) {
  std::vector<std::int64_t> widths;
  for (std::int64_t layer = 0;; ++layer) {
    const std::string name = prefix + linear_name(part, layer) + ".weight";
    const auto entry =
        std::ranges::find_if(tensors, [&](const TensorSpec& spec) { return spec.name == name; });
    if (entry == tensors.end()) return widths;
    LVGGT_CHECK(entry->shape.size() == 2, source, ": ", name, " is ", shape_text(entry->shape),
                ", not the matrix of a linear layer");
    if (layer == 0) input = entry->shape[1];
    LVGGT_CHECK(layer == 0 || entry->shape[1] == widths.back(), source, ": ", name, " is ",
                shape_text(entry->shape), " but the layer before it has ", widths.back(),
                " outputs");
    widths.push_back(entry->shape[0]);
  }
}

// Copies what a filled list of tensors has for one layer.
class Filled {
 public:
  Filled(const AutoencoderShape& shape,
         FunctionRef<void(const TensorSpec&, std::span<float>)> fill) {
    for (const TensorSpec& spec : autoencoder_tensors(shape)) {
      Tensor<float, 1> values(Shape{spec.volume()});
      fill(spec, {values.data(), static_cast<std::size_t>(values.size())});
      tensors_.emplace_back(spec, std::move(values));
    }
  }
  View<float, 1> vector(const std::string& name) { return find(name).second.view(); }
  View<float, 2> matrix(const std::string& name) {
    auto& [spec, values] = find(name);
    return View<float, 2>(values.data(), Shape{spec.shape[0], spec.shape[1]});
  }

 private:
  std::pair<TensorSpec, Tensor<float, 1>>& find(const std::string& name) {
    return *std::find_if(tensors_.begin(), tensors_.end(),
                         [&](const auto& tensor) { return tensor.first.name == name; });
  }
  std::vector<std::pair<TensorSpec, Tensor<float, 1>>> tensors_;
};

template <int R>
Tensor<float, R> copy_of(View<const float, R> values) {
  Tensor<float, R> copy(values.shape());
  std::copy_n(values.data(), values.size(), copy.data());
  return copy;
}

Linear pack_layer(Filled& filled, const std::string& name) {
  return {pack_linear(filled.matrix(name + ".weight")), copy_of<1>(filled.vector(name + ".bias"))};
}

// Folds the batch norm behind encoder layer `layer` into it.
void fold_norm(Filled& filled, std::int64_t layer) {
  const std::string name = linear_name("encoder", layer);
  const std::string norm = concat("encoder.", 3 * layer + 1);
  const View<float, 2> weight = filled.matrix(name + ".weight");
  const std::int64_t one = 1;
  batch_norm2d_fold(weight.reshaped(Shape{weight.extent(0), weight.extent(1), one, one}),
                    filled.vector(name + ".bias"), filled.vector(norm + ".weight"),
                    filled.vector(norm + ".bias"), filled.vector(norm + ".running_mean"),
                    filled.vector(norm + ".running_var"), kBatchNormEps);
}

// y = the last of `num_layers` linear layers with ReLUs between them, tile by tile.
void run_layers(View<float, 2> y, View<const float, 2> x, std::span<const Linear> layers,
                Activation last, Context& ctx) {
  std::int64_t widest = 1;
  for (const Linear& layer : layers) widest = std::max(widest, layer.weight.N);
  Arena::Scope scope(ctx.arena());
  const std::int64_t rows = std::min(kTileRows, x.extent(0));
  const std::array<View<float, 2>, 2> scratch{ctx.arena().alloc(Shape{rows, widest}),
                                              ctx.arena().alloc(Shape{rows, widest})};
  for (std::int64_t begin = 0; begin < x.extent(0); begin += rows) {
    const std::int64_t end = std::min(begin + rows, x.extent(0));
    View<const float, 2> input = x.narrow(0, begin, end);
    for (std::size_t i = 0; i < layers.size(); ++i) {
      const bool is_last = i + 1 == layers.size();
      const View<float, 2> output =
          is_last ? y.narrow(0, begin, end)
                  : scratch[i % 2].narrow(0, 0, end - begin).narrow(1, 0, layers[i].weight.N);
      linear_forward(output, input, layers[i], {.activation = is_last ? last : Activation::kRelu},
                     ctx);
      input = output;
    }
  }
}

}  // namespace

AutoencoderShape AutoencoderShape::clip() {
  return {512, {256, 128, 64, 32, 3}, {16, 32, 64, 128, 256, 512}, 3};
}

AutoencoderShape AutoencoderShape::dynamic() {
  return {
      4096, {2048, 1024, 512, 256, 128, 64, 32, 6}, {32, 64, 128, 256, 512, 1024, 2048, 4096}, 6};
}

std::string to_text(const AutoencoderShape& shape) {
  const auto widths = [](const std::vector<std::int64_t>& list) {
    std::string text;
    for (const std::int64_t width : list)
      text += (text.empty() ? "" : ", ") + std::to_string(width);
    return text;
  };
  const std::string encoder = shape.encoder.empty()
                                  ? concat("(no encoder) ", shape.code)
                                  : concat(shape.features, " -> ", widths(shape.encoder));
  return encoder + " -> " + widths(shape.decoder);
}

std::vector<TensorSpec> autoencoder_tensors(const AutoencoderShape& shape) {
  std::vector<TensorSpec> tensors;
  std::int64_t width = shape.features;
  for (std::size_t i = 0; i < shape.encoder.size(); ++i) {
    const auto layer = static_cast<std::int64_t>(i);
    if (i > 0) {
      const std::string norm = concat("encoder.", 3 * layer - 2);
      for (const char* last : {".weight", ".bias", ".running_mean", ".running_var"})
        tensors.push_back({norm + last, {width}});
    }
    append_linear(tensors, linear_name("encoder", layer), shape.encoder[i], width);
    width = shape.encoder[i];
  }
  width = shape.code;
  for (std::size_t i = 0; i < shape.decoder.size(); ++i) {
    append_linear(tensors, linear_name("decoder", static_cast<std::int64_t>(i)), shape.decoder[i],
                  width);
    width = shape.decoder[i];
  }
  return tensors;
}

AutoencoderShape infer_autoencoder_shape(std::span<const TensorSpec> tensors,
                                         const std::string& source, const std::string& prefix) {
  AutoencoderShape shape;
  shape.decoder = infer_widths(tensors, source, prefix, "decoder", shape.code);
  LVGGT_CHECK(!shape.decoder.empty(), source, ": holds no autoencoder; there is no tensor ", prefix,
              "decoder.0.weight");
  shape.features = shape.decoder.back();
  std::int64_t input = shape.features;
  shape.encoder = infer_widths(tensors, source, prefix, "encoder", input);
  LVGGT_CHECK(
      shape.encoder.empty() || (input == shape.features && shape.encoder.back() == shape.code),
      source, ": the encoder makes codes of ", shape.encoder.empty() ? 0 : shape.encoder.back(),
      " numbers from ", input, " features, but the decoder makes ", shape.features,
      " features from ", shape.code, " numbers");
  return shape;
}

AutoencoderShape infer_autoencoder_shape(const Safetensors& file, const std::string& prefix) {
  std::vector<TensorSpec> tensors;
  for (const TensorEntry& entry : file.entries()) tensors.push_back({entry.name, entry.shape});
  return infer_autoencoder_shape(tensors, file.path(), prefix);
}

Autoencoder Autoencoder::load(const std::string& path) { return from(Safetensors::open(path)); }

Autoencoder Autoencoder::from(const Safetensors& file, const std::string& prefix) {
  const AutoencoderShape shape = infer_autoencoder_shape(file, prefix);
  std::string wrong;
  for (const TensorSpec& spec : autoencoder_tensors(shape)) {
    const TensorEntry* entry = file.find(prefix + spec.name);
    if (entry == nullptr || entry->shape != spec.shape)
      wrong += concat(wrong.empty() ? "" : ", ", prefix, spec.name,
                      entry == nullptr ? std::string(" is missing")
                                       : concat(" is ", shape_text(entry->shape), ", not ",
                                                shape_text(spec.shape)));
  }
  LVGGT_CHECK(wrong.empty(), file.path(), ": not an autoencoder ", to_text(shape), ": ", wrong);
  return Autoencoder(shape, [&](const TensorSpec& spec, std::span<float> values) {
    file.read_into(prefix + spec.name, values);
    const std::int64_t bad = find_nonfinite(
        View<const float, 1>(values.data(), Shape{static_cast<std::int64_t>(values.size())}));
    if (bad >= 0)
      fail(ErrorKind::kFormat, file.path(), ": ", prefix, spec.name, " is ",
           values[static_cast<std::size_t>(bad)], " at element ", bad);
  });
}

Autoencoder::Autoencoder(const AutoencoderShape& shape,
                         FunctionRef<void(const TensorSpec&, std::span<float>)> fill)
    : shape_(shape) {
  LVGGT_CHECK(!shape.decoder.empty() && shape.decoder.back() == shape.features &&
                  (shape.encoder.empty() || shape.encoder.back() == shape.code),
              "autoencoder: ", to_text(shape), " does not come back to its ", shape.features,
              " features through a code of ", shape.code);
  Filled filled(shape, fill);
  for (std::size_t i = 0; i < shape.encoder.size(); ++i) {
    const auto layer = static_cast<std::int64_t>(i);
    if (i + 1 < shape.encoder.size()) fold_norm(filled, layer);
    encoder_.push_back(pack_layer(filled, linear_name("encoder", layer)));
  }
  for (std::size_t i = 0; i < shape.decoder.size(); ++i)
    decoder_.push_back(pack_layer(filled, linear_name("decoder", static_cast<std::int64_t>(i))));
  last_weight_ = copy_of<2>(filled.matrix(
      linear_name("decoder", static_cast<std::int64_t>(shape.decoder.size()) - 1) + ".weight"));
}

void Autoencoder::encode(View<float, 2> codes, View<const float, 2> features, Context& ctx) const {
  LVGGT_CHECK(has_encoder(), "autoencoder: only its decoder was loaded, it cannot encode");
  LVGGT_CHECK(features.extent(1) == shape_.features, "autoencoder: features are ", features.shape(),
              ", not ", shape_.features, " wide");
  LVGGT_CHECK(codes.shape() == (Shape{features.extent(0), shape_.code}), "autoencoder: codes are ",
              codes.shape(), ", not ", Shape{features.extent(0), shape_.code});
  run_layers(codes, features, encoder_, Activation::kNone, ctx);
  normalise_rows(codes, {}, codes, ctx);
}

void Autoencoder::decode(View<float, 2> features, View<const float, 2> codes, Context& ctx) const {
  LVGGT_CHECK(codes.extent(1) == shape_.code, "autoencoder: codes are ", codes.shape(), ", not ",
              shape_.code, " wide");
  LVGGT_CHECK(features.shape() == (Shape{codes.extent(0), shape_.features}),
              "autoencoder: features are ", features.shape(), ", not ",
              Shape{codes.extent(0), shape_.features});
  run_layers(features, codes, decoder_, Activation::kNone, ctx);
  normalise_rows(features, {}, features, ctx);
}

std::int64_t Autoencoder::hidden_width() const { return last_weight_.extent(1); }

void Autoencoder::decode_hidden(View<float, 2> hidden, View<const float, 2> codes,
                                Context& ctx) const {
  LVGGT_CHECK(
      codes.extent(1) == shape_.code && hidden.shape() == (Shape{codes.extent(0), hidden_width()}),
      "autoencoder: codes are ", codes.shape(), " and hidden ", hidden.shape(),
      " but the decoder's last layer has ", hidden_width(), " inputs from codes of ", shape_.code);
  if (decoder_.size() == 1) {
    copy_rows(hidden, codes, ctx);
    return;
  }
  run_layers(hidden, codes, std::span(decoder_).first(decoder_.size() - 1), Activation::kRelu, ctx);
}

void normalise_rows(View<float, 2> y, View<float, 1> length, View<const float, 2> x, Context& ctx) {
  LVGGT_CHECK(y.shape() == x.shape() && (!length || length.extent(0) == x.extent(0)),
              "normalise_rows: x is ", x.shape(), " but y is ", y.shape(), " and length ",
              length.shape());
  const std::int64_t C = x.extent(1);
  parallel_rows(
      x.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) {
          const float* from = x.data() + n * x.stride(0);
          float* to = y.data() + n * y.stride(0);
          double sum = 0;
          for (std::int64_t c = 0; c < C; ++c) sum += static_cast<double>(from[c]) * from[c];
          const double norm = std::sqrt(sum);
          const auto scale = static_cast<float>(norm > 0 ? 1 / norm : 0);
          for (std::int64_t c = 0; c < C; ++c) to[c] = from[c] * scale;
          if (length) length[n] = static_cast<float>(norm);
        }
      },
      ctx);
}

}  // namespace lvggt
