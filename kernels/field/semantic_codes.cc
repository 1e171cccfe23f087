// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/semantic_codes.h"

#include <algorithm>
#include <cmath>
#include <span>

#include "lvggt/io/safetensors.h"
#include "lvggt/kernels/elementwise.h"

namespace lvggt {
namespace {

constexpr const char* kTensor = "codes";
constexpr float kLargestHalf = 65504;

std::string joined(const std::vector<std::string>& words) {
  std::string text;
  for (const std::string& word : words) text += (text.empty() ? "" : " ") + word;
  return text;
}

// The metadata of a frame's file.
std::vector<std::pair<std::string, std::string>> metadata(const CodesFormat& format,
                                                          std::int64_t frame) {
  return {{"format_version", "1"},
          {"levels", joined(format.levels)},
          {"frame", std::to_string(frame)},
          {"decoder_sha256", format.decoder_sha256}};
}

}  // namespace

void write_codes(const std::string& path, View<const float, 4> codes, const CodesFormat& format,
                 std::int64_t frame) {
  LVGGT_CHECK(codes.shape() == format.shape() && codes.dense(), path, ": codes are ", codes.shape(),
              ", expected dense ", format.shape());
  const std::span<const float> values(codes.data(), static_cast<std::size_t>(codes.size()));
  for (const float value : values)
    if (!(std::abs(value) <= kLargestHalf))
      fail(ErrorKind::kNumeric, path, ": the decoder gives ", value,
           ", which half precision cannot hold");
  SafetensorsWriter out(path);
  for (const auto& [key, value] : metadata(format, frame)) out.set_metadata(key, value);
  const auto& extents = codes.shape().extents;
  out.declare(kTensor, Dtype::kF16, {extents.begin(), extents.end()});
  out.write(kTensor, values);
  out.finish();
}

void read_codes(View<float, 4> codes, const std::string& path, const CodesFormat& format,
                std::int64_t frame) {
  const Safetensors file = Safetensors::open(path);
  for (const auto& [key, wanted] : metadata(format, frame)) {
    const auto found = file.metadata().find(key);
    LVGGT_CHECK(found != file.metadata().end(), path, ": is no file of semantic codes: its ",
                "metadata have no ", key);
    LVGGT_CHECK(found->second == wanted, path, ": its ", key, " is \"", found->second,
                "\", but the field says \"", wanted, "\"");
  }
  LVGGT_CHECK(codes.shape() == format.shape() && codes.dense(), path, ": read into ", codes.shape(),
              " but codes are ", format.shape());
  const TensorEntry& entry = file.at(kTensor);
  const auto& extents = codes.shape().extents;
  LVGGT_CHECK(std::equal(entry.shape.begin(), entry.shape.end(), extents.begin(), extents.end()),
              path, ": codes are ", shape_text(entry.shape), ", but the field says ",
              codes.shape());
  file.read_into(kTensor, std::span<float>(codes.data(), static_cast<std::size_t>(codes.size())));
  const std::int64_t at = find_nonfinite(codes.reshaped(Shape{codes.size()}));
  if (at >= 0)
    fail(ErrorKind::kNumeric, path, ": code value ", at, " is ", codes.data()[at],
         ", not a finite number");
}

}  // namespace lvggt
