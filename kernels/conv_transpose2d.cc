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

namespace {

// place(ky, kx): the packed weights of one of the k x k places.
template <class Place>
void run_places(View<float, 4> y, View<const float, 4> x, std::int64_t in_channels,
                std::int64_t out_channels, std::int64_t k, View<const float, 1> bias,
                const Place& place, Context& ctx) {
  const std::int64_t B = x.extent(0), H = x.extent(1), W = x.extent(2);
  LVGGT_CHECK(x.extent(3) == in_channels, "conv_transpose2d: x is ", x.shape(),
              " but the weight reads ", in_channels, " channels");
  const Shape expected{B, k * H, k * W, out_channels};
  LVGGT_CHECK(y.shape() == expected, "conv_transpose2d: y is ", y.shape(), " but x ", x.shape(),
              " gives ", expected);
  LVGGT_CHECK(bias.empty() || bias.extent(0) == out_channels, "conv_transpose2d: bias is ",
              bias.shape(), " but y is ", y.shape());
  for (std::int64_t ky = 0; ky < k; ++ky) {
    for (std::int64_t kx = 0; kx < k; ++kx) {
      const kernels::Product product{B * H * W,   place(ky, kx),     1,       in_channels,
                                     bias.data(), Activation::kNone, nullptr, false};
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

}  // namespace

void conv_transpose2d_forward(View<float, 4> y, View<const float, 4> x,
                              const PackedConvTranspose2d& w, View<const float, 1> bias,
                              Context& ctx) {
  const auto place = [&](std::int64_t ky, std::int64_t kx) -> const PackedMatrix& {
    return w.places[static_cast<std::size_t>(ky * w.kernel + kx)];
  };
  run_places(y, x, w.in_channels, w.out_channels, w.kernel, bias, place, ctx);
}

void conv_transpose2d_forward(View<float, 4> y, View<const float, 4> x, View<const float, 4> weight,
                              View<const float, 1> bias, Context& ctx) {
  LVGGT_CHECK(weight.extent(2) == weight.extent(3), "conv_transpose2d: weight ", weight.shape(),
              " does not have a square kernel");
  Arena::Scope scope(ctx.arena());
  const auto place = [&](std::int64_t ky, std::int64_t kx) {
    const std::int64_t tap = ky * weight.stride(2) + kx * weight.stride(3);
    return kernels::pack_in_arena({weight.data(),
                                   weight.extent(1),
                                   weight.stride(1),
                                   weight.extent(0),
                                   weight.stride(0),
                                   {&tap, Shape{1}}},
                                  ctx);
  };
  run_places(y, x, weight.extent(0), weight.extent(1), weight.extent(2), bias, place, ctx);
}

}  // namespace lvggt
