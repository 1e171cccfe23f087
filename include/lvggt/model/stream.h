// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <limits>
#include <memory>
#include <optional>
#include <string>

#include "lvggt/model/lang_vggt.h"

namespace lvggt {

// What is known about one frame. Views are into the stream's buffers and live until its next push;
// what was not asked for is an empty view.
struct Frame {
  std::int64_t index = 0;  // 0 for the first frame pushed
  std::int64_t frames_attended =
      0;          // frames in the cache while this one was computed, itself included
  Camera camera;  // in the pixels of the pushed frame
  View<const float, 1> pose_encoding;      // [9]: tx ty tz, qx qy qz qw, fov_h fov_w
  View<const float, 2> depth;              // [H, W], along the camera's z axis
  View<const float, 2> depth_confidence;   // [H, W], at least 1
  View<const float, 3> points;             // [H, W, 3], of the point head, in world coordinates
  View<const float, 2> points_confidence;  // [H, W], at least 1
  View<const float, 3> rgb;                // [H, W, 3], in [0, 1]
  View<const float, 4> language;           // [level, H, W, lang_dim]
  View<const float, 4> states;             // [level, H, W, lang_dim of the state decoder]
  StageTimes times;
};

// Runs the model over a video, one frame after the other. Owns the caches and the output buffers;
// the model and the context must outlive it. From the second frame on, push does not touch the
// heap.
class Stream {
 public:
  // Throws kUsage for options out of range and kMismatch for the point head when the model has
  // none.
  Stream(const LangVggt& model, Context& ctx, const StreamOptions& options = {})
      : model_(&model), ctx_(&ctx), options_(options) {
    check_options();
  }

  // pixels: [H, W, 3], RGB in [0, 1], H and W multiples of the patch size and the same for every
  // frame; rows may be strided. Throws kMismatch for another size, kNumeric naming stage and frame
  // when a value is not finite or the camera cannot be decoded. A frame that fails leaves the
  // stream as it was before it. The observer, if any, sees intermediate values: those of each
  // module, "agg.camera_token" and "cam.pose_enc" ([iterations, 9]).
  Frame push(View<const float, 3> pixels, Observer* observer = nullptr) {
    Frame frame;
    {
      const StageTimer timer(frame.times.total);
      check_pixels(pixels);
      if (!buffers_) prepare(pixels.extent(0), pixels.extent(1));
      run(frame, pixels, observer);
      buffers_->tokens.end_frame();
      if (options_.camera_cache == CameraCache::kStream) buffers_->camera_entries.end_frame();
      ++num_frames_;
    }
    return frame;
  }

  // Entries in the camera head's cache: one for each iteration of each cached frame.
  std::int64_t camera_cache_length() const {
    return buffers_ ? buffers_->camera_entries.num_frames() * model_->config().cam_iterations : 0;
  }

 private:
  // Everything whose size follows from the frames', made at the first push.
  struct Buffers {
    FrameGeometry geometry;
    KvCache tokens;
    KvCache camera_entries;
    CameraIterations camera_iterations;
    std::optional<DptEmbeddings> depth_embeddings = {}, point_embeddings = {};
    Tensor<float, 3> pose_encodings = {};  // [iterations, 1, 9]
    Tensor<float, 2> depth = {}, depth_confidence = {}, points_confidence = {};
    Tensor<float, 3> points = {}, rgb = {};
    Tensor<float, 4> language = {}, states = {};
  };

  void check_options() const {
    const auto bad_side = [](std::int64_t side) { return side < 0 || side > kMaxSide; };
    if (options_.max_past_frames < 1 || options_.max_past_frames > kMaxPastFrames)
      fail(ErrorKind::kUsage, "stream: the number of past frames must lie in [1, ", kMaxPastFrames,
           "], not ", options_.max_past_frames);
    if (options_.cache_storage == Storage::kF16)
      fail(ErrorKind::kUsage,
           "stream: cached keys and values are kept as f32, bf16 or int8, not f16");
    if (bad_side(options_.decoder_height) || bad_side(options_.decoder_width) ||
        (options_.decoder_height == 0) != (options_.decoder_width == 0))
      fail(ErrorKind::kUsage, "stream: the decoder's output size must lie in [1, ", kMaxSide,
           "] on both sides, not ", options_.decoder_height, " x ", options_.decoder_width);
    LVGGT_CHECK(!options_.points || model_->has_point_head(),
                "stream: points are asked for, but the model was loaded without a point head");
  }

  bool runs_decoder() const { return options_.decoder && model_->has_decoder(); }
  bool runs_state_decoder() const { return options_.decoder && model_->has_state_decoder(); }

  // The decoder whose RGB head runs, null without any: the same picture is not painted twice.
  const SemanticBridgingDecoder* decoder_of_rgb() const {
    if (!options_.rgb) return nullptr;
    if (runs_decoder() && model_->decoder().rgb_decoder) return &model_->decoder();
    if (runs_state_decoder() && model_->state_decoder().rgb_decoder)
      return &model_->state_decoder();
    return nullptr;
  }

