// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdlib>
#include <string>
#include <utility>
#include <vector>

#include "examples/check_reference/comparison.h"

namespace check_reference {

// Reads the operands of one operator, maps as channels last.
class Operands {
 public:
  Operands(Comparison& comparison, const std::string& op, lvggt::Context& ctx)
      : comparison_(comparison), op_(op), ctx_(ctx) {}

  lvggt::Context& ctx() const { return ctx_; }
  const std::string& op() const { return op_; }
  const lvggt::Safetensors& file() const { return comparison_.file(); }
  bool has(const std::string& name) const { return comparison_.wants(op_ + "." + name); }

  template <int R>
  lvggt::Tensor<float, R> get(const std::string& name) const {
    comparison_.accept(op_ + "." + name);
    return file().read<R>(op_ + "." + name);
  }
  lvggt::Tensor<float, 1> get_if_there(const std::string& name) const {
    return has(name) ? get<1>(name) : lvggt::Tensor<float, 1>();
  }
  // [B, C, H, W] as [B, H, W, C], or rows [N, C] as [1, 1, N, C]
  lvggt::Tensor<float, 4> get_map(const std::string& name) const {
    if (rank(name) == 2) {
      const lvggt::Tensor<float, 2> rows = get<2>(name);
      lvggt::Tensor<float, 4> map(
          lvggt::Shape{std::int64_t{1}, std::int64_t{1}, rows.extent(0), rows.extent(1)});
      std::copy_n(rows.data(), rows.size(), map.data());
      return map;
    }
    const lvggt::Tensor<float, 4> planes = get<4>(name);
    const auto [B, C, H, W] = planes.shape();
    lvggt::Tensor<float, 4> map(lvggt::Shape{B, H, W, C});
    for (std::int64_t b = 0; b < B; ++b) lvggt::from_planes(map[b], planes[b], ctx_);
    return map;
  }
  // [1, heads, N, D] as [N, heads, D]
  lvggt::Tensor<float, 3> get_heads(const std::string& name) const {
    const lvggt::Tensor<float, 4> x = get<4>(name);
    lvggt::Tensor<float, 3> y(lvggt::Shape{x.extent(2), x.extent(1), x.extent(3)});
    for (std::int64_t head = 0; head < x.extent(1); ++head)
      for (std::int64_t n = 0; n < x.extent(2); ++n)
        std::copy_n(&x(std::int64_t{0}, head, n, std::int64_t{0}), x.extent(3),
                    &y(n, head, std::int64_t{0}));
    return y;
  }
  // The angles of rope2d.positions.
  lvggt::RopeTable rope(std::int64_t head_dim) const {
    comparison_.accept("rope2d.positions");
    const std::vector<std::int64_t> values = file().read_int64("rope2d.positions");
    lvggt::Tensor<std::int64_t, 2> positions(lvggt::Shape{std::ssize(values) / 2, std::int64_t{2}});
    std::copy(values.begin(), values.end(), positions.data());
    return lvggt::make_rope_table(positions, head_dim, 100);
  }
  lvggt::Shape<4> output_shape() const {  // [B, H, W, C] of the file's [B, C, H, W]
    const std::vector<std::int64_t>& s = file().at(op_ + ".y").shape;
    LVGGT_CHECK(s.size() == 4, file().path(), ": ", op_, ".y is ", lvggt::shape_text(s),
                ", not a map");
    return {s[0], s[2], s[3], s[1]};
  }

  // Of a convolution. Names carry kernel, stride and padding: conv3x3_s2p1_odd, conv1x1,
  // conv14x14_s14.
  std::pair<std::int64_t, std::int64_t> stride_and_padding() const {
    const std::size_t at = op_.find("_s");
    return {at == std::string::npos ? 1 : std::atoll(op_.c_str() + at + 2),
            op_.find("p1") != std::string::npos ? 1 : 0};
  }

  template <int R>
  void compare(const lvggt::Tensor<float, R>& y, const std::string& name = "y") const {
    comparison_.compare(op_ + "." + name, y);
  }
  void compare_map(const lvggt::Tensor<float, 4>& map, const std::string& name = "y") const {
    if (rank(name) == 2) return compare(map, name);
    const auto [B, H, W, C] = map.shape();
    lvggt::Tensor<float, 4> planes(lvggt::Shape{B, C, H, W});
    for (std::int64_t b = 0; b < B; ++b) lvggt::to_planes(planes[b], map[b], ctx_);
    compare(planes, name);
  }
  void compare_heads(const lvggt::Tensor<float, 3>& y, const std::string& name = "y") const {
    const auto [N, heads, D] = y.shape();
    lvggt::Tensor<float, 3> dump(lvggt::Shape{heads, N, D});
    for (std::int64_t n = 0; n < N; ++n)
      for (std::int64_t head = 0; head < heads; ++head)
        std::copy_n(&y(n, head, std::int64_t{0}), D, &dump(head, n, std::int64_t{0}));
    compare(dump, name);
  }

 private:
  std::size_t rank(const std::string& name) const {
    return file().at(op_ + "." + name).shape.size();
  }

  Comparison& comparison_;
  std::string op_;
  lvggt::Context& ctx_;
};

// The backward part of one operator: its gradients are computed from <op>.dy and the operands, and
// compared. An operator that has none here is left alone. Those of the geometry encoder have a
// function of their own.
void check_op_backward(const Operands& operands);
void check_transformer_backward(const Operands& operands);

// loss_*: values and gradients.   The mask of the masked ones is loss_mask.m.
void check_loss(const Operands& operands, Comparison& comparison);

}  // namespace check_reference
