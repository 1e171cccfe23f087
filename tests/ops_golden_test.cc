// SPDX-License-Identifier: Apache-2.0
// The kernels against single operators computed by the authors' framework in float32
// (tests/golden/ops_tiny_seed1.safetensors).
#include <doctest/doctest.h>

#include <cmath>
#include <vector>

#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/attention.h"
#include "lvggt/kernels/batch_norm2d.h"
#include "lvggt/kernels/conv2d.h"
#include "lvggt/kernels/conv_transpose2d.h"
#include "lvggt/kernels/interpolate.h"
#include "lvggt/kernels/layer_norm.h"
#include "lvggt/kernels/linear.h"
#include "lvggt/kernels/rope.h"
#include "tests/support/compare.h"
#include "tests/support/golden.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// Both sides round: twice the float error of these short sums, relative to the largest element. A
// wrong eps, a tanh GELU, a cubic with a = -3/4 or half a pixel are 20 times that and more.
constexpr double kTolerance = 1e-6;

struct Ops {
  Safetensors file = open_golden("ops_tiny_seed1.safetensors");
  Context ctx{2};

  template <int R>
  Tensor<float, R> get(const std::string& name) const {
    return file.read<R>(name);
  }
  Tensor<float, 4> map(const std::string& name) const { return channels_last(get<4>(name)); }
  Tensor<float, 3> tokens(const std::string& name) const { return tokens_first(get<4>(name)); }
  Tensor<float, 1> optional_vector(const std::string& name) const {
    return file.find(name) ? get<1>(name) : Tensor<float, 1>();
  }
};

// The reference computes where a resized pixel lies in float: up to 2 u 37 off for the 37 pixels
// here, times the cubic's slope of up to 1.
constexpr double kResizeTolerance = 2 * 37 * kUnit;

template <int R>
void check_close(const std::string& op, const Tensor<float, R>& y, const Tensor<float, R>& expected,
                 double tolerance = kTolerance) {
  CAPTURE(op);
  CHECK_CLOSE(y, expected, tolerance * largest_magnitude(expected));
}

// Every op of one kind on every instruction set.
template <class Body>
void for_each_op(const std::vector<std::string>& names, const Body& body) {
  Ops ops;
  for_each_target([&] {
    for (const std::string& name : names) body(ops, name);
  });
}

}  // namespace

TEST_CASE("linear, linear_gelu: as the reference") {
  for_each_op({"linear", "linear_gelu"}, [](Ops& ops, const std::string& op) {
    const auto x = ops.get<2>(op + ".x"), expected = ops.get<2>(op + ".y");
    const auto b = ops.get<1>(op + ".b");
    Tensor<float, 2> y(expected.shape());
    linear_forward(
        y, x, pack_linear(ops.get<2>(op + ".w")),
        {.bias = b, .activation = op == "linear" ? Activation::kNone : Activation::kGelu}, ops.ctx);
    check_close(op, y, expected);
  });
}

TEST_CASE("gelu, silu, relu, sigmoid: as the reference") {
  for_each_op({"gelu", "silu", "relu", "sigmoid"}, [](Ops& ops, const std::string& op) {
    const Activation kind = op == "gelu"   ? Activation::kGelu
                            : op == "silu" ? Activation::kSilu
                            : op == "relu" ? Activation::kRelu
                                           : Activation::kSigmoid;
    const auto expected = ops.get<2>(op + ".y");
    Tensor<float, 2> y(expected.shape());
    activation_forward(y, ops.get<2>(op + ".x"), kind, ops.ctx);
    check_close(op, y, expected);
  });
}

TEST_CASE("layer norms: as the reference, with its three eps") {
  for_each_op({"layernorm_eps1e-5", "layernorm_eps1e-6", "layernorm_small_eps1e-5",
               "layernorm_small_eps1e-6", "layernorm_noaffine_eps1e-6"},
              [](Ops& ops, const std::string& op) {
                const float eps = op.ends_with("1e-5") ? 1e-5f : 1e-6f;
                const auto w = ops.optional_vector(op + ".w"), b = ops.optional_vector(op + ".b");
                const auto expected = ops.get<2>(op + ".y");
                Tensor<float, 2> y(expected.shape());
                layer_norm_forward(y, ops.get<2>(op + ".x"), w.empty() ? View<const float, 1>() : w,
                                   b.empty() ? View<const float, 1>() : b, eps, ops.ctx);
                check_close(op, y, expected);
              });
}

TEST_CASE("convolutions: as the reference") {
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
  for_each_op(
      {"conv3x3_s1p1", "conv3x3_s1p1_nobias", "conv3x3_s1p1_1px", "conv3x3_s2p1_odd",
       "conv3x3_s2p1_even", "conv1x1", "conv2x2_s2_odd", "conv2x2_s2_even", "conv14x14_s14"},
      [&](Ops& ops, const std::string& op) {
        const auto expected = ops.map(op + ".y");
        const auto b = ops.optional_vector(op + ".b");
        Epilogue<4> epilogue;
        if (!b.empty()) epilogue.bias = b;
        Tensor<float, 4> y(expected.shape());
        const Conv conv = conv_of(op);
        conv2d_forward(y, ops.map(op + ".x"),
                       pack_conv2d(ops.get<4>(op + ".w"), conv.stride, conv.padding), epilogue,
                       ops.ctx);
        check_close(op, y, expected);
      });
}

TEST_CASE("transposed convolutions: as the reference") {
  for_each_op({"convT_k2s2", "convT_k4s4"}, [](Ops& ops, const std::string& op) {
    const auto expected = ops.map(op + ".y");
    Tensor<float, 4> y(expected.shape());
    conv_transpose2d_forward(y, ops.map(op + ".x"), pack_conv_transpose2d(ops.get<4>(op + ".w")),
                             ops.get<1>(op + ".b"), ops.ctx);
    check_close(op, y, expected);
  });
}

