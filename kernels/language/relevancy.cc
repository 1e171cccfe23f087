// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/relevancy.h"

#include <algorithm>
#include <cmath>

#include "kernels/grain.h"
#include "lvggt/core/parallel.h"

namespace lvggt {

Relevancy::Relevancy(const DecodedCosines& decoder, View<const float, 2> phrases,
                     View<const float, 2> canonical, Context& ctx)
    : decoder_(decoder), num_phrases_(phrases.extent(0)), num_canonical_(canonical.extent(0)) {
  const std::int64_t D = decoder.feature_width();
  LVGGT_CHECK(phrases.extent(1) == D && canonical.extent(1) == D, "relevancy: the phrases are ",
              phrases.shape(), " and the canonical phrases ", canonical.shape(),
              " but the features they are compared with are ", D, " wide");
  LVGGT_CHECK(num_canonical_ >= 1, "relevancy: there is no canonical phrase to compare with");
  for (std::int64_t g = 0; g < num_groups(); ++g) {
    Tensor<float, 2> vectors(Shape{num_canonical_ + group_size(g), D});
    for (std::int64_t c = 0; c < num_canonical_; ++c)
      std::copy_n(canonical[c].data(), D, vectors[c].data());
    for (std::int64_t i = 0; i < group_size(g); ++i)
      std::copy_n(phrases[g * kGroup + i].data(), D, vectors[num_canonical_ + i].data());
    groups_.push_back(decoder.prepare(vectors, ctx));
  }
}

void Relevancy::run(View<float, 2> relevancy, View<const float, 2> codes, Context& ctx) const {
  LVGGT_CHECK(relevancy.extent(0) == num_phrases_, "relevancy: there are ", num_phrases_,
              " phrases, but the maps are ", relevancy.shape());
  for (std::int64_t g = 0; g < num_groups(); ++g)
    run_group(relevancy.narrow(0, g * kGroup, g * kGroup + group_size(g)), codes, g, ctx);
}

void Relevancy::run_group(View<float, 2> relevancy, View<const float, 2> codes, std::int64_t g,
                          Context& ctx) const {
  const DecodedCosines::Vectors& vectors = groups_[static_cast<std::size_t>(g)];
  const std::int64_t N = codes.extent(0), n = group_size(g), C = num_canonical_;
  LVGGT_CHECK(relevancy.shape() == (Shape{n, N}), "relevancy: the maps are ", relevancy.shape(),
              ", not ", Shape{n, N});
  // Tiles as large as those of the decoder, so that the cosines of one need not be kept.
  for (std::int64_t begin = 0; begin < N; begin += DecodedCosines::kTileRows) {
    const std::int64_t end = std::min(begin + DecodedCosines::kTileRows, N);
    Arena::Scope scope(ctx.arena());
    const View<float, 2> cosines = ctx.arena().alloc(Shape{end - begin, vectors.count()});
    decoder_.cosines(cosines, codes.narrow(0, begin, end), vectors, ctx);
    relevancy_of_products(relevancy.narrow(1, begin, end), cosines, C, ctx);
  }
}

void relevancy_of_products(View<float, 2> relevancy, View<const float, 2> products,
                           std::int64_t num_canonical, Context& ctx) {
  const std::int64_t N = products.extent(0), n = relevancy.extent(0), C = num_canonical;
  LVGGT_CHECK(C >= 1 && relevancy.extent(1) == N && products.extent(1) == C + n,
              "relevancy: the maps are ", relevancy.shape(), " but the products ", products.shape(),
              " are with ", C, " canonical phrases");
  parallel_rows(
      N, kernels::rows_per_chunk(C + n),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t i = begin; i < end; ++i) {
          const float* row = products.data() + i * products.stride(0);
          const float nearest = *std::max_element(row, row + C);
          float* out = relevancy.data() + i;
          for (std::int64_t j = 0; j < n; ++j)
            out[j * relevancy.stride(0)] =
                1 / (1 + std::exp(kRelevancyScale * (nearest - row[C + j])));
        }
      },
      ctx);
}

bool all_positive(View<const float, 4> codes) {
  const auto [levels, H, W, d] = codes.shape();
  for (std::int64_t l = 0; l < levels; ++l)
    for (std::int64_t y = 0; y < H; ++y)
      for (std::int64_t x = 0; x < W; ++x) {
        const float* code = codes[l][y][x].data();
        for (std::int64_t c = 0; c < d; ++c)
          if (!(code[c] > 0)) return false;
      }
  return true;
}

}  // namespace lvggt
