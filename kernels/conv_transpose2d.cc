// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/conv_transpose2d.h"

#include "kernels/pack.h"
#include "kernels/product.h"

namespace lvggt {

PackedConvTranspose2d pack_conv_transpose2d(View<const float, 4> weight, Storage storage) {
  const auto [Cin, Cout, kernel, kernel_x] = weight.shape();
  LVGGT_CHECK(kernel == kernel_x, "conv_transpose2d: weight ", weight.shape(),
              " does not have a square kernel");
  PackedConvTranspose2d packed{Cin, Cout, kernel, {}};
  for (std::int64_t ky = 0; ky < kernel; ++ky) {
    for (std::int64_t kx = 0; kx < kernel; ++kx) {
      PackedMatrix place = kernels::empty_matrix(Cout, 1, Cin, storage);
      for (std::int64_t n = 0; n < Cout; ++n) {
        for (std::int64_t c = 0; c < Cin; ++c)
          kernels::set_weight(place, n, c, weight(c, n, ky, kx));
      }
      packed.places.push_back(std::move(place));
    }
  }
  return packed;
}

PackedConvTranspose2d pack_conv_transpose2d(View<const float, 4> weight, Context& ctx) {
  const auto [Cin, Cout, kernel, kernel_x] = weight.shape();
  LVGGT_CHECK(kernel == kernel_x && weight.dense(), "conv_transpose2d: weight ", weight.shape(),
              " does not have a square kernel, or has gaps");
  const std::int64_t places = kernel * kernel;
  PackedConvTranspose2d packed{Cin, Cout, kernel, {}};
  for (std::int64_t place = 0; place < places; ++place)
    packed.places.push_back(
        kernels::pack_strided(weight.data(), Cout, places, Cin, Cout * places, {&place, 1}, ctx));
  return packed;
}

void conv_transpose2d_forward(View<float, 4> y, View<const float, 4> x,
                              const PackedConvTranspose2d& w, View<const float, 1> bias,
                              Context& ctx) {
  const std::int64_t B = x.extent(0), H = x.extent(1), W = x.extent(2), k = w.kernel;
  LVGGT_CHECK(x.extent(3) == w.in_channels, "conv_transpose2d: x is ", x.shape(),
              " but the weight reads ", w.in_channels, " channels");
  const Shape expected{B, k * H, k * W, w.out_channels};
  LVGGT_CHECK(y.shape() == expected, "conv_transpose2d: y is ", y.shape(), " but x ", x.shape(),
              " gives ", expected);
  LVGGT_CHECK(bias.empty() || bias.extent(0) == w.out_channels, "conv_transpose2d: bias is ",
              bias.shape(), " but y is ", y.shape());
  for (std::int64_t ky = 0; ky < k; ++ky) {
    for (std::int64_t kx = 0; kx < k; ++kx) {
      const PackedMatrix& place = w.places[static_cast<std::size_t>(ky * k + kx)];
      const kernels::Product product{B * H * W,         &place,  1,    w.in_channels, bias.data(),
                                     Activation::kNone, nullptr, false};
      kernels::run_product(
          product,
          [&](const kernels::RowTable& table) {
            for (std::int64_t r = 0; r < table.count; ++r) {
              const std::int64_t m = table.begin + r;
              const std::int64_t j = m % W, i = m / W % H, b = m / W / H;
              table.x[r] = x.data() + b * x.stride(0) + i * x.stride(1) + j * x.stride(2);
              table.y[r] = y.data() + b * y.stride(0) + (k * i + ky) * y.stride(1) +
                           (k * j + kx) * y.stride(2);
            }
          },
          ctx);
    }
  }
}

}  // namespace lvggt
