// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/video.h"

#include <cmath>
#include <utility>

#include "kernels/io/frame_selection.h"
#include "kernels/video/demuxer.h"
#include "kernels/video/rgb_converter.h"
#include "lvggt/io/checked.h"

namespace lvggt {

namespace video {
namespace {

Handle<AVCodecContext> open_decoder(const std::string& path, const Demuxer& demuxer,
                                    const Limits& limits) {
  const AVCodecParameters& parameters = *demuxer.stream().codecpar;
  const auto num_pixels = checked_mul(parameters.width, parameters.height);
  if (!num_pixels || *num_pixels > limits.image_pixels)
    fail(ErrorKind::kLimit, path, ": ", parameters.width, "x", parameters.height,
         " pixels are more than the limit of ", limits.image_pixels);
  const AVCodec* codec = avcodec_find_decoder(parameters.codec_id);
  if (!codec)
    fail(ErrorKind::kUnsupported, path, ": there is no decoder for its codec ",
         avcodec_get_name(parameters.codec_id));
  auto decoder = allocated(avcodec_alloc_context3(codec));
  avcodec_parameters_to_context(decoder.get(), &parameters);
  decoder->pkt_timebase = demuxer.stream().time_base;
  decoder->max_pixels = limits.image_pixels;
  decoder->thread_count = 1;
  const int opened = avcodec_open2(decoder.get(), codec, nullptr);
  if (opened < 0)
    fail(ErrorKind::kUnsupported, path, ": its ", codec->name,
         " stream cannot be decoded: ", error_text(opened));
  return decoder;
}

// More frames than any codec holds back.
constexpr int kMaxDrainingErrors = 64;

class VideoSource : public FrameSource {
 public:
  VideoSource(const std::string& path, const FrameSourceOptions& options)
      : path_(path),
        options_(options),
        demuxer_(path, options.limits, warnings_),
        decoder_(open_decoder(path, demuxer_, options.limits)),
        converter_(path, demuxer_.orientation(), demuxer_.stream().sample_aspect_ratio),
        packet_(allocated(av_packet_alloc())),
        frame_(allocated(av_frame_alloc())) {}

  std::optional<InputFrame> next() override {
    while (num_delivered_ < options_.max_frames && decode_next()) {
      const std::int64_t index = num_decoded_++;
      if (num_decoded_ > options_.limits.video_frames)
        fail(ErrorKind::kLimit, path_, ": has more than the limit of ",
             options_.limits.video_frames, " frames");
      check_size(index);
      advance_time(index);
      if (!detail::is_selected(options_, index)) continue;
      ++num_delivered_;
      return InputFrame{index, time_, concat("frame ", index), converter_.convert(*frame_)};
    }
    finish();
    return std::nullopt;
  }

  std::int64_t expected_frames() const override {
    const std::int64_t claimed = demuxer_.claimed_frames();
    return claimed < 0 ? -1 : detail::num_selected(options_, claimed);
  }

 private:
  // Fills frame_; false after the last one.
  bool decode_next() {
    while (true) {
      const int result = avcodec_receive_frame(decoder_.get(), frame_.get());
      if (result == 0) return true;
      if (result == AVERROR_EOF) return false;
      if (result == AVERROR(ENOMEM))
        fail(ErrorKind::kMemory, path_, ": the decoder ran out of memory");
      if (result == AVERROR(EAGAIN) && is_draining_) return false;
      if (result != AVERROR(EAGAIN)) {
        count_damage(result);
        // What is left in the decoder may still hold good frames, but not without end.
        if (is_draining_ && ++num_draining_errors_ > kMaxDrainingErrors) return false;
      }
      if (!is_draining_) feed_decoder();
    }
  }

  void feed_decoder() {
    if (!demuxer_.read(*packet_)) {
      is_draining_ = true;
      avcodec_send_packet(decoder_.get(), nullptr);
      return;
    }
    const bool is_damaged = (packet_->flags & AV_PKT_FLAG_CORRUPT) != 0;
    const int sent = avcodec_send_packet(decoder_.get(), packet_.get());
    av_packet_unref(packet_.get());
    if (sent == AVERROR(ENOMEM)) fail(ErrorKind::kMemory, path_, ": the decoder ran out of memory");
    if (is_damaged || (sent < 0 && sent != AVERROR_EOF))
      count_damage(sent < 0 ? sent : AVERROR_INVALIDDATA);
  }

