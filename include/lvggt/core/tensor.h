// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <memory>
#include <new>
#include <type_traits>
#include <utility>

#include "lvggt/core/error.h"
#include "lvggt/core/reserved_memory.h"
#include "lvggt/core/shape.h"

namespace lvggt {

// Every owned buffer starts on a cache line, which is also the widest vector.
inline constexpr std::size_t kAlignment = 64;

// Borrows an R-dimensional array. The last axis is contiguous, outer axes may be strided, so that a
// slice of channels or a frame is a view too. Passed by value; an empty view (no data) means "not
// given".
template <class T, int R>
class View {
 public:
  View() = default;

  // Dense: row-major without gaps.
  View(T* data, Shape<R> shape) : data_(data), shape_(shape) {
    std::int64_t stride = 1;
    for (int axis = R - 1; axis >= 0; --axis) {
      strides_[static_cast<std::size_t>(axis)] = stride;
      stride *= shape[axis];
    }
  }

  // Strided; strides are in elements and the last one must be 1.
  View(T* data, Shape<R> shape, std::array<std::int64_t, R> strides)
      : data_(data), shape_(shape), strides_(strides) {
    LVGGT_DCHECK(strides.back() == 1);
  }

  // View<float, R> converts to View<const float, R>.
  template <class U>
  requires std::is_same_v<const U, T> View(const View<U, R>& other)
      : data_(other.data()), shape_(other.shape()), strides_(other.strides()) {}

  T* data() const { return data_; }
  const Shape<R>& shape() const { return shape_; }
  const std::array<std::int64_t, R>& strides() const { return strides_; }
  std::int64_t extent(int axis) const { return shape_[axis]; }
  std::int64_t stride(int axis) const { return strides_[static_cast<std::size_t>(axis)]; }
  std::int64_t size() const { return shape_.volume(); }
  bool empty() const { return data_ == nullptr; }
  explicit operator bool() const { return data_ != nullptr; }

  // Drops the leading axis; for R == 1 the element itself.
  decltype(auto) operator[](std::int64_t i) const {
    LVGGT_DCHECK(i >= 0 && i < shape_[0]);
    if constexpr (R == 1) {
      return static_cast<T&>(data_[i]);
    } else {
      Shape<R - 1> shape;
      std::array<std::int64_t, R - 1> strides;
      std::copy(shape_.extents.begin() + 1, shape_.extents.end(), shape.extents.begin());
      std::copy(strides_.begin() + 1, strides_.end(), strides.begin());
      return View<T, R - 1>(data_ + i * strides_[0], shape, strides);
    }
  }

  // One element; for tests and cold code.
  template <class... Indices>
  requires(sizeof...(Indices) == R) T& operator()(Indices... indices) const {
    const std::array<std::int64_t, R> index{static_cast<std::int64_t>(indices)...};
    std::int64_t offset = 0;
    for (std::size_t axis = 0; axis < R; ++axis) offset += index[axis] * strides_[axis];
    return data_[offset];
  }

  // Elements [begin, end) of one axis.
  View narrow(int axis, std::int64_t begin, std::int64_t end) const {
    LVGGT_DCHECK(0 <= begin && begin <= end && end <= shape_[axis]);
    View result = *this;
    result.data_ = data_ + begin * stride(axis);
    result.shape_[axis] = end - begin;
    return result;
  }

  bool dense() const {
    std::int64_t stride = 1;
    for (int axis = R - 1; axis >= 0; --axis) {
      if (shape_[axis] != 1 && strides_[static_cast<std::size_t>(axis)] != stride) return false;
      stride *= shape_[axis];
    }
    return true;
  }

  // The same elements under another shape; only for dense views of equal volume.
  template <int Q>
  View<T, Q> reshaped(Shape<Q> shape) const {
    LVGGT_CHECK(dense() && shape.volume() == size(), "reshape: ", shape_, " cannot become ", shape);
    return View<T, Q>(data_, shape);
  }

 private:
  T* data_ = nullptr;
  Shape<R> shape_{};
  std::array<std::int64_t, R> strides_{};
};

// Owns a dense, 64-byte aligned, zeroed R-dimensional array. Moves; copies only by clone().
template <class T, int R>
class Tensor {
  static_assert(std::is_trivially_copyable_v<T>);

 public:
  Tensor() = default;
  explicit Tensor(Shape<R> shape) : shape_(shape) {
    for (const std::int64_t extent : shape.extents)
      LVGGT_CHECK(extent >= 0, "tensor: shape ", shape, " has a negative extent");
    const std::size_t bytes = std::max<std::size_t>(num_bytes(), 1);
    data_.reset(static_cast<T*>(::operator new (bytes, std::align_val_t{kAlignment})));
    if (bytes >= kHugeMemory) advise_huge_pages(data_.get(), bytes);
    std::memset(static_cast<void*>(data_.get()), 0, num_bytes());
  }
  Tensor(Tensor&& other) noexcept
      : data_(std::move(other.data_)), shape_(std::exchange(other.shape_, Shape<R>{})) {}
  Tensor& operator=(Tensor&& other) noexcept {
    data_ = std::move(other.data_);
    shape_ = std::exchange(other.shape_, Shape<R>{});
    return *this;
  }

  Tensor clone() const {
    Tensor copy(shape_);
    std::memcpy(static_cast<void*>(copy.data()), data(), num_bytes());
    return copy;
  }

  T* data() { return data_.get(); }
  const T* data() const { return data_.get(); }
  const Shape<R>& shape() const { return shape_; }
  std::int64_t extent(int axis) const { return shape_[axis]; }
  std::int64_t size() const { return shape_.volume(); }
  std::size_t num_bytes() const { return static_cast<std::size_t>(size()) * sizeof(T); }
  bool empty() const { return data_ == nullptr; }

  View<T, R> view() { return View<T, R>(data(), shape_); }
  View<const T, R> view() const { return View<const T, R>(data(), shape_); }
  operator View<T, R>() { return view(); }
  operator View<const T, R>() const { return view(); }

  decltype(auto) operator[](std::int64_t i) { return view()[i]; }
  decltype(auto) operator[](std::int64_t i) const { return view()[i]; }
  template <class... Indices>
  T& operator()(Indices... indices) {
    return view()(indices...);
  }
  template <class... Indices>
  const T& operator()(Indices... indices) const {
    return view()(indices...);
  }

 private:
  struct Free {
    void operator()(T* p) const { ::operator delete (p, std::align_val_t{kAlignment}); }
  };
  std::unique_ptr<T, Free> data_;
  Shape<R> shape_{};
};

}  // namespace lvggt
