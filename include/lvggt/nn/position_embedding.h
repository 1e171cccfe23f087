// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "lvggt/core/parallel.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// The DPT head's embedding of a pixel's place, scaled: the first half of the channels depends on
// the column only, the second on the row only, so two small tables hold it all.
struct PositionEmbedding {
  Tensor<float, 2> columns;  // [W, D/2]
  Tensor<float, 2> rows;     // [H, D/2]
};

// Coordinate of place i of n along a side with half extent `span`: from -span (n-1)/n to +span
// (n-1)/n.
inline double uv_coordinate(double span, std::int64_t i, std::int64_t n) {
  const double last = static_cast<double>(n - 1);
  const double edge = span * last / static_cast<double>(n);
  return n == 1 ? -edge : -edge + 2 * edge * static_cast<double>(i) / last;
}

// The embedding of an H x W map of a frame with the given aspect (width / height) in D channels (a
// multiple of 4), times ratio. uv is normalised by the frame's diagonal; each coordinate p becomes
// [sin(p omega), cos(p omega)] with omega_j = 100^(-j / (D/4)), j = 0 .. D/4-1. Computed in double.
inline PositionEmbedding make_position_embedding(std::int64_t H, std::int64_t W, std::int64_t D,
                                                 double aspect, double ratio) {
  LVGGT_CHECK(D % 4 == 0, "position_embedding: ", D, " channels are not a multiple of 4");
  const double diagonal = std::sqrt(aspect * aspect + 1);
  const auto fill = [&](Tensor<float, 2>& table, double span) {
    const std::int64_t n = table.extent(0), quarter = D / 4;
    for (std::int64_t i = 0; i < n; ++i) {
      const double p = uv_coordinate(span, i, n);
      for (std::int64_t j = 0; j < quarter; ++j) {
        const double omega =
            std::pow(100.0, -static_cast<double>(j) / static_cast<double>(quarter));
        table(i, j) = static_cast<float>(ratio * std::sin(p * omega));
        table(i, quarter + j) = static_cast<float>(ratio * std::cos(p * omega));
      }
    }
  };
  PositionEmbedding embedding{Tensor<float, 2>(Shape{W, D / 2}), Tensor<float, 2>(Shape{H, D / 2})};
  fill(embedding.columns, aspect / diagonal);
  fill(embedding.rows, 1 / diagonal);
  return embedding;
}

// x += embedding.   x: [H, W, D], dense
inline void add_position_embedding(View<float, 3> x, const PositionEmbedding& embedding,
                                   Context& ctx) {
  const auto [H, W, D] = x.shape();
  LVGGT_CHECK(
      embedding.rows.shape() == (Shape{H, D / 2}) && embedding.columns.shape() == (Shape{W, D / 2}),
      "position_embedding: x is ", x.shape(), " but the embedding is for ", embedding.rows.shape(),
      " rows and ", embedding.columns.shape(), " columns");
  const std::int64_t half = D / 2, width = W;
  parallel_rows(
      H, 4,
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t i = begin; i < end; ++i) {
          const float* row = embedding.rows.data() + i * half;
          for (std::int64_t j = 0; j < width; ++j) {
            const float* column = embedding.columns.data() + j * half;
            float* pixel = x.data() + i * x.stride(0) + j * x.stride(1);
            for (std::int64_t c = 0; c < half; ++c) pixel[c] += column[c];
            for (std::int64_t c = 0; c < half; ++c) pixel[half + c] += row[c];
          }
        }
      },
      ctx);
}

}  // namespace lvggt
