// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/conv2d.h"

#include <algorithm>

#include "kernels/pack.h"
#include "kernels/product.h"

namespace lvggt {

PackedConv2d pack_conv2d(View<const float, 4> weight, std::int64_t stride, std::int64_t padding,
                         Storage storage) {
  const auto [Cout, Cin, kernel, kernel_x] = weight.shape();
  LVGGT_CHECK(kernel == kernel_x, "conv2d: weight ", weight.shape(),
              " does not have a square kernel");
  const std::int64_t taps = kernel * kernel;
  PackedConv2d packed{Cin, kernel, stride, padding,
                      kernels::empty_matrix(Cout, taps, Cin, storage)};
  for (std::int64_t n = 0; n < Cout; ++n) {
    const View<const float, 3> filter = weight[n];
    for (std::int64_t t = 0; t < taps; ++t) {
      for (std::int64_t c = 0; c < Cin; ++c) {
        kernels::set_weight(packed.matrix, n, t * Cin + c, filter(c, t / kernel, t % kernel));
      }
    }
  }
  return packed;
}

namespace {

// Addresses of the pixels that the taps of output row m read. Beyond the border they read `zeros`.
class ConvGather {
 public:
  // merged: without padding, the taps of one kernel row lie side by side and are read as one.
  ConvGather(View<float, 4> y, View<const float, 4> x, View<const float, 4> residual,
             const PackedConv2d& w, bool merged, const float* zeros)
      : y_(y), x_(x), residual_(residual), w_(w), taps_x_(merged ? 1 : w.kernel), zeros_(zeros) {}

  void operator()(const kernels::RowTable& table) const {
    const std::int64_t Ho = y_.extent(1), Wo = y_.extent(2);
    std::int64_t ox = table.begin % Wo;
    std::int64_t oy = table.begin / Wo % Ho;
    std::int64_t b = table.begin / Wo / Ho;
    for (std::int64_t r = 0; r < table.count; ++r) {
      table.y[r] = y_.data() + b * y_.stride(0) + oy * y_.stride(1) + ox * y_.stride(2);
      if (residual_) {
        table.residual[r] = residual_.data() + b * residual_.stride(0) + oy * residual_.stride(1) +
                            ox * residual_.stride(2);
      }
      for (std::int64_t ky = 0; ky < w_.kernel; ++ky) {
        for (std::int64_t kx = 0; kx < taps_x_; ++kx) {
          table.x[(ky * taps_x_ + kx) * table.capacity + r] =
              pixel(b, oy * w_.stride - w_.padding + ky, ox * w_.stride - w_.padding + kx);
        }
      }
      if (++ox == Wo) {
        ox = 0;
        if (++oy == Ho) {
          oy = 0;
          ++b;
        }
      }
    }
  }

 private:
  const float* pixel(std::int64_t b, std::int64_t iy, std::int64_t ix) const {
    if (iy < 0 || iy >= x_.extent(1) || ix < 0 || ix >= x_.extent(2)) return zeros_;
    return x_.data() + b * x_.stride(0) + iy * x_.stride(1) + ix * x_.stride(2);
  }

  View<float, 4> y_;
  View<const float, 4> x_;
  View<const float, 4> residual_;
  const PackedConv2d& w_;
  std::int64_t taps_x_;
  const float* zeros_;
};

}  // namespace

void conv2d_forward(View<float, 4> y, View<const float, 4> x, const PackedConv2d& w,
                    const Epilogue<4>& epilogue, Context& ctx) {
  const auto [B, H, W, Cin] = x.shape();
  const std::int64_t Cout = w.matrix.N;
  LVGGT_CHECK(Cin == w.in_channels, "conv2d: x is ", x.shape(), " but the weight reads ",
              w.in_channels, " channels");
  const Shape expected{B, conv2d_extent(H, w.kernel, w.stride, w.padding),
                       conv2d_extent(W, w.kernel, w.stride, w.padding), Cout};
  LVGGT_CHECK(y.shape() == expected, "conv2d: y is ", y.shape(), " but x ", x.shape(), " gives ",
              expected);
  LVGGT_CHECK(epilogue.bias.empty() || epilogue.bias.extent(0) == Cout, "conv2d: bias is ",
              epilogue.bias.shape(), " but y is ", y.shape());
  LVGGT_CHECK(epilogue.gamma.empty() || epilogue.gamma.extent(0) == Cout, "conv2d: gamma is ",
              epilogue.gamma.shape(), " but y is ", y.shape());
  LVGGT_CHECK(epilogue.residual.empty() || epilogue.residual.shape() == y.shape(),
              "conv2d: residual is ", epilogue.residual.shape(), " but y is ", y.shape());

  Arena::Scope scope(ctx.arena());
  const View<float, 1> zeros = ctx.arena().alloc(Shape{Cin});
  std::fill_n(zeros.data(), Cin, 0.0f);
  const bool merged = w.padding == 0 && (w.kernel == 1 || x.stride(2) == Cin);
  const kernels::Product product{B * expected[1] * expected[2],
                                 &w.matrix,
                                 merged ? w.kernel : w.kernel * w.kernel,
                                 merged ? w.kernel * Cin : Cin,
                                 epilogue.bias.data(),
                                 epilogue.activation,
                                 epilogue.gamma.data(),
                                 !epilogue.residual.empty()};
  const ConvGather gather(y, x, epilogue.residual, w, merged, zeros.data());
  kernels::run_product(product, gather, ctx);
}

}  // namespace lvggt
