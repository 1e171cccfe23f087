// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/frame_features.h"

#include <algorithm>

#include "lvggt/core/float16.h"
#include "lvggt/io/npy.h"
#include "lvggt/language/crops.h"

namespace lvggt {
namespace {

// Pictures of 224 x 224 that are cut out at a time: 16 are 10 MB.
constexpr std::int64_t kBatch = 16;

void fill_rows(View<float, 2> rows, View<const std::int32_t, 2> labels,
               const std::map<std::int32_t, std::int64_t>& row_of) {
  for (std::int64_t y = 0; y < rows.extent(0); ++y)
    for (std::int64_t x = 0; x < rows.extent(1); ++x) {
      const auto found = row_of.find(labels(y, x));
      rows(y, x) = found == row_of.end() ? -1.0f : static_cast<float>(found->second);
    }
}

// The objects of one level, encoded into `features` from row `first` on.
void encode_objects(View<float, 2> features, View<const std::uint8_t, 3> rgb,
                    View<const std::int32_t, 2> labels, const std::vector<ObjectBox>& boxes,
                    const ClipImage& clip, Context& ctx) {
  const auto n = static_cast<std::int64_t>(boxes.size());
  const std::int64_t S = clip.image_size;
  for (std::int64_t begin = 0; begin < n; begin += kBatch) {
    const std::int64_t end = std::min(n, begin + kBatch);
    Tensor<float, 4> pixels(Shape{end - begin, S, S, std::int64_t{3}});
    clip_object_pixels(pixels, rgb, labels, {boxes.begin() + begin, boxes.begin() + end}, ctx);
    clip_image_forward(features.narrow(0, begin, end), pixels, clip, nullptr, ctx);
  }
}

}  // namespace

FrameFeatures make_clip_features(View<const std::uint8_t, 3> rgb,
                                 View<const std::int32_t, 3> labels, const ClipImage& clip,
                                 Context& ctx) {
  const auto [levels, H, W] = labels.shape();
  LVGGT_CHECK(levels == 4 || levels == 1, "clip_features: labels are ", labels.shape(),
              ", expected 4 levels or 1");
  LVGGT_CHECK(rgb.extent(0) == H && rgb.extent(1) == W, "clip_features: the picture is ",
              rgb.shape(), " but its labels are ", labels.shape());
  std::vector<std::vector<ObjectBox>> kept;
  std::int64_t n = 0;
  for (std::int64_t level = 0; level < levels; ++level) {
    std::vector<ObjectBox> boxes = find_objects(labels[level]);
    boxes.erase(std::remove_if(boxes.begin(), boxes.end(),
                               [](const ObjectBox& box) { return box.dropped(); }),
                boxes.end());
    n += static_cast<std::int64_t>(boxes.size());
    kept.push_back(std::move(boxes));
  }
  FrameFeatures result{Tensor<float, 3>(Shape{std::int64_t{4}, H, W}),
                       Tensor<float, 2>(Shape{n, clip.width()})};
  std::int64_t row = 0;
  for (std::int64_t level = 0; level < levels; ++level) {
    const auto& boxes = kept[static_cast<std::size_t>(level)];
    const auto count = static_cast<std::int64_t>(boxes.size());
    encode_objects(result.features.view().narrow(0, row, row + count), rgb, labels[level], boxes,
                   clip, ctx);
    std::map<std::int32_t, std::int64_t> row_of;
    for (const ObjectBox& box : boxes) row_of[box.label] = row++;
    fill_rows(result.rows[level], labels[level], row_of);
  }
  for (std::int64_t level = levels; level < 4; ++level)
    std::copy_n(result.rows[0].data(), H * W, result.rows[level].data());
  for (std::int64_t i = 0; i < result.features.size(); ++i)
    result.features.data()[i] = to_float(to_float16(result.features.data()[i]));
  return result;
}

FrameFeatures make_sentence_features(
    View<const std::int32_t, 3> labels,
    const std::map<std::int32_t, View<const float, 1>>& sentence_of, std::int64_t width) {
  const std::vector<ObjectBox> boxes = find_objects(labels[0]);
  const auto n = static_cast<std::int64_t>(boxes.size());
  FrameFeatures result{Tensor<float, 3>(Shape{std::int64_t{1}, labels.extent(1), labels.extent(2)}),
                       Tensor<float, 2>(Shape{n, width})};
  std::map<std::int32_t, std::int64_t> row_of;
  std::int64_t row = 0;
  for (const ObjectBox& box : boxes) {
    const auto sentence = sentence_of.find(box.label);
    if (sentence != sentence_of.end()) {
      LVGGT_CHECK(sentence->second.extent(0) == width, "sentence_features: the vector of object ",
                  box.label, " is ", sentence->second.shape(), ", expected ", Shape{width});
      std::copy_n(sentence->second.data(), width, result.features[row].data());
    }
    row_of[box.label] = row++;
  }
  fill_rows(result.rows[0], labels[0], row_of);
  return result;
}

Tensor<float, 2> encode_features(View<const float, 2> features, const Autoencoder& autoencoder,
                                 Context& ctx) {
  const auto [n, D] = features.shape();
  LVGGT_CHECK(autoencoder.has_encoder(), "the autoencoder has a decoder only");
  LVGGT_CHECK(D == autoencoder.feature_width(), "the features have ", D,
              " numbers, but the autoencoder takes ", autoencoder.feature_width());
  Tensor<float, 2> codes(Shape{n, autoencoder.code_width()});
  if (n > 0) autoencoder.encode(codes, features, ctx);
  for (std::int64_t i = 0; i < n; ++i) {
    const float* row = features[i].data();
    if (std::all_of(row, row + D, [](float v) { return v == 0; }))
      std::fill_n(codes[i].data(), codes.extent(1), 0.0f);
  }
  return codes;
}

void write_features(const std::string& stem, View<const float, 3> rows,
                    View<const float, 2> features, bool in_double) {
  if (in_double) {
    Tensor<double, 2> wide(features.shape());
    for (std::int64_t i = 0; i < features.extent(0); ++i)
      std::copy_n(features[i].data(), features.extent(1), wide[i].data());
    write_npy(stem + "_f.npy", wide);
  } else {
    write_npy(stem + "_f.npy", features);
  }
  write_npy(stem + "_s.npy", rows);
}

}  // namespace lvggt