TEST_CASE("batch norm with running statistics, folded into a convolution: as the reference") {
  for_each_op({"batchnorm2d_eval"}, [](Ops& ops, const std::string& op) {
    const auto expected = ops.map(op + ".y");
    const std::int64_t C = expected.extent(3);
    Tensor<float, 4> identity(Shape{C, C, std::int64_t{1}, std::int64_t{1}});
    for (std::int64_t c = 0; c < C; ++c) identity(c, c, 0, 0) = 1;
    Tensor<float, 1> bias(Shape{C});
    batch_norm2d_fold(identity, bias, ops.get<1>(op + ".w"), ops.get<1>(op + ".b"),
                      ops.get<1>(op + ".running_mean_in"), ops.get<1>(op + ".running_var_in"),
                      1e-5f);
    Tensor<float, 4> y(expected.shape());
    conv2d_forward(y, ops.map(op + ".x"), pack_conv2d(identity, 1, 0), {.bias = bias}, ops.ctx);
    check_close(op, y, expected);
  });
}

TEST_CASE("bilinear resizes: as the reference, both corner conventions") {
  std::vector<std::string> names;
  for (const char* size : {"up", "down", "x2", "odd", "from1", "to1", "same"})
    for (const char* corners : {"ac0", "ac1"})
      names.push_back(concat("bilinear_", corners, "_", size));
  for_each_op(names, [](Ops& ops, const std::string& op) {
    const auto expected = ops.map(op + ".y");
    Tensor<float, 4> y(expected.shape());
    bilinear_forward(y, ops.map(op + ".x"), op.starts_with("bilinear_ac1"), ops.ctx);
    check_close(op, y, expected, kResizeTolerance);
  });
}

TEST_CASE("antialiased bicubic resizes: as the reference") {
  for_each_op(
      {"bicubic_aa_down", "bicubic_aa_up", "bicubic_aa_mixed", "bicubic_aa_far", "bicubic_aa_near"},
      [](Ops& ops, const std::string& op) {
        const auto expected = ops.map(op + ".y");
        Tensor<float, 4> y(expected.shape());
        bicubic_antialias_forward(y[0], ops.map(op + ".x")[0], ops.ctx);
        check_close(op, y, expected, kResizeTolerance);
      });
}

TEST_CASE("attention without a mask, across, and with the frame mask: as the reference") {
  for_each_op(
      {"attention_nomask", "attention_cross", "attention_framemask"},
      [](Ops& ops, const std::string& op) {
        const auto q = ops.tokens(op + ".q"), k = ops.tokens(op + ".k"), v = ops.tokens(op + ".v");
        const auto expected = ops.tokens(op + ".y");
        // With the mask, the queries of frame t see the first t + 1 groups; else there is one group
        // for all.
        const bool masked = op == "attention_framemask";
        const std::int64_t tokens = masked ? 4 : k.extent(0), heads = k.extent(1), D = k.extent(2);
        std::vector<PackedKeysValues> groups;
        std::vector<Tensor<std::byte, 1>> buffers;
        for (std::int64_t begin = 0; begin < k.extent(0); begin += tokens) {
          buffers.emplace_back(Shape{keys_values_layout(Storage::kF32, heads, tokens, D).size});
          groups.push_back({buffers.back().data(), Storage::kF32, heads, tokens, D});
          pack_keys_values(groups.back(), k.view().narrow(0, begin, begin + tokens),
                           v.view().narrow(0, begin, begin + tokens), ops.ctx);
        }
        Tensor<float, 3> y(q.shape());
        const std::int64_t queries = masked ? 4 : q.extent(0);
        for (std::int64_t t = 0; t * queries < q.extent(0); ++t)
          scaled_dot_product_attention(y.view().narrow(0, t * queries, (t + 1) * queries),
                                       q.view().narrow(0, t * queries, (t + 1) * queries),
                                       std::span(groups).first(static_cast<std::size_t>(t + 1)),
                                       1 / std::sqrt(static_cast<float>(D)), ops.ctx);
        check_close(op, y, expected);
      });
}

TEST_CASE("2D rotary embedding: as the reference") {
  for_each_op({"rope2d", "rope2d_hd24"}, [](Ops& ops, const std::string& op) {
    const std::vector<std::int64_t> values = ops.file.read_int64("rope2d.positions");
    Tensor<std::int64_t, 2> positions(Shape{8, 2});
    std::copy(values.begin(), values.end(), positions.data());
    const auto expected = ops.tokens(op + ".y");
    Tensor<float, 3> y(expected.shape());
    rope_2d_forward(y, ops.tokens(op + ".x"), make_rope_table(positions, y.extent(2), 100),
                    ops.ctx);
    check_close(op, y, expected);
  });
}

TEST_CASE("depth and point activations: as the reference") {
  for_each_op({"activate_depth", "activate_points"}, [](Ops& ops, const std::string& op) {
    const auto x = ops.map(op + ".x");
    const std::int64_t C = x.extent(3), N = x.size() / C;
    const View<const float, 2> pixels = x.view().reshaped(Shape{N, C});
    const auto expected = ops.get<1>(op + ".y");
    // Values of all pixels, then confidences.
    Tensor<float, 1> y(expected.shape());
    const View<float, 1> confidence = y.view().narrow(0, (C - 1) * N, C * N);
    if (op == "activate_depth") {
      depth_activation(y.view().narrow(0, 0, N), confidence, pixels, ops.ctx);
    } else {
      point_activation(View<float, 2>(y.data(), Shape{N, std::int64_t{3}}), confidence, pixels,
                       ops.ctx);
    }
    check_close(op, y, expected);
  });
}
