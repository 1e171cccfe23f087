// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <vector>

#include "lvggt/io/preprocess.h"

namespace lvggt {

namespace {

// Weights are integers of 22 fractional bits: 32 less 8 for the sample and 2 for the sum's
// overshoot.
constexpr int kWeightBits = 32 - 8 - 2;

double cubic(double x) {
  constexpr double a = -0.5;
  x = std::abs(x);
  if (x < 1) return ((a + 2) * x - (a + 3)) * x * x + 1;
  if (x < 2) return (((x - 5) * x + 8) * x - 4) * a;
  return 0;
}

// For each output position: the first input position it reads, and the weights of that and the next
// ones.
struct Taps {
  std::int64_t per_output = 0;        // stride of weights
  std::vector<std::int64_t> begin;    // [outputs]
  std::vector<std::int64_t> count;    // [outputs]
  std::vector<std::int32_t> weights;  // [outputs, per_output]
};

// Outputs [begin, end) of a resize from `from` to `to` samples. When shrinking, the filter is
// widened by the factor, which is what antialiases.
Taps make_taps(std::int64_t from, std::int64_t to, std::int64_t begin, std::int64_t end) {
  const double scale = static_cast<double>(from) / static_cast<double>(to);
  const double filter_scale = std::max(scale, 1.0);
  const double support = 2.0 * filter_scale;
  Taps taps;
  taps.per_output = static_cast<std::int64_t>(std::ceil(support)) * 2 + 1;
  taps.weights.resize(static_cast<std::size_t>((end - begin) * taps.per_output));
  std::vector<double> w(static_cast<std::size_t>(taps.per_output));
  for (std::int64_t i = begin; i < end; ++i) {
    const double center = (static_cast<double>(i) + 0.5) * scale;
    const auto first = std::max<std::int64_t>(static_cast<std::int64_t>(center - support + 0.5), 0);
    const auto last = std::min(static_cast<std::int64_t>(center + support + 0.5), from);
    double sum = 0;
    for (std::int64_t k = 0; k < last - first; ++k) {
      const double x = (static_cast<double>(k + first) - center + 0.5) * (1.0 / filter_scale);
      sum += w[static_cast<std::size_t>(k)] = cubic(x);
    }
    std::int32_t* out = taps.weights.data() + (i - begin) * taps.per_output;
    for (std::int64_t k = 0; k < last - first; ++k) {
      const double weight = w[static_cast<std::size_t>(k)] / sum * (1 << kWeightBits);
      out[k] = static_cast<std::int32_t>(weight < 0 ? weight - 0.5 : weight + 0.5);
    }
    taps.begin.push_back(first);
    taps.count.push_back(last - first);
  }
  return taps;
}

std::uint8_t to_sample(std::int32_t sum) {
  return static_cast<std::uint8_t>(std::clamp(sum >> kWeightBits, 0, 255));
}

constexpr std::int32_t kHalf = 1 << (kWeightBits - 1);

// Rows [begin, end) of the picture, resized along x.
Tensor<std::uint8_t, 3> resize_rows(View<const std::uint8_t, 3> image, std::int64_t width,
                                    std::int64_t begin, std::int64_t end) {
  const Taps taps = make_taps(image.extent(1), width, 0, width);
  Tensor<std::uint8_t, 3> result(Shape{end - begin, width, std::int64_t{3}});
  std::uint8_t* out = result.data();
  for (std::int64_t y = begin; y < end; ++y) {
    const std::uint8_t* row = image.data() + y * image.stride(0);
    const std::int32_t* weights = taps.weights.data();
    for (std::int64_t x = 0; x < width; ++x, out += 3, weights += taps.per_output) {
      const std::uint8_t* in = row + taps.begin[static_cast<std::size_t>(x)] * 3;
      const std::int64_t count = taps.count[static_cast<std::size_t>(x)];
      std::int32_t r = kHalf, g = kHalf, b = kHalf;
      for (std::int64_t k = 0; k < count; ++k, in += 3) {
        r += in[0] * weights[k];
        g += in[1] * weights[k];
        b += in[2] * weights[k];
      }
      out[0] = to_sample(r);
      out[1] = to_sample(g);
      out[2] = to_sample(b);
    }
  }
  return result;
}

// The outputs that `taps` describes, along y; `first_row` is the position of rows[0] in the whole
// picture.
Tensor<std::uint8_t, 3> resize_columns(View<const std::uint8_t, 3> rows, const Taps& taps,
                                       std::int64_t first_row) {
  const std::int64_t row_size = rows.extent(1) * 3;
  const auto num_outputs = static_cast<std::int64_t>(taps.begin.size());
  Tensor<std::uint8_t, 3> result(Shape{num_outputs, rows.extent(1), std::int64_t{3}});
  std::vector<std::int32_t> sums(static_cast<std::size_t>(row_size));
  for (std::int64_t y = 0; y < num_outputs; ++y) {
    std::fill(sums.begin(), sums.end(), kHalf);
    const std::int64_t begin = taps.begin[static_cast<std::size_t>(y)] - first_row;
    for (std::int64_t k = 0; k < taps.count[static_cast<std::size_t>(y)]; ++k) {
      const std::int32_t weight = taps.weights[static_cast<std::size_t>(y * taps.per_output + k)];
      const std::uint8_t* in = rows.data() + (begin + k) * rows.stride(0);
      std::int32_t* sum = sums.data();
      for (std::int64_t x = 0; x < row_size; ++x) sum[x] += in[x] * weight;
    }
    std::transform(sums.begin(), sums.end(), result.data() + y * row_size, to_sample);
  }
  return result;
}

}  // namespace

Tensor<std::uint8_t, 3> resize_bicubic(View<const std::uint8_t, 3> image, std::int64_t width,
                                       std::int64_t height, std::int64_t row_begin,
                                       std::int64_t row_end) {
  LVGGT_CHECK(
      image.extent(0) > 0 && image.extent(1) > 0 && image.extent(2) == 3 && image.stride(1) == 3,
      "resize_bicubic: image is ", image.shape(), ", expected rows of [H, W, 3]");
  LVGGT_CHECK(width > 0 && 0 <= row_begin && row_begin < row_end && row_end <= height,
              "resize_bicubic: rows ", row_begin, " to ", row_end, " of ", width, "x", height,
              " do not exist");
  // Pillow leaves out a pass that changes nothing; with the same size the taps would be the
  // identity.
  const Taps vertical = make_taps(image.extent(0), height, row_begin, row_end);
  const std::int64_t first_row = vertical.begin.front();
  const std::int64_t last_row = vertical.begin.back() + vertical.count.back();
  return resize_columns(resize_rows(image, width, first_row, last_row), vertical, first_row);
}

}  // namespace lvggt
