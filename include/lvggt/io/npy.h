// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <concepts>
#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/io/dtype.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/limits.h"

namespace lvggt {

// Longest header of a .npy file; numpy writes 64 to 128 bytes for an array of numbers.
inline constexpr std::int64_t kMaxNpyHeaderBytes = 65536;

// One array of numbers in a numpy file (.npy, format 1.0, 2.0 or 3.0): booleans, integers and
// floats of any width up to 64 bits, little-endian, in C or Fortran order. open() reads the header
// only and checks it against the size of the file; the header is parsed as the one form numpy
// writes, nothing in it is ever evaluated. Values are read on demand in row-major order, whatever
// their order in the file, from a file that is not mapped (see InputFile). Reads may come from
// several threads.
//
// Errors: kRead (missing, not a regular file, changed meanwhile), kFormat (breaks the format, or
// has fewer or more bytes than its shape), kUnsupported (objects, structures, text, dates, complex
// numbers, big-endian; another version), kLimit, kMismatch (another rank or size than asked for).
class NpyFile {
 public:
  explicit NpyFile(const std::string& path, const Limits& limits = {});

  const std::string& path() const { return file_.path(); }
  Dtype dtype() const { return dtype_; }
  const std::vector<std::int64_t>& shape() const { return shape_; }  // empty for a scalar
  std::int64_t size() const { return size_; }                        // elements
  bool fortran_order() const { return fortran_order_; }

  // Elements [first, first + out.size()) as float32; integers and doubles are rounded.
  void read_part(std::int64_t first, std::span<float> out) const;

  // The same as integers. Floating-point values must be whole numbers within 53 bits and U64 ones
  // at most 2^63 - 1: kFormat, naming the element, if they are not.
  void read_part(std::int64_t first, std::span<std::int64_t> out) const;

  // The whole array as float32; its rank must be R.
  template <int R>
  Tensor<float, R> read() const {
    check_rank(R);
    Shape<R> shape;
    for (int axis = 0; axis < R; ++axis) shape[axis] = shape_[static_cast<std::size_t>(axis)];
    Tensor<float, R> values(shape);
    read_part(0, std::span<float>(values.data(), static_cast<std::size_t>(values.size())));
    return values;
  }

 private:
  void parse(const std::string& header);
  void check_rank(int rank) const;
  std::vector<std::byte> stored(std::int64_t first, std::size_t num) const;

  InputFile file_;
  Dtype dtype_ = Dtype::kF32;
  std::vector<std::int64_t> shape_;
  std::int64_t size_ = 0;
  std::int64_t data_offset_ = 0;
  bool fortran_order_ = false;
};

// Writes a row-major array as .npy, which appears under its name when complete. bytes.size() must
// be that of the shape. BF16, which numpy has no name for, is a kUnsupported error.
void write_npy(const std::string& path, Dtype dtype, std::span<const std::int64_t> shape,
               std::span<const std::byte> bytes);

template <class T>
constexpr Dtype npy_dtype() {
  if constexpr (std::same_as<T, float>) return Dtype::kF32;
  if constexpr (std::same_as<T, double>) return Dtype::kF64;
  if constexpr (std::same_as<T, std::int8_t>) return Dtype::kI8;
  if constexpr (std::same_as<T, std::uint8_t>) return Dtype::kU8;
  if constexpr (std::same_as<T, std::int16_t>) return Dtype::kI16;
  if constexpr (std::same_as<T, std::uint16_t>) return Dtype::kU16;
  if constexpr (std::same_as<T, std::int32_t>) return Dtype::kI32;
  if constexpr (std::same_as<T, std::uint32_t>) return Dtype::kU32;
  if constexpr (std::same_as<T, std::int64_t>) return Dtype::kI64;
  if constexpr (std::same_as<T, std::uint64_t>) return Dtype::kU64;
}

// The same for a dense view.
template <class T, int R>
void write_npy(const std::string& path, View<const T, R> values) {
  LVGGT_CHECK(values.dense(), "npy: ", path, ": the array has gaps between its rows");
  const auto& extents = values.shape().extents;
  write_npy(path, npy_dtype<T>(), extents,
            std::as_bytes(std::span(values.data(), static_cast<std::size_t>(values.size()))));
}
template <class T, int R>
void write_npy(const std::string& path, const Tensor<T, R>& values) {
  write_npy(path, values.view());
}

}  // namespace lvggt
