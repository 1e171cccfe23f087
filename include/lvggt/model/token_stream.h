// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <memory>

#include "lvggt/core/context.h"
#include "lvggt/core/error.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/model/aggregator.h"
#include "lvggt/model/kv_cache.h"
#include "lvggt/model/stream_options.h"
#include "lvggt/model/stream_vggt.h"

namespace lvggt {

// Runs the encoder alone over a video, frame after frame, and gives what the dense heads and the
// decoder read of each: the same values as they see inside of a Stream. Owns the cache and the
// outputs; the aggregator and the context must outlive it. From the second frame on, push does not
// touch the heap.
class TokenStream {
 public:
  // Of the options, the window and the storage of the cache count. kUsage when out of range.
  TokenStream(const Aggregator& aggregator, Context& ctx, const StreamOptions& options)
      : aggregator_(&aggregator), ctx_(&ctx), options_(options) {
    if (options.max_past_frames < 1 || options.max_past_frames > kMaxPastFrames)
      fail(ErrorKind::kUsage, "stream: the number of past frames must lie in [1, ", kMaxPastFrames,
           "], not ", options.max_past_frames);
    if (options.cache_storage == Storage::kF16)
      fail(ErrorKind::kUsage,
           "stream: cached keys and values are kept as f32, bf16 or int8, not f16");
  }

  // pixels: [H, W, 3], RGB in [0, 1], dense; H and W whole patches and the same for every frame.
  // Returns the patch tokens of the four taps, each [h*w, 2C], valid until the next push. Errors as
  // those of Stream::push; a frame that fails leaves the stream as it was before it.
  std::array<View<const float, 2>, 4> push(View<const float, 3> pixels) {
    LVGGT_CHECK(pixels.extent(2) == 3 && pixels.dense(), "stream: pixels are ", pixels.shape(),
                ", not dense [H, W, 3]");
    check_finite(pixels.reshaped(Shape{pixels.extent(0), 3 * pixels.extent(1)}),
                 "the input pixels");
    if (!buffers_) prepare(pixels.extent(0), pixels.extent(1));
    Buffers& b = *buffers_;
    LVGGT_CHECK(pixels.extent(0) == b.geometry.H && pixels.extent(1) == b.geometry.W,
                "stream: frame ", num_frames_, " has ", pixels.extent(1), " x ", pixels.extent(0),
                " pixels, but the frames before had ", b.geometry.W, " x ", b.geometry.H);
    AggregatedTokens out;
    for (std::size_t i = 0; i < 4; ++i) out.taps[i] = b.taps[i];
    out.camera = b.camera;
    const std::int64_t P = b.geometry.num_tokens(*aggregator_);
    {
      Arena::Scope scope(ctx_->arena());
      const View<float, 2> tokens = ctx_->arena().alloc(Shape{P, aggregator_->embed_dim()});
      embed_frame(tokens, pixels, *aggregator_, num_frames_, b.geometry, nullptr, *ctx_);
      check_finite(tokens, "the DINOv2 encoder's tokens");
      StageTimes times;
      aggregate_streamed(out, tokens, *aggregator_, b.geometry, b.cache, times, nullptr, *ctx_);
    }
    for (const View<float, 2>& tap : out.taps) check_finite(tap, "the aggregator's tokens");
    b.cache.end_frame();
    ++num_frames_;
    return patch_taps(out, 0, P, aggregator_->patch_start_idx());
  }

 private:
  struct Buffers {
    FrameGeometry geometry;
    KvCache cache;
    std::array<Tensor<float, 2>, 4> taps = {};  // [P, 2C]
    Tensor<float, 2> camera = {};               // [1, 2C]
  };

  void prepare(std::int64_t H, std::int64_t W) {
    LVGGT_CHECK(H <= kMaxSide && W <= kMaxSide, "stream: a frame of ", W, " x ", H,
                " pixels is larger than ", kMaxSide, " on a side");
    FrameGeometry geometry = make_frame_geometry(*aggregator_, H, W, *ctx_);
    const std::int64_t P = geometry.num_tokens(*aggregator_), C = aggregator_->embed_dim();
    const std::int64_t heads = aggregator_->global_blocks.front().attn.num_heads;
    auto b = std::unique_ptr<Buffers>(new Buffers{
        .geometry = std::move(geometry),
        .cache =
            KvCache(static_cast<std::int64_t>(aggregator_->global_blocks.size()), heads, C / heads,
                    P, options_.max_past_frames, options_.cache_storage, options_.window)});
    for (auto& tap : b->taps) tap = Tensor<float, 2>(Shape{P, 2 * C});
    b->camera = Tensor<float, 2>(Shape{std::int64_t{1}, 2 * C});
    buffers_ = std::move(b);
  }

  void check_finite(View<const float, 2> rows, const char* what) const {
    for (std::int64_t i = 0; i < rows.extent(0); ++i) {
      const std::int64_t at = find_nonfinite(rows[i]);
      if (at >= 0)
        fail(ErrorKind::kNumeric, "frame ", num_frames_, ": ", what, " hold ", rows(i, at),
             " at row ", i, ", column ", at);
    }
  }

  const Aggregator* aggregator_;
  Context* ctx_;
  StreamOptions options_;
  std::int64_t num_frames_ = 0;  // pushed
  std::unique_ptr<Buffers> buffers_;
};

}  // namespace lvggt
