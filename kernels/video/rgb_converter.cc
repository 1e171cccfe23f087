// SPDX-License-Identifier: Apache-2.0
#include "kernels/video/rgb_converter.h"

extern "C" {
#include <libavutil/pixdesc.h>
}

#include <cmath>

namespace lvggt::video {

namespace {

// Pixels more elongated than this are taken for a mistake in the file.
constexpr double kMaxAspect = 16;

// The formats that carry the range in their name are deprecated in favour of AVFrame::color_range.
AVPixelFormat without_range(AVPixelFormat format) {
  switch (format) {
    case AV_PIX_FMT_YUVJ411P:
      return AV_PIX_FMT_YUV411P;
    case AV_PIX_FMT_YUVJ420P:
      return AV_PIX_FMT_YUV420P;
    case AV_PIX_FMT_YUVJ422P:
      return AV_PIX_FMT_YUV422P;
    case AV_PIX_FMT_YUVJ440P:
      return AV_PIX_FMT_YUV440P;
    case AV_PIX_FMT_YUVJ444P:
      return AV_PIX_FMT_YUV444P;
    default:
      return format;
  }
}

bool is_full_range(const AVFrame& frame) {
  const auto format = static_cast<AVPixelFormat>(frame.format);
  return frame.color_range == AVCOL_RANGE_JPEG || without_range(format) != format;
}

// BT.709 is what high definition uses, BT.601 what came before; files often leave it at that.
int matrix_of(const AVFrame& frame) {
  if (frame.colorspace != AVCOL_SPC_UNSPECIFIED && frame.colorspace != AVCOL_SPC_RGB)
    return frame.colorspace;
  return frame.height >= 720 ? SWS_CS_ITU709 : SWS_CS_ITU601;
}

}  // namespace

AVRational RgbConverter::aspect_of(const AVFrame& frame) const {
  AVRational aspect = frame.sample_aspect_ratio.num > 0 ? frame.sample_aspect_ratio : pixel_aspect_;
  const double ratio = aspect.num > 0 && aspect.den > 0 ? av_q2d(aspect) : 0;
  if (ratio < 1 / kMaxAspect || ratio > kMaxAspect) aspect = {1, 1};
  return aspect;
}

// Only ever enlarges, so that no detail is lost.
PictureSize RgbConverter::stretched_size(const AVFrame& frame) const {
  const double aspect = av_q2d(aspect_of(frame));
  PictureSize size{frame.width, frame.height};
  if (aspect > 1) size.width = std::llround(static_cast<double>(size.width) * aspect);
  if (aspect < 1) size.height = std::llround(static_cast<double>(size.height) / aspect);
  return size;
}

PictureSize RgbConverter::size_of(const AVFrame& frame) const {
  const PictureSize size = stretched_size(frame);
  return orientation_.transpose ? PictureSize{size.height, size.width} : size;
}

Image RgbConverter::convert(const AVFrame& frame) {
  const PictureSize size = stretched_size(frame);
  // Accurate and the same on every processor, rather than the fastest of each.
  constexpr int kFlags = SWS_BICUBIC | SWS_ACCURATE_RND | SWS_FULL_CHR_H_INT | SWS_BITEXACT;
  scaler_.reset(sws_getCachedContext(scaler_.release(), frame.width, frame.height,
                                     without_range(static_cast<AVPixelFormat>(frame.format)),
                                     static_cast<int>(size.width), static_cast<int>(size.height),
                                     AV_PIX_FMT_RGB24, kFlags, nullptr, nullptr, nullptr));
  if (!scaler_)
    fail(ErrorKind::kUnsupported, name_, ": pixels of the format ",
         av_get_pix_fmt_name(static_cast<AVPixelFormat>(frame.format)),
         " cannot be converted to RGB");
  constexpr int kUnchanged = 1 << 16;
  sws_setColorspaceDetails(scaler_.get(), sws_getCoefficients(matrix_of(frame)),
                           is_full_range(frame), sws_getCoefficients(SWS_CS_DEFAULT), 1, 0,
                           kUnchanged, kUnchanged);

  // The scaler may write up to a vector beyond the end of a row.
  const std::int64_t stride = (size.width * 3 + 127) / 64 * 64;
  if (rows_.size() != stride * size.height)
    rows_ = Tensor<std::uint8_t, 1>(Shape{stride * size.height});
  std::uint8_t* const planes[] = {rows_.data()};
  const int strides[] = {static_cast<int>(stride)};
  const int num_rows =
      sws_scale(scaler_.get(), frame.data, frame.linesize, 0, frame.height, planes, strides);
  if (num_rows != size.height)
    fail(ErrorKind::kFormat, name_, ": the pixels cannot be converted: ", error_text(num_rows));
  const View<const std::uint8_t, 3> picture(
      rows_.data(), Shape{size.height, size.width, std::int64_t{3}}, {stride, 3, 1});
  return {detail::reoriented(picture, orientation_), {}};
}

std::vector<std::string> RgbConverter::remarks(const AVFrame& frame) const {
  std::vector<std::string> remarks;
  if (frame.interlaced_frame) remarks.push_back("is interlaced; the fields are not separated");
  if (frame.color_trc == AVCOL_TRC_SMPTE2084 || frame.color_trc == AVCOL_TRC_ARIB_STD_B67)
    remarks.push_back(concat("has high dynamic range (", av_color_transfer_name(frame.color_trc),
                             "); its values are used without tone mapping"));
  const PictureSize stretched = stretched_size(frame);
  if (stretched != PictureSize{frame.width, frame.height})
    remarks.push_back(concat("has pixels that are not square; ", frame.width, "x", frame.height,
                             " is stretched to ", stretched.width, "x", stretched.height));
  return remarks;
}

}  // namespace lvggt::video
