// SPDX-License-Identifier: Apache-2.0
// Backward passes of single operators and of the decoder's blocks: gradients from <op>.dy.
#include <optional>

#include "examples/check_reference/operands.h"
#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/batch_norm2d.h"
#include "lvggt/kernels/loss.h"

namespace check_reference {
namespace {

using namespace lvggt;

// A vector of zeros for a gradient, if the operand has one.
Tensor<float, 1> zeros_if_there(const Operands& o, const std::string& name) {
  return o.has(name) ? Tensor<float, 1>(o.file().read<1>(o.op() + "." + name).shape())
                     : Tensor<float, 1>();
}
View<float, 1> writable(Tensor<float, 1>& tensor) {
  return tensor.empty() ? View<float, 1>() : tensor.view();
}

void linear_gradients(const Operands& o) {
  const Tensor<float, 2> x = o.get<2>("x"), w = o.get<2>("w"), given = o.get<2>("dy");
  Tensor<float, 2> dy = given.clone(), dx(x.shape()), dw(w.shape());
  Tensor<float, 1> db = zeros_if_there(o, "db");
  if (o.op() == "linear_gelu") {
    const Tensor<float, 1> bias = o.get<1>("b");
    Tensor<float, 2> sum(given.shape());
    linear_forward(sum, x, pack_linear(w), {.bias = bias.view()}, o.ctx());
    gelu_backward(dy, given, sum, o.ctx());
  }
  linear_backward(dx, dw, writable(db), dy, x, w, o.ctx());
  o.compare(dx, "dx");
  o.compare(dw, "dw");
  if (!db.empty()) o.compare(db, "db");
}

void activation_gradients(const Operands& o) {
  const Tensor<float, 2> x = o.get<2>("x"), dy = o.get<2>("dy");
  Tensor<float, 2> y(x.shape()), dx(x.shape());
  if (o.op() == "gelu") {
    gelu_backward(dx, dy, x, o.ctx());
  } else if (o.op() == "silu") {
    silu_backward(dx, dy, x, o.ctx());
  } else if (o.op() == "relu") {
    activation_forward(y, x, Activation::kRelu, o.ctx());
    relu_backward(dx, dy, y, o.ctx());
  } else {
    activation_forward(y, x, Activation::kSigmoid, o.ctx());
    sigmoid_backward(dx, dy, y, o.ctx());
  }
  o.compare(dx, "dx");
}

void layer_norm_gradients(const Operands& o) {
  const Tensor<float, 2> x = o.get<2>("x"), dy = o.get<2>("dy");
  const Tensor<float, 1> gamma = o.get_if_there("w"), beta = o.get_if_there("b");
  const float eps = o.op().ends_with("eps1e-6") ? 1e-6f : 1e-5f;
  Tensor<float, 2> y(x.shape()), dx(x.shape());
  Tensor<float, 1> mean(Shape{x.extent(0)}), rstd(Shape{x.extent(0)});
  Tensor<float, 1> dgamma = zeros_if_there(o, "dw"), dbeta = zeros_if_there(o, "db");
  layer_norm_forward(y, mean, rstd, x, view_or_empty(gamma), view_or_empty(beta), eps, o.ctx());
  layer_norm_backward(dx, writable(dgamma), writable(dbeta), dy, mean, rstd, x,
                      view_or_empty(gamma), o.ctx());
  o.compare(dx, "dx");
  if (!dgamma.empty()) o.compare(dgamma, "dw");
  if (!dbeta.empty()) o.compare(dbeta, "db");
}

void conv_gradients(const Operands& o) {
  const Tensor<float, 4> x = o.get_map("x"), w = o.get<4>("w"), dy = o.get_map("dy");
  Tensor<float, 4> dx(x.shape()), dw(w.shape());
  Tensor<float, 1> db = zeros_if_there(o, "db");
  if (o.op().starts_with("convT")) {
    conv_transpose2d_backward(dx, dw, writable(db), dy, x, w, o.ctx());
  } else {
    const auto [stride, padding] = o.stride_and_padding();
    conv2d_backward(dx, dw, writable(db), dy, x, w, stride, padding, o.ctx());
  }
  o.compare_map(dx, "dx");
  o.compare(dw, "dw");
  if (!db.empty()) o.compare(db, "db");
}

void batch_norm_gradients(const Operands& o) {
  constexpr float kEps = 1e-5f;
  const Tensor<float, 4> x = o.get_map("x"), dy = o.get_map("dy");
  const std::int64_t C = x.extent(3);
  const Tensor<float, 1> gamma = o.get<1>("w"), beta = o.get<1>("b");
  Tensor<float, 4> y(x.shape()), dx(x.shape());
  Tensor<float, 1> mean(Shape{C}), rstd(Shape{C}), dgamma(Shape{C}), dbeta(Shape{C});
  Tensor<double, 2> sums(Shape{std::int64_t{2}, C});
  const auto sum = [&] {
    batch_norm2d_backward_sums(sums, dy, mean, rstd, x, gamma, beta, Activation::kNone, o.ctx());
    batch_norm2d_backward_parameters(dgamma, dbeta, sums);
  };
  if (o.op().ends_with("_train")) {
    batch_norm2d_forward(y, mean, rstd, {}, {}, x, gamma, beta, kEps, 0, Activation::kNone,
                         o.ctx());
    sum();
    batch_norm2d_backward_input(dx, dy, sums, x.size() / C, mean, rstd, x, gamma, beta,
                                Activation::kNone, o.ctx());
  } else {
    mean = o.get<1>("running_mean_in");
    batch_norm2d_rstd(rstd, o.get<1>("running_var_in"), kEps);
    sum();
    batch_norm2d_backward_input(dx, dy, {}, 0, mean, rstd, x, gamma, beta, Activation::kNone,
                                o.ctx());
  }
  o.compare_map(dx, "dx");
  o.compare(dgamma, "dw");
  o.compare(dbeta, "db");
}

void bilinear_gradients(const Operands& o) {
  Tensor<float, 4> dx(o.get_map("x").shape());
  bilinear_backward(dx, o.get_map("dy"), o.op().starts_with("bilinear_ac1"), o.ctx());
  o.compare_map(dx, "dx");
}

// A 3x3 or 1x1 convolution of a block, with its gradients.
struct TrainedConv {
  std::string name;
  Tensor<float, 4> weight, dweight;
  Tensor<float, 1> bias, dbias;

