// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <bit>
#include <cstdint>
#include <limits>
#include <vector>

#include "lvggt/core/tensor.h"
#include "tests/support/compare.h"

namespace lvggt::test {

// A view with an unaligned start and gaps behind every axis but the last, inside a buffer whose
// every other element is NaN: reading one spoils the result, writing one is seen by
// gaps_untouched().
template <int R>
class Strided {
 public:
  explicit Strided(Shape<R> shape, std::int64_t offset = 1, std::int64_t gap = 3) {
    std::array<std::int64_t, R> strides;
    std::int64_t stride = 1;
    for (int axis = R - 1; axis >= 0; --axis) {
      strides[static_cast<std::size_t>(axis)] = stride;
      stride = stride * shape[axis] + gap;
    }
    buffer_.assign(static_cast<std::size_t>(offset + stride),
                   std::numeric_limits<float>::quiet_NaN());
    view_ = View<float, R>(buffer_.data() + offset, shape, strides);
  }

  explicit Strided(View<const float, R> values) : Strided(values.shape()) {
    for (std::int64_t n = 0; n < values.size(); ++n) {
      const Shape<R> index = unflatten(n, values.shape());
      element(view_, index) = element(values, index);
    }
  }

  View<float, R> view() { return view_; }

  // True if everything outside of the view still is the NaN it was.
  bool gaps_untouched() const {
    std::vector<bool> inside(buffer_.size());
    for (std::int64_t n = 0; n < view_.size(); ++n)
      inside[static_cast<std::size_t>(&element(view_, unflatten(n, view_.shape())) -
                                      buffer_.data())] = true;
    const auto nan = std::bit_cast<std::uint32_t>(std::numeric_limits<float>::quiet_NaN());
    for (std::size_t i = 0; i < buffer_.size(); ++i)
      if (!inside[i] && std::bit_cast<std::uint32_t>(buffer_[i]) != nan) return false;
    return true;
  }

 private:
  std::vector<float> buffer_;
  View<float, R> view_;
};

}  // namespace lvggt::test
