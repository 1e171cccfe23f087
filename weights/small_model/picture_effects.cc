// SPDX-License-Identifier: Apache-2.0
#include "weights/small_model/picture_effects.h"

#include <algorithm>

namespace small_model {
namespace {

// Along one axis of [outer, n, inner * 3] with clamped ends.
void blur_axis(std::vector<float>& rgb, int n, int stride, int lines, int line_stride,
               const std::vector<float>& kernel) {
  const int reach = static_cast<int>(kernel.size()) / 2;
  std::vector<float> line(static_cast<std::size_t>(n));
  for (int l = 0; l < lines; ++l) {
    for (int c = 0; c < 3; ++c) {
      float* at = rgb.data() + l * line_stride + c;
      for (int i = 0; i < n; ++i) line[static_cast<std::size_t>(i)] = at[i * stride];
      for (int i = 0; i < n; ++i) {
        float sum = 0;
        for (int k = -reach; k <= reach; ++k)
          sum += kernel[static_cast<std::size_t>(k + reach)] *
                 line[static_cast<std::size_t>(std::clamp(i + k, 0, n - 1))];
        at[i * stride] = sum;
      }
    }
  }
}

void blur(Picture& picture, float sigma) {
  if (sigma < 0.2f) return;
  const int reach = static_cast<int>(std::ceil(2.5f * sigma));
  std::vector<float> kernel;
  float sum = 0;
  for (int k = -reach; k <= reach; ++k) {
    const float d = static_cast<float>(k) / sigma;
    kernel.push_back(std::exp(-0.5f * d * d));
    sum += kernel.back();
  }
  for (float& weight : kernel) weight /= sum;
  const int row = 3 * picture.width;
  blur_axis(picture.rgb, picture.width, 3, picture.height, row, kernel);
  blur_axis(picture.rgb, picture.height, row, picture.width, 3, kernel);
}

}  // namespace

void take_picture(Picture& picture, const Look& look, std::uint64_t noise_seed) {
  double total = 0;
  for (const float value : picture.rgb) total += std::min(value, 4.0f);
  const double mean = std::max(1e-4, total / static_cast<double>(picture.rgb.size()));
  // In linear light; the tone curve below brings the mean near `brightness`.
  const float exposure = std::pow(look.brightness, look.gamma) / static_cast<float>(mean) * 1.25f;
  for (int y = 0; y < picture.height; ++y) {
    for (int x = 0; x < picture.width; ++x) {
      const float u = 2 * static_cast<float>(x) / static_cast<float>(picture.width) - 1;
      const float v = 2 * static_cast<float>(y) / static_cast<float>(picture.height) - 1;
      const float dim = exposure * (1 - look.vignette * 0.5f * (u * u + v * v));
      float* pixel = picture.rgb.data() + 3 * (y * picture.width + x);
      for (int c = 0; c < 3; ++c) pixel[c] *= dim * look.tint[c];
    }
  }
  blur(picture, look.blur * static_cast<float>(picture.width) / 84);
  Random random(noise_seed);
  for (float& value : picture.rgb) {
    const float toned = 1.3f * value / (1 + 0.3f * value);  // highlights roll off
    float shown = std::pow(std::max(toned, 0.0f), 1 / look.gamma);
    shown = 0.5f + look.contrast * (shown - 0.5f) + look.noise * random.normal();
    value = std::round(std::clamp(shown, 0.0f, 1.0f) * 255) / 255;
  }
}

}  // namespace small_model
