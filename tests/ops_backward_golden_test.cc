// SPDX-License-Identifier: Apache-2.0
// The backward passes and the losses against single operators computed by the authors' framework in
// float32 (tests/golden/ops_tiny_seed1.safetensors), on every instruction set.
#include <doctest/doctest.h>

#include <string>
#include <vector>

#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/batch_norm2d.h"
#include "lvggt/kernels/conv2d.h"
#include "lvggt/kernels/conv_transpose2d.h"
#include "lvggt/kernels/interpolate.h"
#include "lvggt/kernels/layer_norm.h"
#include "lvggt/kernels/linear.h"
#include "lvggt/kernels/loss.h"
#include "tests/support/compare.h"
#include "tests/support/golden.h"
#include "tests/support/random.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Op {
  const Safetensors& file;
  std::string name;
  Context& ctx;

  template <int R>
  Tensor<float, R> get(const std::string& field) const {
    return file.read<R>(name + "." + field);
  }
  Tensor<float, 4> map(const std::string& field) const { return channels_last(get<4>(field)); }
  bool has(const std::string& field) const { return file.find(name + "." + field) != nullptr; }
  // A vector's view, or an empty one.
  View<float, 1> zeros(Tensor<float, 1>& storage, const std::string& field) const {
    if (!has(field)) return {};
    storage = Tensor<float, 1>(get<1>(field).shape());
    return storage;
  }

  // Both sides round: a few times the float error of these short sums, relative to the largest.
  template <int R>
  void check(const Tensor<float, R>& ours, const Tensor<float, R>& expected) const {
    CAPTURE(name);
    CHECK_CLOSE(ours, expected, 2e-6 * largest_magnitude(expected));
  }
  void check_vector(View<float, 1> ours, const std::string& field) const {
    if (ours) check(converted<float>(ours), get<1>(field));
  }
};

template <class Body>
void for_each_op(const std::vector<std::string>& names, const Body& body) {
  const Safetensors file = open_golden("ops_tiny_seed1.safetensors");
  Context ctx(2);
  for_each_target([&] {
    for (const std::string& name : names) body(Op{file, name, ctx});
  });
}

Tensor<float, 4> level_maps(const Tensor<float, 5>& planes) {
  const Tensor<float, 5> last = permuted<5>(planes, {0, 1, 3, 4, 2});
  Tensor<float, 4> maps(
      Shape{last.extent(0) * last.extent(1), last.extent(2), last.extent(3), last.extent(4)});
  std::copy_n(last.data(), last.size(), maps.data());
  return maps;
}

}  // namespace

TEST_CASE("linear, linear_gelu: gradients as the reference") {
  for_each_op({"linear", "linear_gelu"}, [](const Op& op) {
    const auto x = op.get<2>("x"), w = op.get<2>("w");
    const auto b = op.get<1>("b");
    Tensor<float, 2> dy = op.get<2>("dy"), sum(dy.shape()), dx(x.shape()), dw(w.shape());
    Tensor<float, 1> db(b.shape());
    if (op.name == "linear_gelu") {
      linear_forward(sum, x, w, {.bias = b}, op.ctx);
      gelu_backward(dy, dy, sum, op.ctx);
    }
    linear_backward(dx, dw, db, dy, x, w, op.ctx);
    op.check(dx, op.get<2>("dx"));
    op.check(dw, op.get<2>("dw"));
    op.check(db, op.get<1>("db"));
  });
}

TEST_CASE("gelu, silu, relu, sigmoid: gradients as the reference") {
  for_each_op({"gelu", "silu", "relu", "sigmoid"}, [](const Op& op) {
    const auto x = op.get<2>("x"), y = op.get<2>("y"), dy = op.get<2>("dy");
    Tensor<float, 2> dx(x.shape());
    if (op.name == "gelu") gelu_backward(dx, dy, x, op.ctx);
    if (op.name == "silu") silu_backward(dx, dy, x, op.ctx);
    if (op.name == "relu") relu_backward(dx, dy, y, op.ctx);
    if (op.name == "sigmoid") sigmoid_backward(dx, dy, y, op.ctx);
    op.check(dx, op.get<2>("dx"));
  });
}

