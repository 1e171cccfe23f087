// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/query.h"

#include <algorithm>
#include <optional>

#include "kernels/language/mask_filters.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/language/mask_filters.h"
#include "lvggt/nn/params.h"

namespace lvggt {
namespace {

void check_window(const char* what, std::int64_t size) {
  if (size < 1 || size % 2 == 0)
    fail(ErrorKind::kUsage, "query: the ", what, " filter has a side of ", size,
         " pixels; it must be odd");
}

template <class T, int R>
void resize(Tensor<T, R>& tensor, const Shape<R>& shape) {
  if (tensor.empty() || tensor.shape() != shape) tensor = Tensor<T, R>(shape);
}

void check_codes(View<const float, 4> codes, std::int64_t d) {
  LVGGT_CHECK(codes.extent(3) == d, "query: the field has codes of ", codes.extent(3),
              " numbers but the autoencoder takes ", d);
  LVGGT_CHECK(codes.extent(0) >= 1 && codes.size() > 0, "query: the codes are ", codes.shape(),
              ", there is nothing to ask");
  for (std::int64_t l = 0; l < codes.extent(0); ++l)
    for (std::int64_t y = 0; y < codes.extent(1); ++y)
      for (std::int64_t x = 0; x < codes.extent(2); ++x)
        if (const std::int64_t c = find_nonfinite(codes[l][y][x]); c >= 0)
          fail(ErrorKind::kNumeric, "query: the code of level ", l, ", row ", y, ", column ", x,
               " is ", codes(l, y, x, c));
}

// [H, W, d] with any strides as [H*W, d], copied only where rows have gaps.
View<const float, 2> code_rows(View<const float, 3> codes, Arena& arena) {
  const auto [H, W, d] = codes.shape();
  if (H <= 1 || codes.stride(0) == W * codes.stride(1)) return pixel_rows(codes);
  const View<float, 2> rows = arena.alloc(Shape{H * W, d});
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t x = 0; x < W; ++x) std::copy_n(codes[y][x].data(), d, rows[y * W + x].data());
  return rows;
}

// filtered = (box filter of relevancy + relevancy) / 2; returns its maximum.
float filter_map(View<float, 2> filtered, View<const float, 2> relevancy, std::int64_t box,
                 double* columns) {
  kernels::box_filter(filtered, relevancy, box, columns);
  const auto [H, W] = relevancy.shape();
  float largest = 0;
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t x = 0; x < W; ++x) {
      const float value = 0.5F * (filtered(y, x) + relevancy(y, x));
      filtered(y, x) = value;
      largest = (x == 0 && y == 0) ? value : std::max(largest, value);
    }
  return largest;
}

}  // namespace

PhraseQuery::PhraseQuery(const DecodedCosines& decoder, View<const float, 2> phrases,
                         View<const float, 2> canonical, const PhraseQueryOptions& options,
                         Context& ctx)
    : relevancy_(decoder, phrases, canonical, ctx), options_(options) {
  check_window("box", options.box);
  check_window("majority", options.majority);
}

void PhraseQuery::answer(PhraseAnswers& answers, View<const float, 4> codes, Context& ctx) const {
  check_codes(codes, relevancy_.code_width());
  const auto [L, H, W, d] = codes.shape();
  const std::int64_t n = num_phrases();
  resize(answers.relevancy, Shape{n, H, W});
  resize(answers.mask_raw, Shape{n, H, W});
  resize(answers.mask, Shape{n, H, W});
  resize(answers.score, Shape{n, L});
  answers.level.assign(static_cast<std::size_t>(n), 0);
  answers.rescaled = options_.rescale_positive && all_positive(codes);
  Arena::Scope scope(ctx.arena());
  if (answers.rescaled) {
    const View<float, 4> rescaled = ctx.arena().alloc(codes.shape());
    for (std::int64_t l = 0; l < L; ++l)
      for (std::int64_t y = 0; y < H; ++y)
        for (std::int64_t x = 0; x < W; ++x)
          for (std::int64_t c = 0; c < d; ++c) rescaled(l, y, x, c) = 2 * codes(l, y, x, c) - 1;
    codes = rescaled;
  }
  for (std::int64_t g = 0; g < relevancy_.num_groups(); ++g) answer_group(answers, codes, g, ctx);
}