  TrainedConv(const Operands& o, const std::string& field)
      : name(field),
        weight(o.get<4>("param." + field + ".weight")),
        dweight(weight.shape()),
        bias(o.get<1>("param." + field + ".bias")),
        dbias(bias.shape()) {}
  std::int64_t padding() const { return weight.extent(2) / 2; }

  Tensor<float, 4> forward(const Tensor<float, 4>& x, Context& ctx) const {
    Tensor<float, 4> y(Shape{x.extent(0), x.extent(1), x.extent(2), weight.extent(0)});
    conv2d_forward(y, x, pack_conv2d(weight, 1, padding()), {.bias = bias.view()}, ctx);
    return y;
  }
  Tensor<float, 4> backward(const Tensor<float, 4>& dy, const Tensor<float, 4>& x, Context& ctx) {
    Tensor<float, 4> dx(x.shape());
    conv2d_backward(dx, dweight, dbias, dy, x, weight, 1, padding(), ctx);
    return dx;
  }
  void compare(const Operands& o) const {
    o.compare(dweight, "dparam." + name + ".weight");
    o.compare(dbias, "dparam." + name + ".bias");
  }
};

View<float, 2> rows_of(Tensor<float, 4>& map) {
  return map.view().reshaped(Shape{map.size() / map.extent(3), map.extent(3)});
}

// r = relu(x), h = relu(conv1(r)), y = conv2(h) + r
struct TrainedUnit {
  TrainedConv conv1, conv2;
  Tensor<float, 4> r, h;

  TrainedUnit(const Operands& o, const std::string& prefix)
      : conv1(o, prefix + "conv1"), conv2(o, prefix + "conv2") {}