  void prepare(std::int64_t H, std::int64_t W) {
    const ModelConfig& c = model_->config();
    const StreamVggt& geometry_model = model_->geometry();
    const bool decodes = runs_decoder() || runs_state_decoder();
    LVGGT_CHECK(!decodes || (H >= 8 && W >= 8), "stream: a frame of ", W, " x ", H,
                " pixels is too small for the decoder, which halves it three times");
    FrameGeometry geometry = make_frame_geometry(geometry_model.aggregator, H, W, *ctx_);
    const std::int64_t P = geometry.num_tokens(geometry_model.aggregator);
    const std::int64_t h = geometry.h, w = geometry.w;
    const std::int64_t cam_head_dim = 2 * c.embed_dim / c.cam_heads;
    auto b = std::unique_ptr<Buffers>(new Buffers{
        .geometry = std::move(geometry),
        .tokens = KvCache(c.agg_depth, c.agg_heads, c.embed_dim / c.agg_heads, P,
                          options_.max_past_frames, options_.cache_storage, options_.window),
        .camera_entries = KvCache(c.cam_trunk_depth, c.cam_heads, cam_head_dim, c.cam_iterations,
                                  options_.max_past_frames, Storage::kF32, options_.window),
        .camera_iterations = {Tensor<float, 4>(camera_shape()), Tensor<float, 4>(camera_shape())},
        .depth_embeddings = make_dpt_embeddings(geometry_model.depth_head, h, w, H, W),
        .pose_encodings =
            Tensor<float, 3>(Shape{c.cam_iterations, std::int64_t{1}, kPoseEncodingSize}),
        .depth = Tensor<float, 2>(Shape{H, W}),
        .depth_confidence = Tensor<float, 2>(Shape{H, W})});
    if (options_.points) {
      b->point_embeddings = make_dpt_embeddings(*geometry_model.point_head, h, w, H, W);
      b->points = Tensor<float, 3>(Shape{H, W, std::int64_t{3}});
      b->points_confidence = Tensor<float, 2>(Shape{H, W});
    }
    const std::int64_t Ho = options_.decoder_height > 0 ? options_.decoder_height : H;
    const std::int64_t Wo = options_.decoder_width > 0 ? options_.decoder_width : W;
    if (runs_decoder()) b->language = Tensor<float, 4>(Shape{c.sbd_levels, Ho, Wo, c.lang_dim});
    if (runs_state_decoder()) {
      const ModelConfig& state = model_->state_config();
      b->states = Tensor<float, 4>(Shape{state.sbd_levels, Ho, Wo, state.lang_dim});
    }
    if (decoder_of_rgb() != nullptr) b->rgb = Tensor<float, 3>(Shape{Ho, Wo, std::int64_t{3}});
    buffers_ = std::move(b);
  }

  Shape<4> camera_shape() const {
    const ModelConfig& c = model_->config();
    return {c.cam_trunk_depth, c.cam_iterations, c.cam_heads, 2 * c.embed_dim / c.cam_heads};
  }

  // One frame, up to but without ending it in the caches.
  void run(Frame& frame, View<const float, 3> pixels, Observer* observer) {
    Buffers& b = *buffers_;
    const Aggregator& aggregator = model_->geometry().aggregator;
    const std::int64_t P = b.geometry.num_tokens(aggregator), C = aggregator.embed_dim();
    frame.index = num_frames_;
    frame.frames_attended = b.tokens.num_frames() + 1;
    Arena::Scope scope(ctx_->arena());
    AggregatedTokens out = alloc_aggregated_tokens(aggregator, 1, P, *ctx_);
    {
      Arena::Scope inner(ctx_->arena());
      const View<float, 2> tokens = ctx_->arena().alloc(Shape{P, C});
      {
        const StageTimer timer(frame.times.dino);
        embed_frame(tokens, pixels, aggregator, num_frames_, b.geometry, observer, *ctx_);
      }
      check_finite(tokens, "the DINOv2 encoder's tokens");
      aggregate_streamed(out, tokens, aggregator, b.geometry, b.tokens, frame.times, observer,
                         *ctx_);
    }
    for (const View<float, 2>& tap : out.taps) check_finite(tap, "the aggregator's tokens");
    check_finite(out.camera, "the aggregator's camera token");
    if (observer) observer->observe("agg.camera_token", 0, out.camera);
    run_camera_head(frame, out.camera, observer);
    run_dense_heads(frame, patch_taps(out, 0, P, aggregator.patch_start_idx()), observer);
  }

