// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/kernels/packed_matrix.h"
#include "lvggt/language/autoencoder.h"

namespace lvggt {

// Cosines between decoded codes and given vectors without the decoded features themselves. With h
// the input of the decoder's last layer, W and b its weight and bias, a feature is f = W h + b and
//   <f, v> = <W^T v, h> + <b, v>       |f| = |R h + r|, (R r; 0 s)  the Cholesky factor of
//                                            (W b)^T (W b), so |f|^2 = |R h + r|^2 + s^2
// so that D features a pixel never exist, several vectors cost one narrow product, and |f| half of
// what the last layer would. Where D is no larger than the width of h, R is W itself.
class DecodedCosines {
 public:
  // Keeps a reference to the autoencoder, which must outlive this.
  DecodedCosines(const Autoencoder& autoencoder, Context& ctx);

  // Without an autoencoder: rows are features of width D already, of any length.
  explicit DecodedCosines(std::int64_t feature_width);

  std::int64_t code_width() const;                               // d, or D
  std::int64_t feature_width() const { return feature_width_; }  // D

  // Vectors made ready for cosines().
  struct Vectors {
    PackedMatrix weight;    // [n, hidden width]: W^T v
    Tensor<float, 1> bias;  // [n]: <b, v>
    std::int64_t count() const { return weight.N; }
  };
  // Errors: kMismatch for vectors of another width.   vectors: [n, D], of unit length
  Vectors prepare(View<const float, 2> vectors, Context& ctx) const;

  // cosines[i, j] = <f_i, v_j> / |f_i|; 0 where f_i has no length.
  //   cosines: [N, n]   codes: [N, d]
  void cosines(View<float, 2> out, View<const float, 2> codes, const Vectors& vectors,
               Context& ctx) const;

  // Rows worked on at once, which bounds the scratch.
  static constexpr std::int64_t kTileRows = 2048;

 private:
  struct Block {  // rows [begin, begin + weight.N) of R, which are zero before column `begin`
    std::int64_t begin = 0;
    PackedMatrix weight;
    Tensor<float, 1> bias;  // r
  };
  void factor_last_layer(Context& ctx);
  void lengths(View<float, 1> length, View<const float, 2> hidden, Context& ctx) const;

  const Autoencoder* autoencoder_ = nullptr;
  std::int64_t feature_width_ = 0;
  std::vector<Block> blocks_;
  float rest_ = 0;  // s
};

}  // namespace lvggt