  Tensor<float, 4> forward(const Tensor<float, 4>& x, Context& ctx) {
    r = x.clone();
    activation_forward(rows_of(r), rows_of(r), Activation::kRelu, ctx);
    h = conv1.forward(r, ctx);
    activation_forward(rows_of(h), rows_of(h), Activation::kRelu, ctx);
    Tensor<float, 4> y = conv2.forward(h, ctx);
    add(rows_of(y), rows_of(y), rows_of(r), ctx);
    return y;
  }
  Tensor<float, 4> backward(const Tensor<float, 4>& dy, Context& ctx) {
    Tensor<float, 4> dh = conv2.backward(dy, h, ctx);
    relu_backward(rows_of(dh), rows_of(dh), rows_of(h), ctx);
    Tensor<float, 4> dr = conv1.backward(dh, r, ctx), dskip = dy.clone();
    accumulate(rows_of(dr), rows_of(dskip), ctx);
    relu_backward(rows_of(dr), rows_of(dr), rows_of(r), ctx);
    return dr;
  }
  void compare(const Operands& o) const {
    conv1.compare(o);
    conv2.compare(o);
  }
};

void residual_conv_unit_gradients(const Operands& o) {
  TrainedUnit unit(o, "");
  unit.forward(o.get_map("x"), o.ctx());
  o.compare_map(unit.backward(o.get_map("dy"), o.ctx()), "dx");
  unit.compare(o);
}

// y = out_conv(resize(unit2(x + unit1(skip))))
void fusion_block_gradients(const Operands& o) {
  Context& ctx = o.ctx();
  Tensor<float, 4> sum = o.get_map("x");
  std::optional<TrainedUnit> unit1;
  if (o.has("skip")) {
    unit1.emplace(o, "resConfUnit1.");
    Tensor<float, 4> skip = unit1->forward(o.get_map("skip"), ctx);
    add(rows_of(sum), rows_of(sum), rows_of(skip), ctx);
  }
  TrainedUnit unit2(o, "resConfUnit2.");
  TrainedConv out_conv(o, "out_conv");
  const Tensor<float, 4> refined = unit2.forward(sum, ctx), dy = o.get_map("dy");
  Tensor<float, 4> resized(dy.shape()), drefined(refined.shape());
  bilinear_forward(resized, refined, true, ctx);
  const Tensor<float, 4> dresized = out_conv.backward(dy, resized, ctx);
  bilinear_backward(drefined, dresized, true, ctx);
  const Tensor<float, 4> dx = unit2.backward(drefined, ctx);
  o.compare_map(dx, "dx");
  if (unit1) {
    o.compare_map(unit1->backward(dx, ctx), "dskip");
    unit1->compare(o);
  }
  unit2.compare(o);
  out_conv.compare(o);
}

// [B, levels, C, H, W] as [B levels, H, W, C] and back.
Tensor<float, 4> level_maps(const Tensor<float, 5>& planes, Context& ctx) {
  const auto [B, L, C, H, W] = planes.shape();
  Tensor<float, 4> maps(Shape{B * L, H, W, C});
  for (std::int64_t n = 0; n < B * L; ++n) from_planes(maps[n], planes[n / L][n % L], ctx);
  return maps;
}
void compare_levels(const Operands& o, const Tensor<float, 4>& maps, const std::string& name) {
  const auto [B, H, W, C] = maps.shape();
  Tensor<float, 4> planes(Shape{B, C, H, W});
  for (std::int64_t n = 0; n < B; ++n) to_planes(planes[n], maps[n], o.ctx());
  o.compare(planes, name);
}

}  // namespace

void check_loss(const Operands& o, Comparison& comparison) {
  if (o.op() == "loss_mask") return comparison.accept("loss_mask.m");
  const Tensor<float, 4> a = level_maps(o.get<5>("a"), o.ctx());
  const Tensor<float, 4> b = level_maps(o.get<5>("b"), o.ctx());
  Tensor<float, 3> values(Shape{a.extent(0), a.extent(1), a.extent(2)});
  View<const float, 3> mask;
  if (o.op().ends_with("_masked")) {
    const Tensor<float, 5> m = o.file().read<5>("loss_mask.m");  // [B, levels, 1, H, W]
    LVGGT_CHECK(m.size() == values.size(), o.file().path(), ": loss_mask.m is ", m.shape());
    std::copy_n(m.data(), m.size(), values.data());
    mask = values;
  }
  Tensor<float, 1> y(Shape{1});
  Tensor<float, 4> da(a.shape()), db(a.shape());
  const auto run = [&](const auto& forward, const auto& backward) {
    y[0] = static_cast<float>(forward(a, b));
    backward(da, a, b);
    backward(db, b, a);  // every loss is symmetric
  };
  if (o.op().starts_with("loss_l1")) {
    run([&](auto& p, auto& q) { return l1_loss_forward(p, q, mask, o.ctx()); },
        [&](auto& d, auto& p, auto& q) { l1_loss_backward(d, 1, p, q, mask, o.ctx()); });
  } else if (o.op().starts_with("loss_mse")) {
    run([&](auto& p, auto& q) { return mse_loss_forward(p, q, mask, o.ctx()); },
        [&](auto& d, auto& p, auto& q) { mse_loss_backward(d, 1, p, q, mask, o.ctx()); });
  } else {
    const CosineAxis axis =
        o.op().starts_with("loss_cos_width") ? CosineAxis::kWidth : CosineAxis::kChannels;
    run([&](auto& p, auto& q) { return cosine_loss_forward(p, q, mask, axis, o.ctx()); },
        [&](auto& d, auto& p, auto& q) { cosine_loss_backward(d, 1, p, q, mask, axis, o.ctx()); });
  }
  o.compare(y);
  compare_levels(o, da, "da");
  compare_levels(o, db, "db");
}

void check_op_backward(const Operands& o) {
  const auto starts = [&](const char* prefix) { return o.op().starts_with(prefix); };
  if (!o.has("dy")) return;
  if (starts("linear")) return linear_gradients(o);
  if (starts("layernorm")) return layer_norm_gradients(o);
  if (starts("conv")) return conv_gradients(o);
  if (starts("batchnorm")) return batch_norm_gradients(o);
  if (starts("bilinear")) return bilinear_gradients(o);
  if (starts("fusion_block")) return fusion_block_gradients(o);
  const bool activation =
      o.op() == "gelu" || o.op() == "silu" || o.op() == "relu" || o.op() == "sigmoid";
  if (activation) return activation_gradients(o);
  if (o.op() == "residual_conv_unit") return residual_conv_unit_gradients(o);
}

}  // namespace check_reference