TEST_CASE("layer norms: gradients as the reference, with its three eps") {
  for_each_op({"layernorm_eps1e-5", "layernorm_eps1e-6", "layernorm_small_eps1e-5",
               "layernorm_small_eps1e-6", "layernorm_noaffine_eps1e-6"},
              [](const Op& op) {
                const auto x = op.get<2>("x");
                const Tensor<float, 1> gamma = op.has("w") ? op.get<1>("w") : Tensor<float, 1>();
                const View<const float, 1> scale =
                    gamma.empty() ? View<const float, 1>() : gamma.view();
                Tensor<float, 2> y(x.shape()), dx(x.shape());
                Tensor<float, 1> mean(Shape{x.extent(0)}), rstd(mean.shape()), dgamma, dbeta;
                const View<float, 1> dg = op.zeros(dgamma, "dw"), db = op.zeros(dbeta, "db");
                layer_norm_forward(y, mean, rstd, x, scale, {},
                                   op.name.ends_with("1e-5") ? 1e-5f : 1e-6f, op.ctx);
                layer_norm_backward(dx, dg, db, op.get<2>("dy"), mean, rstd, x, scale, op.ctx);
                op.check(dx, op.get<2>("dx"));
                op.check_vector(dg, "dw");
                op.check_vector(db, "db");
              });
}

TEST_CASE("convolutions, transposed ones too: gradients as the reference") {
  struct Conv {
    std::int64_t stride, padding;
  };
  const auto conv_of = [](const std::string& op) -> Conv {
    if (op.starts_with("conv3x3_s1")) return {1, 1};
    if (op.starts_with("conv3x3_s2")) return {2, 1};
    if (op.starts_with("conv2x2")) return {2, 0};
    if (op.starts_with("conv14x14")) return {14, 0};
    return {1, 0};
  };
  for_each_op({"conv3x3_s1p1", "conv3x3_s1p1_nobias", "conv3x3_s1p1_1px", "conv3x3_s2p1_odd",
               "conv3x3_s2p1_even", "conv1x1", "conv2x2_s2_odd", "conv2x2_s2_even", "conv14x14_s14",
               "convT_k2s2", "convT_k4s4"},
              [&](const Op& op) {
                const auto x = op.map("x"), dy = op.map("dy"), w = op.get<4>("w");
                Tensor<float, 4> dx(x.shape()), dw(w.shape());
                Tensor<float, 1> dbias;
                const View<float, 1> db = op.zeros(dbias, "db");
                if (op.name.starts_with("convT")) {
                  conv_transpose2d_backward(dx, dw, db, dy, x, w, op.ctx);
                } else {
                  const Conv conv = conv_of(op.name);
                  conv2d_backward(dx, dw, db, dy, x, w, conv.stride, conv.padding, op.ctx);
                }
                op.check(dx, op.map("dx"));
                op.check(dw, op.get<4>("dw"));
                op.check_vector(db, "db");
              });
}

TEST_CASE(
    "batch norm with batch statistics: output, gradients, running statistics as the reference") {
  for_each_op({"batchnorm2d_train"}, [](const Op& op) {
    const auto x = op.map("x"), dy = op.map("dy");
    const auto gamma = op.get<1>("w"), beta = op.get<1>("b");
    Tensor<float, 4> y(x.shape()), dx(x.shape());
    Tensor<float, 1> mean(gamma.shape()), rstd(gamma.shape()), dgamma(gamma.shape()),
        dbeta(gamma.shape()), running_mean = op.get<1>("running_mean_in"),
                              running_var = op.get<1>("running_var_in");
    batch_norm2d_forward(y, mean, rstd, running_mean, running_var, x, gamma, beta, 1e-5f, 0.1f,
                         Activation::kNone, op.ctx);
    batch_norm2d_backward(dx, dgamma, dbeta, dy, mean, rstd, x, gamma, beta, Activation::kNone,
                          op.ctx);
    op.check(y, op.map("y"));
    op.check(dx, op.map("dx"));
    op.check(dgamma, op.get<1>("dw"));
    op.check(dbeta, op.get<1>("db"));
    op.check(running_mean, op.get<1>("running_mean_out"));
    op.check(running_var, op.get<1>("running_var_out"));
  });
}

