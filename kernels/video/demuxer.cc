// SPDX-License-Identifier: Apache-2.0
#include "kernels/video/demuxer.h"

extern "C" {
#include <libavutil/display.h>
#include <libavutil/mem.h>
}

#include <algorithm>
#include <array>
#include <cmath>
#include <string_view>

#include "lvggt/io/image.h"
#include "lvggt/io/input_file.h"

namespace lvggt::video {

namespace {

// Containers that hold their data themselves. Playlists, scripts and image sequences, which name
// other files, are not among them.
constexpr const char* kContainers =
    "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,mpegts,mpeg,mpegvideo,flv,asf,ogg,ivf,h264,hevc,m4v,"
    "obu,av1,"
    "yuv4mpegpipe,dv,mxf,nut,mjpeg";

// The library must not print, and FFmpeg's own messages go to stderr by default. A host program
// that has chosen a level keeps it; one with its own log callback gets everything in any case.
void silence_default_log() {
  if (av_log_get_level() == AV_LOG_INFO) av_log_set_level(AV_LOG_QUIET);
}

// A regular file that is not a picture or a playlist; returns its first bytes.
std::string check_file(const std::string& path) {
  const InputFile file(path);
  if (file.size() == 0) fail(ErrorKind::kFormat, path, ": is empty, expected a video");
  std::string head(static_cast<std::size_t>(std::min<std::int64_t>(file.size(), 1024)), '\0');
  file.read_at(0, head.data(), head.size());
  const FileGuess guess =
      guess_file(std::as_bytes(std::span(head)).first(std::min<std::size_t>(head.size(), 64)));
  if (guess.kind == FileKind::kPlaylist)
    fail(ErrorKind::kUnsupported, path, ": is ", guess.name,
         ", which names other files; give the video file itself");
  if (guess.kind == FileKind::kUnsupportedImage)
    fail(ErrorKind::kUnsupported, path, ": is a ", guess.name, " image, expected a video");
  return head;
}

// "2 audio, 1 cover picture"; for files without video.
std::string describe_streams(const AVFormatContext& format) {
  int num_audio = 0, num_cover = 0, num_other = 0;
  for (unsigned i = 0; i < format.nb_streams; ++i) {
    const AVMediaType type = format.streams[i]->codecpar->codec_type;
    ++(type == AVMEDIA_TYPE_AUDIO ? num_audio : type == AVMEDIA_TYPE_VIDEO ? num_cover : num_other);
  }
  std::string text;
  const auto add = [&](int count, const char* what) {
    if (count > 0) text += concat(text.empty() ? "" : ", ", count, " ", what);
  };
  add(num_audio, "audio");
  add(num_cover, "cover picture");
  add(num_other, "other");
  return text.empty() ? "none at all" : text;
}

bool is_video(const AVStream& stream) {
  return stream.codecpar->codec_type == AVMEDIA_TYPE_VIDEO &&
         !(stream.disposition & AV_DISPOSITION_ATTACHED_PIC);
}

// Claims beyond the limit or beyond one frame a byte are not worth repeating.
std::int64_t believable_frames(const AVFormatContext& format, const AVStream& stream,
                               const Limits& limits) {
  double claim = static_cast<double>(stream.nb_frames);
  const double rate = av_q2d(stream.avg_frame_rate);
  if (claim <= 0 && rate > 0 && std::isfinite(rate)) {
    if (stream.duration > 0)
      claim = static_cast<double>(stream.duration) * av_q2d(stream.time_base) * rate;
    else if (format.duration > 0 &&
             format.duration_estimation_method != AVFMT_DURATION_FROM_BITRATE)
      claim = static_cast<double>(format.duration) / AV_TIME_BASE * rate;
  }
  const std::int64_t file_size = format.pb ? avio_size(format.pb) : 0;
  const bool is_believable = claim >= 1 && claim <= static_cast<double>(limits.video_frames) &&
                             (file_size <= 0 || claim <= static_cast<double>(file_size));
  return is_believable ? std::llround(claim) : -1;
}

}  // namespace

Demuxer::Demuxer(const std::string& path, const Limits& limits,
                 std::vector<std::string>& warnings) {
  silence_default_log();
  open(path);
  choose_stream(path, warnings);
  read_orientation(path, warnings);
  claimed_frames_ = believable_frames(*format_, *stream_, limits);
}

void Demuxer::open(const std::string& path) {
  const std::string head = check_file(path);
  AVFormatContext* context = allocated(avformat_alloc_context()).release();
  context->protocol_whitelist = av_strdup("file");
  context->format_whitelist = av_strdup(kContainers);
  // With the protocol in front nothing in the name can be taken for another one.
  const int opened = avformat_open_input(&context, ("file:" + path).c_str(), nullptr, nullptr);
  if (opened == AVERROR(EINVAL))
    fail(ErrorKind::kUnsupported, path,
         ": its container format is not supported; MP4, MOV, Matroska, "
         "WebM, AVI and MPEG are");
  if (opened == AVERROR_EOF)
    fail(ErrorKind::kFormat, path, ": the video ends before its first frame");
  if (opened < 0) {
    const std::string hint = content_hint(head);
    fail(ErrorKind::kFormat, path, ": cannot be read as a video: ", error_text(opened),
         hint.empty() ? "" : "; ", hint);
  }
  format_.reset(context);
  const int analysed = avformat_find_stream_info(format_.get(), nullptr);
  if (analysed < 0)
    fail(ErrorKind::kFormat, path, ": its streams cannot be read: ", error_text(analysed));
}

void Demuxer::choose_stream(const std::string& path, std::vector<std::string>& warnings) {
  int num_video = 0;
  for (unsigned i = 0; i < format_->nb_streams; ++i) {
    if (!is_video(*format_->streams[i])) continue;
    if (num_video++ == 0) stream_ = format_->streams[i];
  }
  if (!stream_)
    fail(ErrorKind::kFormat, path,
         ": has no video stream; its streams: ", describe_streams(*format_));
  if (num_video > 1)
    warnings.push_back(concat(path, ": has ", num_video, " video streams, the first one (stream ",
                              stream_->index, ") is used"));
}

void Demuxer::read_orientation(const std::string& path, std::vector<std::string>& warnings) {
  std::size_t size = 0;
  const std::uint8_t* data = av_stream_get_side_data(stream_, AV_PKT_DATA_DISPLAYMATRIX, &size);
  if (!data || size < 9 * sizeof(std::int32_t)) return;
  // Columns map the stored x and y axes (16.16 fixed point, y down) to the shown ones.
  std::array<std::int32_t, 9> m;
  std::copy_n(data, sizeof(m), reinterpret_cast<std::uint8_t*>(m.data()));
  const bool straight = m[1] == 0 && m[3] == 0 && m[0] != 0 && m[4] != 0;
  const bool crossed = m[0] == 0 && m[4] == 0 && m[1] != 0 && m[3] != 0;
  if (straight) {
    orientation_ = {false, m[0] < 0, m[4] < 0};
  } else if (crossed) {
    orientation_ = {true, m[3] < 0, m[1] < 0};
  } else {
    warnings.push_back(
        concat(path, ": is to be shown turned by ", av_display_rotation_get(m.data()),
               " degrees; only quarter turns are applied, so it is taken as stored"));
  }
}

bool Demuxer::read(AVPacket& packet) {
  // A demuxer that asks again without end would hang the caller.
  constexpr int kMaxRetries = 1000;
  for (int retries = 0; retries < kMaxRetries;) {
    const int result = av_read_frame(format_.get(), &packet);
    if (result == AVERROR(EAGAIN)) {
      ++retries;
      continue;
    }
    if (result < 0) {
      read_error_ = result;
      return false;
    }
    const AVStream& stream = *format_->streams[packet.stream_index];
    const std::int64_t time = packet.pts != AV_NOPTS_VALUE ? packet.pts : packet.dts;
    if (time != AV_NOPTS_VALUE)
      end_time_ =
          std::max(end_time_, (static_cast<double>(time) + static_cast<double>(packet.duration)) *
                                  av_q2d(stream.time_base));
    if (packet.stream_index == stream_->index) {
      ++num_packets_;
      return true;
    }
    av_packet_unref(&packet);
  }
  read_error_ = AVERROR(EAGAIN);
  return false;
}

std::string Demuxer::missing_end() const {
  if (read_error_ != AVERROR_EOF) return error_text(read_error_);
  // MP4 lists every packet in advance (an edit list may leave some out, so nb_frames is not that
  // list).
  const bool is_mov = std::string_view(format_->iformat->name).starts_with("mov");
  const std::int64_t num_listed = avformat_index_get_entries_count(stream_);
  if (is_mov && num_packets_ < num_listed)
    return concat("it lists ", num_listed, " packets, but has ", num_packets_);
  // Three frames or 2 % cover what containers leave unsaid about the last packet's length.
  constexpr double kUsualRate = 25;
  const double rate = av_q2d(stream_->avg_frame_rate);
  const double three_frames = 3 / (rate > 0 && std::isfinite(rate) ? rate : kUsualRate);
  if (is_mov || format_->duration <= 0 ||
      format_->duration_estimation_method == AVFMT_DURATION_FROM_BITRATE)
    return {};
  const double claimed = static_cast<double>(format_->duration) / AV_TIME_BASE;
  const double start = format_->start_time == AV_NOPTS_VALUE
                           ? 0
                           : static_cast<double>(format_->start_time) / AV_TIME_BASE;
  if (end_time_ - start >= claimed - std::max(three_frames, 0.02 * claimed)) return {};
  return concat("it claims ", claimed, " seconds, but has ", end_time_ - start);
}

}  // namespace lvggt::video
