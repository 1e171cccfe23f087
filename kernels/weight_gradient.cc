// SPDX-License-Identifier: Apache-2.0
#include "kernels/weight_gradient.h"

#include <vector>

#include "lvggt/core/parallel.h"

namespace lvggt::kernels {

void weight_gradient(View<float, 4> dweight, View<const float, 4> dy, View<const float, 4> x,
                     std::int64_t stride, std::int64_t padding, Context& ctx) {
  const std::int64_t Cout = dweight.extent(0), Cin = dweight.extent(1), k = dweight.extent(2);
  const std::int64_t B = dy.extent(0), Ho = dy.extent(1), Wo = dy.extent(2);
  parallel_chunks(
      Cout,
      [&](std::int64_t co, int) {
        std::vector<float> sums(static_cast<std::size_t>(k * k * Cin));
        for (std::int64_t n = 0; n < B * Ho * Wo; ++n) {
          const std::int64_t j = n % Wo, i = n / Wo % Ho, b = n / Wo / Ho;
          const float g = dy(b, i, j, co);
          for (std::int64_t t = 0; t < k * k; ++t) {
            const std::int64_t h = i * stride + t / k - padding, w = j * stride + t % k - padding;
            if (h < 0 || h >= x.extent(1) || w < 0 || w >= x.extent(2)) continue;
            const float* row = &x(b, h, w, std::int64_t{0});
            for (std::int64_t c = 0; c < Cin; ++c)
              sums[static_cast<std::size_t>(t * Cin + c)] += g * row[c];
          }
        }
        for (std::int64_t t = 0; t < k * k; ++t)
          for (std::int64_t c = 0; c < Cin; ++c)
            dweight(co, c, t / k, t % k) += sums[static_cast<std::size_t>(t * Cin + c)];
      },
      ctx);
}

void bias_gradient(View<float, 1> dbias, View<const float, 4> dy, Context&) {
  std::vector<double> sums(static_cast<std::size_t>(dy.extent(3)));
  for (std::int64_t b = 0; b < dy.extent(0); ++b)
    for (std::int64_t i = 0; i < dy.extent(1); ++i)
      for (std::int64_t j = 0; j < dy.extent(2); ++j)
        for (std::int64_t c = 0; c < dy.extent(3); ++c)
          sums[static_cast<std::size_t>(c)] += dy(b, i, j, c);
  for (std::int64_t c = 0; c < dy.extent(3); ++c)
    dbias[c] += static_cast<float>(sums[static_cast<std::size_t>(c)]);
}

}  // namespace lvggt::kernels
