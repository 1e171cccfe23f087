// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <ostream>
#include <utility>

namespace lvggt {

// Extents of an R-dimensional array, outermost first. Unpacks as `const auto [S, P, C] =
// x.shape();`.
template <int R>
struct Shape {
  static_assert(R >= 1);
  std::array<std::int64_t, R> extents{};

  constexpr std::int64_t operator[](int axis) const {
    return extents[static_cast<std::size_t>(axis)];
  }
  constexpr std::int64_t& operator[](int axis) { return extents[static_cast<std::size_t>(axis)]; }

  // Number of elements.
  constexpr std::int64_t volume() const {
    std::int64_t n = 1;
    for (const std::int64_t e : extents) n *= e;
    return n;
  }

  friend constexpr bool operator==(const Shape&, const Shape&) = default;

  friend std::ostream& operator<<(std::ostream& out, const Shape& shape) {
    const char* separator = "[";
    for (const std::int64_t e : shape.extents) {
      out << separator << e;
      separator = ",";
    }
    return out << "]";
  }

  template <std::size_t I>
  constexpr std::int64_t get() const {
    return extents[I];
  }
};

template <class... Extents>
Shape(Extents...) -> Shape<static_cast<int>(sizeof...(Extents))>;

}  // namespace lvggt

template <int R>
struct std::tuple_size<lvggt::Shape<R>>
    : std::integral_constant<std::size_t, static_cast<std::size_t>(R)> {};
template <std::size_t I, int R>
struct std::tuple_element<I, lvggt::Shape<R>> {
  using type = std::int64_t;
};
