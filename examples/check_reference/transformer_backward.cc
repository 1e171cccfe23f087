// SPDX-License-Identifier: Apache-2.0
// Backward passes of the geometry encoder's operators, blocks and dense heads' activations.
#include <map>

#include "examples/check_reference/operands.h"
#include "lvggt/kernels/dense_activation_backward.h"
#include "lvggt/train/block.h"

namespace check_reference {
namespace {

using namespace lvggt;

void softmax_gradients(const Operands& o) {
  const Tensor<float, 2> x = o.get<2>("x"), dy = o.get<2>("dy");
  Tensor<float, 2> y(x.shape()), dx(x.shape());
  softmax_forward(y, x, 1, o.ctx());
  softmax_backward(dx, dy, y, 1, o.ctx());
  o.compare(dx, "dx");
}

void attention_gradients(const Operands& o) {
  const Tensor<float, 3> q = o.get_heads("q"), k = o.get_heads("k"), v = o.get_heads("v");
  const Tensor<float, 3> dy = o.get_heads("dy");
  const FrameMask mask = o.op() == "attention_framemask" ? FrameMask{4, true} : FrameMask{};
  Tensor<float, 3> dq(q.shape()), dk(k.shape()), dv(v.shape());
  attention_backward(dq, dk, dv, dy, q, k, v, mask, o.ctx());
  o.compare_heads(dq, "dq");
  o.compare_heads(dk, "dk");
  o.compare_heads(dv, "dv");
}

void rope_gradients(const Operands& o) {
  const Tensor<float, 3> dy = o.get_heads("dy");
  Tensor<float, 3> dx(dy.shape());
  rope_2d_backward(dx, dy, o.rope(dy.extent(2)), o.ctx());
  o.compare_heads(dx, "dx");
}

// A block's parameters, or their gradients, in memory of their own.
template <class T>
class BlockTensors {
 public:
  // Of the tensors PREFIX.NAME in the file, copied or as zeros.
  BlockTensors(const Operands& o, const std::string& prefix, bool zeros) {
    for_each_param(views, [&]<int R>(const std::string& name, View<T, R>& view) {
      if (!o.has(prefix + name)) return;
      const Tensor<float, R> stored = o.get<R>(prefix + name);
      Tensor<float, 1>& values =
          values_.emplace(name, Tensor<float, 1>(Shape{stored.size()})).first->second;
      if (!zeros) std::copy_n(stored.data(), stored.size(), values.data());
      view = View<T, R>(values.data(), stored.shape());
    });
  }

  BlockParameters<T> views;

 private:
  std::map<std::string, Tensor<float, 1>> values_;
};

void block_gradients(const Operands& o) {
  const bool global = o.op() == "block_global";
  const BlockTensors<const float> weights(o, "param.", false);
  const BlockTensors<float> gradients(o, "param.", true);
  const RopeTable rope = o.rope(16);
  BlockSettings settings{.num_heads = 2, .norm_eps = global ? 1e-5f : 1e-6f};
  if (global) {
    settings.mask = {8, true};
    settings.rope = &rope;
  }
  const Tensor<float, 3> x = o.get<3>("x"), dy = o.get<3>("dy");
  const Shape rows{x.extent(1), x.extent(2)};
  Tensor<float, 3> y(x.shape()), dx(x.shape());
  Arena::Scope scope(o.ctx().arena());
  BlockActivations kept;
  block_forward(y.view().reshaped(rows), kept, x.view().reshaped(rows), weights.views, settings,
                o.ctx());
  block_backward(dx.view().reshaped(rows), gradients.views, dy.view().reshaped(rows), kept,
                 weights.views, settings, o.ctx());
  o.compare(dx, "dx");
  for_each_param(gradients.views, [&]<int R>(const std::string& name, const View<float, R>& view) {
    if (view.empty()) return;
    Tensor<float, R> gradient(view.shape());
    std::copy_n(view.data(), view.size(), gradient.data());
    o.compare(gradient, "dparam." + name);
  });
}

// y is the values of all pixels, then the confidences of all pixels.
void dense_activation_gradients(const Operands& o) {
  const Tensor<float, 4> x = o.get_map("x");
  const Tensor<float, 1> dy = o.get<1>("dy");
  const std::int64_t C = x.extent(3), N = x.size() / C;
  Tensor<float, 4> dx(x.shape());
  const View<float, 2> dx_rows = dx.view().reshaped(Shape{N, C});
  const View<const float, 2> rows = x.view().reshaped(Shape{N, C});
  const View<const float, 1> dconfidence = dy.view().narrow(0, N * (C - 1), N * C);
  if (o.op() == "activate_points") {
    point_activation_backward(dx_rows, View<const float, 2>(dy.data(), Shape{N, C - 1}),
                              dconfidence, rows, o.ctx());
  } else {
    depth_activation_backward(dx_rows, dy.view().narrow(0, 0, N), dconfidence, rows, o.ctx());
  }
  o.compare_map(dx, "dx");
}

}  // namespace

void check_transformer_backward(const Operands& o) {
  if (!o.has("dy")) return;
  const auto starts = [&](const char* prefix) { return o.op().starts_with(prefix); };
  if (o.op() == "softmax") return softmax_gradients(o);
  if (starts("attention")) return attention_gradients(o);
  if (starts("rope2d")) return rope_gradients(o);
  if (starts("block_")) return block_gradients(o);
  if (starts("activate_")) return dense_activation_gradients(o);
}

}  // namespace check_reference
