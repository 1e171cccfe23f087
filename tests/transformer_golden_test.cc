// SPDX-License-Identifier: Apache-2.0
// Softmax, attention, rotary embedding, whole blocks and the dense heads' activations backward,
// against the authors' framework in float32 (tests/golden/ops_tiny_seed1.safetensors), on every
// instruction set.
#include <doctest/doctest.h>

#include <string>

#include "lvggt/kernels/dense_activation_backward.h"
#include "lvggt/train/block.h"
#include "tests/support/block_tensors.h"
#include "tests/support/compare.h"
#include "tests/support/golden.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// Both sides round: a few times the float error of these short sums, relative to the largest.
constexpr double kTolerance = 2e-6;

template <class A, int R>
void check(const A& ours, const Tensor<float, R>& expected) {
  CHECK_CLOSE(ours, expected, kTolerance * largest_magnitude(expected));
}

template <class Body>
void for_each_op(std::initializer_list<const char*> names, const Body& body) {
  const Safetensors file = open_golden("ops_tiny_seed1.safetensors");
  Context ctx(2);
  for_each_target([&] {
    for (const std::string name : names) {
      CAPTURE(name);
      body(file, name, ctx);
    }
  });
}

Tensor<float, 3> heads(const Safetensors& file, const std::string& name) {
  return tokens_first(file.read<4>(name));
}

RopeTable rope_table(const Safetensors& file, std::int64_t head_dim) {
  const std::vector<std::int64_t> values = file.read_int64("rope2d.positions");
  Tensor<std::int64_t, 2> positions(Shape{8, 2});
  std::copy(values.begin(), values.end(), positions.data());
  return make_rope_table(positions, head_dim, 100);
}

}  // namespace

TEST_CASE("softmax: output and gradient as the reference") {
  for_each_op({"softmax"}, [](const Safetensors& file, const std::string& op, Context& ctx) {
    const auto x = file.read<2>(op + ".x"), dy = file.read<2>(op + ".dy");
    Tensor<float, 2> y(x.shape()), dx(x.shape());
    softmax_forward(y, x, 1, ctx);
    softmax_backward(dx, dy, y, 1, ctx);
    check(y, file.read<2>(op + ".y"));
    check(dx, file.read<2>(op + ".dx"));
  });
}

TEST_CASE("attention, across and with the frame mask: output and gradients as the reference") {
  for_each_op(
      {"attention_nomask", "attention_cross", "attention_framemask"},
      [](const Safetensors& file, const std::string& op, Context& ctx) {
        const FrameMask mask = op == "attention_framemask" ? FrameMask{4, true} : FrameMask{};
        const auto q = heads(file, op + ".q"), k = heads(file, op + ".k"),
                   v = heads(file, op + ".v"), dy = heads(file, op + ".dy");
        Tensor<float, 3> y(q.shape()), dq(q.shape()), dk(k.shape()), dv(v.shape());
        attention_forward(y, q, k, v, mask, ctx);
        attention_backward(dq, dk, dv, dy, q, k, v, mask, ctx);
        check(y, heads(file, op + ".y"));
        check(dq, heads(file, op + ".dq"));
        check(dk, heads(file, op + ".dk"));
        check(dv, heads(file, op + ".dv"));
      });
}

TEST_CASE("2D rotary embedding: gradient as the reference, for two head sizes") {
  for_each_op({"rope2d", "rope2d_hd24"},
              [](const Safetensors& file, const std::string& op, Context& ctx) {
                const auto dy = heads(file, op + ".dy");
                Tensor<float, 3> dx(dy.shape());
                rope_2d_backward(dx, dy, rope_table(file, dy.extent(2)), ctx);
                check(dx, heads(file, op + ".dx"));
              });
}

TEST_CASE("blocks of the aggregator and of DINOv2: output and all gradients as the reference") {
  for_each_op({"block_global", "block_dino"}, [](const Safetensors& file, const std::string& op,
                                                 Context& ctx) {
    BlockTensors tensors;
    for (const TensorEntry& entry : file.entries()) {
      const std::string prefix = op + ".param.";
      if (!entry.name.starts_with(prefix)) continue;
      const std::string name = entry.name.substr(prefix.size());
      if (entry.shape.size() == 1) tensors.add(name, file.read<1>(entry.name));
      if (entry.shape.size() == 2) tensors.add(name, file.read<2>(entry.name));
    }
    BlockTensors zeros = tensors.zeros();
    const auto weights = tensors.weights();
    const auto gradients = zeros.gradients();
    const RopeTable rope = rope_table(file, 16);
    const BlockSettings settings = op == "block_global" ? BlockSettings{2, 1e-5f, {8, true}, &rope}
                                                        : BlockSettings{2, 1e-6f, {}, nullptr};
    const auto x = file.read<3>(op + ".x"), dy = file.read<3>(op + ".dy");
    Tensor<float, 3> y(x.shape()), dx(x.shape());
    Arena::Scope scope(ctx.arena());
    BlockActivations kept;
    block_forward(y[0], kept, x[0], weights, settings, ctx);
    block_backward(dx[0], gradients, dy[0], kept, weights, settings, ctx);
    check(y, file.read<3>(op + ".y"));
    check(dx, file.read<3>(op + ".dx"));
    for (const std::string& name : tensors.names()) {
      CAPTURE(name);
      const std::string key = op + ".dparam." + name;
      Tensor<float, 1> expected(Shape{file.at(key).size()});
      file.read_into(key, std::span(expected.data(), static_cast<std::size_t>(expected.size())));
      check(zeros.get<float>(name), expected);
    }
  });
}

TEST_CASE("depth and point activations: gradients as the reference") {
  for_each_op({"activate_depth", "activate_points"}, [](const Safetensors& file,
                                                        const std::string& op, Context& ctx) {
    const auto x = channels_last(file.read<4>(op + ".x"));
    const auto dy = file.read<1>(op + ".dy");
    const std::int64_t C = x.extent(3), N = x.size() / C;
    Tensor<float, 4> dx(x.shape());
    const auto dx_rows = dx.view().reshaped(Shape{N, C});
    const auto rows = x.view().reshaped(Shape{N, C});
    const auto dconfidence = dy.view().narrow(0, N * (C - 1), N * C);
    if (op == "activate_depth") {
      depth_activation_backward(dx_rows, dy.view().narrow(0, 0, N), dconfidence, rows, ctx);
    } else {
      point_activation_backward(dx_rows, View<const float, 2>(dy.data(), Shape{N, std::int64_t{3}}),
                                dconfidence, rows, ctx);
    }
    check(dx, channels_last(file.read<4>(op + ".dx")));
  });
}
