// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "kernels/io/orientation.h"
#include "kernels/video/ffmpeg_handles.h"
#include "lvggt/io/limits.h"

namespace lvggt::video {

// The first video stream of a file, packet by packet.
class Demuxer {
 public:
  // Appends what the user should know about the file to `warnings`.
  Demuxer(const std::string& path, const Limits& limits, std::vector<std::string>& warnings);

  // The next packet of the stream; false at the end of the file or where it cannot be read further.
  bool read(AVPacket& packet);

  AVFormatContext& format() const { return *format_; }
  AVStream& stream() const { return *stream_; }

  // How decoded pictures must be laid to be upright.
  detail::Orientation orientation() const { return orientation_; }

  // Frames that the file claims to have, -1 if it does not say or cannot be believed.
  std::int64_t claimed_frames() const { return claimed_frames_; }

  // After read() has returned false: why the file ends before it should, empty if it does not.
  std::string missing_end() const;

 private:
  void open(const std::string& path);
  void choose_stream(const std::string& path, std::vector<std::string>& warnings);
  void read_orientation(const std::string& path, std::vector<std::string>& warnings);

  Handle<AVFormatContext> format_;
  AVStream* stream_ = nullptr;
  detail::Orientation orientation_;
  std::int64_t claimed_frames_ = -1;
  std::int64_t num_packets_ = 0;  // of the stream
  double end_time_ = 0;           // seconds: where the last packet of any stream ends
  int read_error_ = AVERROR_EOF;  // why reading stopped
};

}  // namespace lvggt::video
