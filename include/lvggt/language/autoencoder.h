// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/parallel.h"
#include "lvggt/core/tensor.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/model/tensor_list.h"
#include "lvggt/nn/params.h"

namespace lvggt {

// Widths of the layers of a language autoencoder, as 4DLangSplat has them: D language features to a
// code of d numbers and back.
struct AutoencoderShape {
  std::int64_t features = 0;  // D
  std::vector<std::int64_t>
      encoder;  // outputs of the encoder's layers, the last one d; may be none
  std::vector<std::int64_t> decoder;  // outputs of the decoder's layers, the last one D
  std::int64_t code = 0;              // d

  // 512 -> 256, 128, 64, 32, 3 -> 16, 32, 64, 128, 256, 512: CLIP ViT-B/16.
  static AutoencoderShape clip();
  // 4096 -> 2048, 1024, 512, 256, 128, 64, 32, 6 -> 32, 64, ..., 2048, 4096: e5-mistral-7b.
  static AutoencoderShape dynamic();

  friend bool operator==(const AutoencoderShape&, const AutoencoderShape&) = default;
};

// "512 -> 256, 128, 3 -> 128, 512", for messages.
std::string to_text(const AutoencoderShape& shape);

// Its tensors under their published names: encoder.N.* with linear layers at N = 0, 3, 6, ... and a
// batch norm before each but the first at N - 2, decoder.N.* with linear layers at N = 0, 2, 4, ...
std::vector<TensorSpec> autoencoder_tensors(const AutoencoderShape& shape);

// The widths that the tensors named prefix + "encoder.0.weight", ... have. A file with a decoder
// only is fine: queries need no more. Errors: kMismatch when there is no such decoder or its layers
// do not follow each other.
AutoencoderShape infer_autoencoder_shape(const Safetensors& file, const std::string& prefix = "");
AutoencoderShape infer_autoencoder_shape(std::span<const TensorSpec> tensors,
                                         const std::string& source, const std::string& prefix = "");

// The autoencoder in inference, immutable once loaded:
//   encode: Linear, then [BatchNorm, ReLU, Linear] for each further width; unit length
//   decode: Linear, then [ReLU, Linear];                                   unit length
// A row that comes out as all zeros has no direction and stays zero.
class Autoencoder {
 public:
  // Reads a safetensors file. Errors: what Safetensors::open throws; kMismatch listing what is
  // missing or misshapen; kFormat for values that are not finite.
  static Autoencoder load(const std::string& path);
  static Autoencoder from(const Safetensors& file, const std::string& prefix = "");

  // fill(spec, values) is asked for every tensor of autoencoder_tensors(shape).
  Autoencoder(const AutoencoderShape& shape,
              FunctionRef<void(const TensorSpec&, std::span<float>)> fill);

  const AutoencoderShape& shape() const { return shape_; }
  std::int64_t feature_width() const { return shape_.features; }  // D
  std::int64_t code_width() const { return shape_.code; }         // d
  bool has_encoder() const { return !encoder_.empty(); }

  //   codes: [N, d]   features: [N, D]
  void encode(View<float, 2> codes, View<const float, 2> features, Context& ctx) const;
  void decode(View<float, 2> features, View<const float, 2> codes, Context& ctx) const;

  // The input of the decoder's last linear layer; codes themselves when there is no layer before.
  //   hidden: [N, hidden_width()]   codes: [N, d]
  std::int64_t hidden_width() const;
  void decode_hidden(View<float, 2> hidden, View<const float, 2> codes, Context& ctx) const;

  // The decoder's last linear layer as it was read.
  View<const float, 2> last_weight() const { return last_weight_; }        // [D, hidden_width()]
  View<const float, 1> last_bias() const { return decoder_.back().bias; }  // [D]

 private:
  AutoencoderShape shape_;
  std::vector<Linear> encoder_, decoder_;  // batch norms folded in
  Tensor<float, 2> last_weight_;           // [D, hidden]
};

// y = x / |x| row by row; a row of zeros stays. length, which may be empty, receives |x|.
//   y, x: [N, C]   length: [N]   y may be x.
void normalise_rows(View<float, 2> y, View<float, 1> length, View<const float, 2> x, Context& ctx);

}  // namespace lvggt