  void run_camera_head(Frame& frame, View<const float, 2> camera_token, Observer* observer) {
    Buffers& b = *buffers_;
    const CameraHead& head = model_->geometry().camera_head;
    const StageTimer timer(frame.times.camera);
    if (options_.camera_cache == CameraCache::kStream) {
      camera_head_streamed(b.pose_encodings, camera_token, head, b.camera_entries,
                           b.camera_iterations, *ctx_);
    } else {
      camera_head_alone(b.pose_encodings, camera_token, head, *ctx_);
    }
    const View<float, 2> iterations =
        b.pose_encodings.view().reshaped(Shape{head.num_iterations, kPoseEncodingSize});
    check_finite(iterations, "the camera head's pose encoding");
    if (observer) observer->observe("cam.pose_enc", 0, iterations);
    frame.pose_encoding = iterations[head.num_iterations - 1];
    try {
      frame.camera = decode_pose_encoding(frame.pose_encoding, b.geometry.H, b.geometry.W);
    } catch (const Error& e) {
      if (options_.allow_degenerate_camera) {
        frame.camera.fx = frame.camera.fy = std::numeric_limits<float>::quiet_NaN();
        return;
      }
      fail(e.kind(), "frame ", num_frames_, ": ", e.what());
    }
  }

  void run_dense_heads(Frame& frame, const std::array<View<const float, 2>, 4>& taps,
                       Observer* observer) {
    Buffers& b = *buffers_;
    const StreamVggt& geometry = model_->geometry();
    {
      const StageTimer timer(frame.times.depth);
      predict_depth(b.depth, b.depth_confidence, taps, b.geometry, geometry.depth_head,
                    b.depth_embeddings, *ctx_);
      check_finite(b.depth.view(), "the depth head's depth");
      check_finite(b.depth_confidence.view(), "the depth head's confidence");
      frame.depth = b.depth;
      frame.depth_confidence = b.depth_confidence;
    }
    if (options_.points) {
      const StageTimer timer(frame.times.points);
      predict_points(b.points, b.points_confidence, taps, b.geometry, *geometry.point_head,
                     b.point_embeddings, *ctx_);
      check_finite(pixel_rows(b.points.view()), "the point head's points");
      check_finite(b.points_confidence.view(), "the point head's confidence");
      frame.points = b.points;
      frame.points_confidence = b.points_confidence;
    }
    if (runs_decoder())
      frame.language = run_decoder(frame, b.language, taps, model_->decoder(), observer);
    // The observer knows the stages of one decoder by name.
    if (runs_state_decoder())
      frame.states = run_decoder(frame, b.states, taps, model_->state_decoder(), nullptr);
  }

  View<const float, 4> run_decoder(Frame& frame, View<float, 4> language,
                                   const std::array<View<const float, 2>, 4>& taps,
                                   const SemanticBridgingDecoder& decoder, Observer* observer) {
    Buffers& b = *buffers_;
    const StageTimer timer(frame.times.decoder);
    const View<float, 3> rgb = &decoder == decoder_of_rgb() ? b.rgb.view() : View<float, 3>();
    semantic_bridging_decoder_forward(language, rgb, taps, b.geometry.h, b.geometry.w, b.geometry.H,
                                      b.geometry.W, decoder, observer, *ctx_);
    for (std::int64_t level = 0; level < language.extent(0); ++level)
      check_finite(pixel_rows(language[level]), "the decoder's language features");
    if (!rgb.empty()) {
      check_finite(pixel_rows(rgb), "the decoder's colours");
      frame.rgb = rgb;
    }
    return language;
  }

  void check_pixels(View<const float, 3> pixels) const {
    LVGGT_CHECK(pixels.extent(2) == 3 && pixels.stride(1) == 3, "stream: pixels are ",
                pixels.shape(), ", not [H, W, 3] with dense rows");
    const std::int64_t H = pixels.extent(0), W = pixels.extent(1);
    LVGGT_CHECK(H <= kMaxSide && W <= kMaxSide, "stream: a frame of ", W, " x ", H,
                " pixels is larger than ", kMaxSide, " on a side");
    if (buffers_)
      LVGGT_CHECK(H == buffers_->geometry.H && W == buffers_->geometry.W, "stream: frame ",
                  num_frames_, " has ", W, " x ", H, " pixels, but the frames before had ",
                  buffers_->geometry.W, " x ", buffers_->geometry.H);
    check_finite(View<const float, 2>(pixels.data(), Shape{H, 3 * W}, {pixels.stride(0), 1}),
                 "the input pixels");
  }

  void check_finite(View<const float, 2> rows, const char* what) const {
    for (std::int64_t i = 0; i < rows.extent(0); ++i) {
      const std::int64_t at = find_nonfinite(rows[i]);
      if (at >= 0)
        fail(ErrorKind::kNumeric, "frame ", num_frames_, ": ", what, " hold ", rows(i, at),
             " at row ", i, ", column ", at);
    }
  }

  const LangVggt* model_;
  Context* ctx_;
  StreamOptions options_;
  std::int64_t num_frames_ = 0;  // pushed
  std::unique_ptr<Buffers> buffers_;
};

}  // namespace lvggt