  void count_damage(int error) {
    if (report_.damaged_packets++ == 0)
      first_damage_ = concat(num_decoded_ == 0 ? concat("before the first frame")
                                               : concat("after frame ", num_decoded_ - 1),
                             ": ", error_text(error));
  }

  void check_size(std::int64_t index) {
    const PictureSize size = converter_.size_of(*frame_);
    if (index == 0) {
      const auto num_pixels = checked_mul(size.width, size.height);
      if (!num_pixels || *num_pixels > options_.limits.image_pixels)
        fail(ErrorKind::kLimit, path_, ": frames of ", size.width, "x", size.height,
             " pixels are more than the limit of ", options_.limits.image_pixels);
      size_ = size;
      for (const std::string& remark : converter_.remarks(*frame_))
        warnings_.push_back(concat(path_, ": ", remark));
    }
    LVGGT_CHECK(size == size_, path_, ": frame ", index, " has ", size.width, "x", size.height,
                " pixels but the frames before it have ", size_.width, "x", size_.height,
                "; all frames must have one size");
    if ((frame_->flags & AV_FRAME_FLAG_CORRUPT) || frame_->decode_error_flags != 0)
      if (report_.damaged_frames++ == 0) first_damaged_frame_ = index;
  }

  // A time that is missing or does not go up is replaced by the one before plus the usual distance.
  void advance_time(std::int64_t index) {
    const std::int64_t stamp = frame_->best_effort_timestamp;
    const double time = static_cast<double>(stamp) * av_q2d(demuxer_.stream().time_base);
    const bool is_good =
        stamp != AV_NOPTS_VALUE && std::isfinite(time) && (index == 0 || time > time_);
    if (is_good) {
      time_ = time;
      return;
    }
    ++report_.repaired_timestamps;
    if (index == 0) return;  // starts at 0
    const double rate = av_q2d(demuxer_.stream().avg_frame_rate);
    constexpr double kUsualRate = 25;
    const double later = time_ + 1 / (rate > 0 && std::isfinite(rate) ? rate : kUsualRate);
    time_ = later > time_ ? later : std::nextafter(time_, HUGE_VAL);
  }

  void finish() {
    if (is_finished_) return;
    is_finished_ = true;
    if (num_delivered_ < options_.max_frames) {
      const std::string missing = demuxer_.missing_end();
      report_.partial = !missing.empty();
      if (num_decoded_ == 0)
        fail(ErrorKind::kFormat, path_, ": no frame could be decoded", missing.empty() ? "" : "; ",
             missing, first_damage_.empty() ? "" : "; damage ", first_damage_);
      detail::check_start(options_, num_decoded_, "frames");
      if (report_.partial)
        warnings_.push_back(
            concat(path_, ": ends early, after frame ", num_decoded_ - 1, ": ", missing));
    }
    if (report_.damaged_packets > 0)
      warnings_.push_back(concat(path_, ": ", report_.damaged_packets,
                                 " damaged packets were skipped, the first one ", first_damage_));
    if (report_.damaged_frames > 0)
      warnings_.push_back(
          concat(path_, ": ", report_.damaged_frames,
                 " frames were decoded with errors and may repeat parts of the frame "
                 "before, the first one is frame ",
                 first_damaged_frame_));
    if (report_.repaired_timestamps > 0)
      warnings_.push_back(concat(path_, ": ", report_.repaired_timestamps,
                                 " timestamps were missing or not increasing and were replaced"));
  }

  std::string path_;
  FrameSourceOptions options_;
  Demuxer demuxer_;
  Handle<AVCodecContext> decoder_;
  RgbConverter converter_;
  Handle<AVPacket> packet_;
  Handle<AVFrame> frame_;
  PictureSize size_;
  std::int64_t num_decoded_ = 0;
  std::int64_t num_delivered_ = 0;
  double time_ = 0;  // of the last decoded frame
  bool is_draining_ = false;
  int num_draining_errors_ = 0;
  bool is_finished_ = false;
  std::string first_damage_;
  std::int64_t first_damaged_frame_ = 0;
};

}  // namespace
}  // namespace video

std::unique_ptr<FrameSource> open_video(const std::string& path,
                                        const FrameSourceOptions& options) {
  detail::check_options(options);
  return std::make_unique<video::VideoSource>(path, options);
}

}  // namespace lvggt
