// SPDX-License-Identifier: Apache-2.0
// Single operators: every output is computed from the inputs in the file by the engine's own
// operator.
#include <algorithm>
#include <cmath>

#include "examples/check_reference/cases.h"
#include "examples/check_reference/operands.h"
#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/batch_norm2d.h"

namespace check_reference {
namespace {

using namespace lvggt;

void check_linear(const Operands& o) {
  const Tensor<float, 2> x = o.get<2>("x"), w = o.get<2>("w");
  const Linear layer{pack_linear(w), o.get_if_there("b")};
  Tensor<float, 2> y(Shape{x.extent(0), w.extent(0)});
  const auto activation = o.op() == "linear_gelu" ? Activation::kGelu : Activation::kNone;
  linear_forward(y, x, layer, {.activation = activation}, o.ctx());
  o.compare(y);
}

void check_activation(const Operands& o, Activation activation) {
  const Tensor<float, 2> x = o.get<2>("x");
  Tensor<float, 2> y(x.shape());
  activation_forward(y, x, activation, o.ctx());
  o.compare(y);
}

// The softmax lives inside of attention: with identity keys and values, attention is the softmax of
// the query.
void check_softmax(const Operands& o) {
  const Tensor<float, 2> x = o.get<2>("x");
  const auto [N, D] = x.shape();
  Tensor<float, 3> identity(Shape{D, std::int64_t{1}, D}), y(Shape{N, std::int64_t{1}, D});
  for (std::int64_t i = 0; i < D; ++i) identity(i, std::int64_t{0}, i) = 1;
  Arena::Scope scope(o.ctx().arena());
  const PackedKeysValues packed = alloc_keys_values(1, D, D, o.ctx());
  pack_keys_values(packed, identity, identity, o.ctx());
  scaled_dot_product_attention(y, x.view().reshaped(y.shape()), std::span(&packed, 1), 1.0f,
                               o.ctx());
  o.compare(y);
}

void check_layer_norm(const Operands& o) {
  const Tensor<float, 2> x = o.get<2>("x");
  const LayerNorm norm{o.get_if_there("w"), o.get_if_there("b"),
                       o.op().ends_with("eps1e-6") ? 1e-6f : 1e-5f};
  Tensor<float, 2> y(x.shape());
  layer_norm_forward(y, x, norm, o.ctx());
  o.compare(y);
}

void check_conv2d(const Operands& o) {
  const Tensor<float, 4> x = o.get_map("x"), w = o.get<4>("w");
  const auto [stride, padding] = o.stride_and_padding();
  const Tensor<float, 1> bias = o.get_if_there("b");
  Tensor<float, 4> y(Shape{x.extent(0), conv2d_extent(x.extent(1), w.extent(2), stride, padding),
                           conv2d_extent(x.extent(2), w.extent(2), stride, padding), w.extent(0)});
  conv2d_forward(y, x, pack_conv2d(w, stride, padding), {.bias = view_or_empty(bias)}, o.ctx());
  o.compare_map(y);
}

void check_conv_transpose2d(const Operands& o) {
  const Tensor<float, 4> x = o.get_map("x"), w = o.get<4>("w");
  const Tensor<float, 1> bias = o.get_if_there("b");
  const std::int64_t k = w.extent(2);
  Tensor<float, 4> y(Shape{x.extent(0), k * x.extent(1), k * x.extent(2), w.extent(1)});
  conv_transpose2d_forward(y, x, pack_conv_transpose2d(w), view_or_empty(bias), o.ctx());
  o.compare_map(y);
}

// In training a batch norm takes the statistics of the batch, which move the running ones.
// Inference folds it into the convolution before it; here that is the identity.
void check_batch_norm(const Operands& o) {
  constexpr float kEps = 1e-5f, kMomentum = 0.1f;
  const Tensor<float, 4> x = o.get_map("x");
  const std::int64_t C = x.extent(3);
  const Tensor<float, 1> gamma = o.get<1>("w"), beta = o.get<1>("b");
  Tensor<float, 1> mean = o.get<1>("running_mean_in"), var = o.get<1>("running_var_in");
  Tensor<float, 4> y(x.shape());
  if (o.op().ends_with("_train")) {
    Tensor<float, 1> batch_mean(Shape{C}), batch_rstd(Shape{C});
    batch_norm2d_forward(y, batch_mean, batch_rstd, mean, var, x, gamma, beta, kEps, kMomentum,
                         Activation::kNone, o.ctx());
  } else {
    Tensor<float, 4> weight(Shape{C, C, std::int64_t{1}, std::int64_t{1}});
    for (std::int64_t c = 0; c < C; ++c) weight(c, c, 0, 0) = 1;
    Tensor<float, 1> bias(Shape{C});
    batch_norm2d_fold(weight, bias, gamma, beta, mean, var, kEps);
    conv2d_forward(y, x, pack_conv2d(weight, 1, 0), {.bias = bias.view()}, o.ctx());
  }
  o.compare_map(y);
  o.compare(mean, "running_mean_out");
  o.compare(var, "running_var_out");
}

void check_bilinear(const Operands& o) {
  const Tensor<float, 4> x = o.get_map("x");
  Tensor<float, 4> y(o.output_shape());
  bilinear_forward(y, x, o.op().starts_with("bilinear_ac1"), o.ctx());
  o.compare_map(y);
}

void check_bicubic(const Operands& o) {
  const Tensor<float, 4> x = o.get_map("x");
  Tensor<float, 4> y(o.output_shape());
  for (std::int64_t b = 0; b < x.extent(0); ++b) bicubic_antialias_forward(y[b], x[b], o.ctx());
  o.compare_map(y);
}

void check_attention(const Operands& o) {
  const Tensor<float, 3> q = o.get_heads("q"), k = o.get_heads("k"), v = o.get_heads("v");
  Tensor<float, 3> y(q.shape());
  Arena::Scope scope(o.ctx().arena());
  if (o.op() == "attention_framemask") {
    attend_across_frames(y, q, k, v, 3, BatchMode::kCausal, o.ctx());
  } else {
    const PackedKeysValues packed =
        alloc_keys_values(k.extent(1), k.extent(0), k.extent(2), o.ctx());
    pack_keys_values(packed, k, v, o.ctx());
    scaled_dot_product_attention(y, q, std::span(&packed, 1), o.ctx());
  }
  o.compare_heads(y);
}

void check_rope(const Operands& o) {
  const Tensor<float, 3> x = o.get_heads("x");
  Tensor<float, 3> y(x.shape());
  rope_2d_forward(y, x, o.rope(x.extent(2)), o.ctx());
  o.compare_heads(y);
}

void accept_parameters(Comparison& comparison, const std::string& op) {
  for (const TensorEntry& entry : comparison.file().entries())
    if (entry.name.starts_with(op + ".param.")) comparison.accept(entry.name);
}

void check_block(const Operands& o, const RopeTable* rope) {
  const bool global = rope != nullptr;
  const Block block = load_block(o.file(), o.op() + ".param", 2, global, global ? 1e-5 : 1e-6);
  Tensor<float, 3> x = o.get<3>("x");
  const View<float, 2> tokens = x.view().reshaped(Shape{x.extent(1), x.extent(2)});
  const std::int64_t frames = global ? 2 : 1;
  const auto attend = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                          View<const float, 3> v) {
    attend_across_frames(y, q, k, v, frames, BatchMode::kCausal, o.ctx());
  };
  block_forward(tokens, block, {.attend = attend, .rope = rope}, o.ctx());
  o.compare(x);
}

void check_residual_conv_unit(const Operands& o) {
  const std::string prefix = o.op() + ".param";
  const ResidualConvUnit unit{load_conv2d(o.file(), prefix + ".conv1", 1, 1),
                              load_conv2d(o.file(), prefix + ".conv2", 1, 1)};
  Tensor<float, 4> x = o.get_map("x");
  Tensor<float, 4> scratch(x.shape());
  for (std::int64_t b = 0; b < x.extent(0); ++b)
    residual_conv_unit_forward(x[b], scratch[b], unit, o.ctx());
  o.compare_map(x);
}

void check_fusion_block(const Operands& o) {
  const bool with_skip = o.has("skip");
  const FusionBlock block = load_fusion_block(o.file(), o.op() + ".param", with_skip);
  Tensor<float, 4> x = o.get_map("x"), y(o.output_shape());
  Tensor<float, 4> skip = with_skip ? o.get_map("skip") : Tensor<float, 4>();
  for (std::int64_t b = 0; b < x.extent(0); ++b)
    fusion_block_forward(y[b], x[b], with_skip ? skip[b] : View<float, 3>(), block, o.ctx());
  o.compare_map(y);
}

// The sizes and the frame of the two grids are stated in the reference's description.
void check_uv_grid(const Operands& o, double frame_height, double frame_width) {
  const std::vector<std::int64_t>& shape = o.file().at(o.op() + ".y").shape;
  const double aspect = frame_width / frame_height, diagonal = std::sqrt(aspect * aspect + 1);
  Tensor<float, 3> y(Shape{shape.at(0), shape.at(1), std::int64_t{2}});
  for (std::int64_t i = 0; i < shape[0]; ++i) {
    for (std::int64_t j = 0; j < shape[1]; ++j) {
      y(i, j, 0) = static_cast<float>(uv_coordinate(aspect / diagonal, j, shape[1]));
      y(i, j, 1) = static_cast<float>(uv_coordinate(1 / diagonal, i, shape[0]));
    }
  }
  o.compare(y);
}

void check_uv_embed(const Operands& o, Comparison& comparison) {
  comparison.accept(o.op() + ".args");
  const std::vector<std::int64_t> args = o.file().read_int64(o.op() + ".args");  // h, w, C, H, W
  LVGGT_CHECK(args.size() == 5, o.file().path(), ": ", o.op(), ".args does not have 5 values");
  const double aspect = static_cast<double>(args[4]) / static_cast<double>(args[3]);
  Tensor<float, 3> map(Shape{args[0], args[1], args[2]}), planes(Shape{args[2], args[0], args[1]});
  add_position_embedding(map, make_position_embedding(args[0], args[1], args[2], aspect, 0.1),
                         o.ctx());
  to_planes(planes, map, o.ctx());
  o.compare(planes);
}

// y = the values of all pixels, then the confidences of all pixels.
void check_dense_activation(const Operands& o, bool points) {
  const Tensor<float, 4> x = o.get_map("x");
  const std::int64_t C = x.extent(3), N = x.size() / C;
  const View<const float, 2> rows = x.view().reshaped(Shape{N, C});
  Tensor<float, 1> y(Shape{x.size()});
  const View<float, 1> confidence = y.view().narrow(0, N * (C - 1), N * C);
  if (points) {
    point_activation(View<float, 2>(y.data(), Shape{N, C - 1}), confidence, rows, o.ctx());
  } else {
    depth_activation(y.view().narrow(0, 0, N), confidence, rows, o.ctx());
  }
  o.compare(y);
}

void check_cameras(const Operands& o, Comparison& comparison) {
  const Tensor<float, 2> encodings = o.get<2>("pose_enc");
  const std::vector<std::int64_t> size = o.file().read_int64("camera.image_size_hw");
  comparison.accept("camera.image_size_hw");
  LVGGT_CHECK(size.size() == 2, o.file().path(), ": camera.image_size_hw does not have 2 values");
  const std::int64_t N = encodings.extent(0);
  Tensor<float, 3> extrinsics(Shape{N, std::int64_t{3}, std::int64_t{4}});
  Tensor<float, 3> intrinsics(Shape{N, std::int64_t{3}, std::int64_t{3}});
  Tensor<float, 2> quaternions(Shape{N, std::int64_t{4}}), roundtrip(Shape{N, kPoseEncodingSize});
  const bool unprojects = comparison.wants("unproject.depth");
  const Tensor<float, 3> depth =
      unprojects ? o.file().read<3>("unproject.depth") : Tensor<float, 3>();
  comparison.accept("unproject.depth");
  Tensor<float, 4> points;
  if (unprojects)
    points = Tensor<float, 4>(Shape{N, depth.extent(1), depth.extent(2), std::int64_t{3}});
  for (std::int64_t n = 0; n < N; ++n) {
    const Camera camera = camera_as_encoded(encodings[n], size[0], size[1]);
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column < 4; ++column)
        extrinsics(n, row, column) = camera.cam_from_world(row, column);
    const float k[9] = {camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1};
    std::copy_n(k, 9, intrinsics[n].data());
    const Eigen::Vector4d q =
        quaternion_from_rotation(camera.cam_from_world.leftCols<3>().cast<double>());
    for (int i = 0; i < 4; ++i) quaternions(n, i) = static_cast<float>(q[i]);
    const auto encoded = encode_pose(camera, size[0], size[1]);
    std::copy(encoded.begin(), encoded.end(), roundtrip[n].data());
    if (unprojects) unproject(points[n], depth[n], camera, o.ctx());
  }
  o.compare(extrinsics, "extrinsics");
  o.compare(intrinsics, "intrinsics");
  o.compare(quaternions, "quat_from_matrix");
  o.compare(roundtrip, "pose_enc_roundtrip");
  if (unprojects) comparison.compare("unproject.y", points);
}