TEST_CASE("batch norm with frozen statistics: gradients as the reference") {
  for_each_op({"batchnorm2d_eval"}, [](const Op& op) {
    const auto x = op.map("x"), dy = op.map("dy");
    const auto gamma = op.get<1>("w"), beta = op.get<1>("b"), mean = op.get<1>("running_mean_in");
    Tensor<float, 4> y(x.shape()), dx(x.shape());
    Tensor<float, 1> rstd(gamma.shape()), dgamma(gamma.shape()), dbeta(gamma.shape());
    Tensor<double, 2> sums(Shape{std::int64_t{2}, gamma.extent(0)});
    batch_norm2d_rstd(rstd, op.get<1>("running_var_in"), 1e-5f);
    batch_norm2d_normalize(y, x, mean, rstd, gamma, beta, Activation::kNone, op.ctx);
    batch_norm2d_backward_sums(sums, dy, mean, rstd, x, gamma, beta, Activation::kNone, op.ctx);
    batch_norm2d_backward_parameters(dgamma, dbeta, sums);
    batch_norm2d_backward_input(dx, dy, {}, 0, mean, rstd, x, gamma, beta, Activation::kNone,
                                op.ctx);
    op.check(y, op.map("y"));
    op.check(dx, op.map("dx"));
    op.check(dgamma, op.get<1>("dw"));
    op.check(dbeta, op.get<1>("db"));
  });
}

TEST_CASE("bilinear resizes: gradients as the reference, both corner conventions") {
  std::vector<std::string> names;
  for (const char* size : {"up", "down", "x2", "odd", "from1", "to1", "same"})
    for (const char* corners : {"ac0", "ac1"})
      names.push_back(concat("bilinear_", corners, "_", size));
  for_each_op(names, [](const Op& op) {
    const auto expected = op.map("dx");
    Tensor<float, 4> dx(expected.shape());
    bilinear_backward(dx, op.map("dy"), op.name.starts_with("bilinear_ac1"), op.ctx);
    op.check(dx, expected);
  });
}

TEST_CASE("losses: values and gradients as the reference, with and without its mask") {
  const Safetensors file = open_golden("ops_tiny_seed1.safetensors");
  Context ctx(2);
  const Tensor<float, 5> holes = file.read<5>("loss_mask.m");
  for (const char* kind : {"l1", "mse", "cos_channels", "cos_width"}) {
    for (const bool masked : {false, true}) {
      const Op op{file, concat("loss_", kind, masked ? "_masked" : ""), ctx};
      const Tensor<float, 4> a = level_maps(op.get<5>("a")), b = level_maps(op.get<5>("b"));
      const View<const float, 3> mask =
          masked ? View<const float, 3>(holes.data(), Shape{a.extent(0), a.extent(1), a.extent(2)})
                 : View<const float, 3>();
      const std::string name = kind;
      const CosineAxis axis = name == "cos_width" ? CosineAxis::kWidth : CosineAxis::kChannels;
      double value = 0;
      Tensor<float, 4> da(a.shape()), db(b.shape());
      if (name == "l1") {
        value = l1_loss_forward(a, b, mask, ctx);
        l1_loss_backward(da, 1, a, b, mask, ctx);
        l1_loss_backward(db, 1, b, a, mask, ctx);
      } else if (name == "mse") {
        value = mse_loss_forward(a, b, mask, ctx);
        mse_loss_backward(da, 1, a, b, mask, ctx);
        mse_loss_backward(db, 1, b, a, mask, ctx);
      } else {
        value = cosine_loss_forward(a, b, mask, axis, ctx);
        cosine_loss_backward(da, 1, a, b, mask, axis, ctx);
        cosine_loss_backward(db, 1, b, a, mask, axis, ctx);
      }
      CAPTURE(op.name);
      CHECK(value == doctest::Approx(op.get<1>("y")[0]).epsilon(1e-6));
      op.check(da, level_maps(op.get<5>("da")));
      op.check(db, level_maps(op.get<5>("db")));
    }
  }
}