void PhraseQuery::answer_group(PhraseAnswers& answers, View<const float, 4> codes, std::int64_t g,
                               Context& ctx) const {
  const std::int64_t L = codes.extent(0), H = codes.extent(1), W = codes.extent(2);
  const std::int64_t n = relevancy_.group_size(g), first = g * Relevancy::kGroup;
  Arena::Scope scope(ctx.arena());
  const View<float, 2> maps = ctx.arena().alloc(Shape{n, H * W});
  const std::int64_t threads = ctx.num_threads();
  const View<float, 3> filtered = ctx.arena().alloc(Shape{threads, H, W});
  const View<double, 2> columns = ctx.arena().alloc<double>(Shape{threads, W});
  for (std::int64_t l = 0; l < L; ++l) {
    Arena::Scope level_scope(ctx.arena());
    relevancy_.run_group(maps, code_rows(codes[l], ctx.arena()), g, ctx);
    parallel_chunks(
        n,
        [&](std::int64_t i, int worker) {
          const View<float, 2> map = filtered[worker];
          const View<const float, 2> raw(maps[i].data(), Shape{H, W});
          const float score = filter_map(map, raw, options_.box, columns[worker].data());
          const std::int64_t q = first + i;
          std::int64_t& best = answers.level[static_cast<std::size_t>(q)];
          answers.score(q, l) = score;
          if (l > 0 && !(score > answers.score(q, best))) return;
          best = l;
          std::copy_n(map.data(), H * W, answers.relevancy[q].data());
        },
        ctx);
  }
  const View<std::int32_t, 2> counts = ctx.arena().alloc<std::int32_t>(Shape{threads, W});
  parallel_chunks(
      n,
      [&](std::int64_t i, int worker) {
        const std::int64_t q = first + i;
        threshold_mask(answers.mask_raw[q], answers.relevancy[q], options_.threshold);
        kernels::majority_filter(answers.mask[q], answers.mask_raw[q], options_.majority,
                                 counts[worker].data());
      },
      ctx);
}

void PhraseQuery::answer_level(View<float, 3> relevancy, View<float, 3> filtered,
                               View<std::uint8_t, 3> mask_raw, View<std::uint8_t, 3> mask,
                               View<const float, 3> codes, Context& ctx) const {
  const std::int64_t H = codes.extent(0), W = codes.extent(1), n = num_phrases();
  Arena::Scope scope(ctx.arena());
  const auto or_scratch = [&]<class T>(View<T, 3> view) {
    LVGGT_CHECK(view.empty() || (view.shape() == (Shape{n, H, W}) && view.dense()),
                "query: an output is ", view.shape(), ", not ", Shape{n, H, W});
    return view.empty() ? ctx.arena().alloc<T>(Shape{n, H, W}) : view;
  };
  relevancy = or_scratch(relevancy);
  filtered = or_scratch(filtered);
  mask_raw = or_scratch(mask_raw);
  mask = or_scratch(mask);
  relevancy_.run(relevancy.reshaped(Shape{n, H * W}), code_rows(codes, ctx.arena()), ctx);
  const View<double, 1> columns = ctx.arena().alloc<double>(Shape{W});
  for (std::int64_t q = 0; q < n; ++q) {
    filter_map(filtered[q], relevancy[q], options_.box, columns.data());
    threshold_mask(mask_raw[q], filtered[q], options_.threshold);
    majority_filter(mask[q], mask_raw[q], options_.majority, ctx);
  }
}

StateQuery::StateQuery(const DecodedCosines& decoder, View<const float, 2> sentences, Context& ctx)
    : decoder_(decoder), sentences_(decoder.prepare(sentences, ctx)) {}

void StateQuery::similarity(std::span<float> out, View<const float, 3> codes,
                            View<const std::uint8_t, 3> masks, Context& ctx) const {
  const auto [n, H, W] = masks.shape();
  LVGGT_CHECK(
      n == num_sentences() && std::ssize(out) == n && codes.extent(0) == H && codes.extent(1) == W,
      "query: ", num_sentences(), " sentences and codes ", codes.shape(), " do not fit masks ",
      masks.shape(), " and ", out.size(), " similarities");
  const auto inside = [&, n = n](std::int64_t y, std::int64_t x) {
    for (std::int64_t i = 0; i < n; ++i)
      if (masks(i, y, x) != 0) return true;
    return false;
  };
  // Only the pixels of any mask are decoded.
  std::vector<std::pair<std::int64_t, std::int64_t>> pixels;
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t x = 0; x < W; ++x)
      if (inside(y, x)) pixels.emplace_back(y, x);
  std::vector<double> sums(static_cast<std::size_t>(n));
  std::vector<std::int64_t> counts(static_cast<std::size_t>(n));
  const std::int64_t d = codes.extent(2);
  for (std::int64_t begin = 0; begin < std::ssize(pixels); begin += DecodedCosines::kTileRows) {
    const std::int64_t rows = std::min(DecodedCosines::kTileRows, std::ssize(pixels) - begin);
    Arena::Scope scope(ctx.arena());
    const View<float, 2> gathered = ctx.arena().alloc(Shape{rows, d});
    const View<float, 2> cosines = ctx.arena().alloc(Shape{rows, n});
    for (std::int64_t r = 0; r < rows; ++r) {
      const auto [y, x] = pixels[static_cast<std::size_t>(begin + r)];
      std::copy_n(codes[y][x].data(), d, gathered[r].data());
    }
    decoder_.cosines(cosines, gathered, sentences_, ctx);
    for (std::int64_t r = 0; r < rows; ++r) {
      const auto [y, x] = pixels[static_cast<std::size_t>(begin + r)];
      for (std::int64_t i = 0; i < n; ++i) {
        if (masks(i, y, x) == 0) continue;
        sums[static_cast<std::size_t>(i)] += cosines(r, i);
        ++counts[static_cast<std::size_t>(i)];
      }
    }
  }
  for (std::size_t i = 0; i < out.size(); ++i)
    out[i] = counts[i] > 0 ? static_cast<float>(sums[i] / static_cast<double>(counts[i])) : 0;
}

}  // namespace lvggt