void check_op(Comparison& comparison, const std::string& op, Context& ctx) {
  const Operands o(comparison, op, ctx);
  const auto starts = [&](const char* prefix) { return op.starts_with(prefix); };
  accept_parameters(comparison, op);
  if (starts("linear")) return check_linear(o);
  if (op == "gelu") return check_activation(o, Activation::kGelu);
  if (op == "silu") return check_activation(o, Activation::kSilu);
  if (op == "relu") return check_activation(o, Activation::kRelu);
  if (op == "sigmoid") return check_activation(o, Activation::kSigmoid);
  if (op == "softmax") return check_softmax(o);
  if (starts("layernorm")) return check_layer_norm(o);
  if (starts("convT")) return check_conv_transpose2d(o);
  if (starts("conv")) return check_conv2d(o);
  if (starts("batchnorm")) return check_batch_norm(o);
  if (starts("bilinear")) return check_bilinear(o);
  if (starts("bicubic")) return check_bicubic(o);
  if (starts("attention")) return check_attention(o);
  if (starts("rope2d")) return check_rope(o);
  if (op == "block_global") {
    const RopeTable rope = o.rope(16);
    return check_block(o, &rope);
  }
  if (op == "block_dino") return check_block(o, nullptr);
  if (op == "residual_conv_unit") return check_residual_conv_unit(o);
  if (starts("fusion_block")) return check_fusion_block(o);
  if (op == "uv_grid_small") return check_uv_grid(o, 70, 98);
  if (op == "uv_grid_full") return check_uv_grid(o, 30, 42);
  if (starts("uv_embed")) return check_uv_embed(o, comparison);
  if (op == "activate_depth") return check_dense_activation(o, false);
  if (op == "activate_points") return check_dense_activation(o, true);
  if (op == "camera") return check_cameras(o, comparison);
  if (starts("loss_")) return check_loss(o, comparison);
}

}  // namespace

void check_ops(Comparison& comparison, Context& ctx) {
  std::set<std::string> ops;
  for (const TensorEntry& entry : comparison.file().entries())
    ops.insert(entry.name.substr(0, entry.name.find('.')));
  if (ops.erase("adamw") > 0) check_adamw(comparison, ctx);
  for (const std::string& op : ops) {
    const Operands operands(comparison, op, ctx);
    check_op(comparison, op, ctx);
    check_op_backward(operands);
    check_transformer_backward(operands);
  }
}

}  // namespace check_reference
