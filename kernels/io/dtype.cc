// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/dtype.h"

#include <bit>
#include <cstring>

#include "lvggt/core/error.h"
#include "lvggt/core/float16.h"

namespace lvggt {
namespace {

static_assert(std::endian::native == std::endian::little,
              "files are little-endian and so are the machines lvggt runs on");

template <class T, class Convert>
void widen(std::span<const std::byte> bytes, std::span<float> out, Convert convert) {
  for (std::size_t i = 0; i < out.size(); ++i) {
    T value;
    std::memcpy(&value, bytes.data() + i * sizeof(T), sizeof(T));
    out[i] = convert(value);
  }
}

template <class T, class Convert>
void narrow(std::span<const float> values, std::span<std::byte> out, Convert convert) {
  for (std::size_t i = 0; i < values.size(); ++i) {
    const T value = convert(values[i]);
    std::memcpy(out.data() + i * sizeof(T), &value, sizeof(T));
  }
}

void check_sizes(Dtype dtype, std::size_t num_values, std::size_t num_bytes) {
  LVGGT_CHECK(num_bytes / static_cast<std::size_t>(dtype_size(dtype)) == num_values,
              "conversion of ", num_values, " values of ", dtype_name(dtype), " with ", num_bytes,
              " bytes");
}

[[noreturn]] void fail_integer(Dtype dtype) {
  fail(ErrorKind::kMismatch, "values of ", dtype_name(dtype),
       " where floating-point numbers are expected");
}

}  // namespace

void to_float32(Dtype dtype, std::span<const std::byte> bytes, std::span<float> out) {
  check_sizes(dtype, out.size(), bytes.size());
  switch (dtype) {
    case Dtype::kF32:
      if (!out.empty()) std::memcpy(out.data(), bytes.data(), bytes.size());
      return;
    case Dtype::kF16:
      return widen<float16>(bytes, out, [](float16 x) { return to_float(x); });
    case Dtype::kBF16:
      return widen<bfloat16>(bytes, out, [](bfloat16 x) { return to_float(x); });
    case Dtype::kF64:
      return widen<double>(bytes, out, [](double x) { return static_cast<float>(x); });
    default:
      fail_integer(dtype);
  }
}

void from_float32(Dtype dtype, std::span<const float> values, std::span<std::byte> out) {
  check_sizes(dtype, values.size(), out.size());
  switch (dtype) {
    case Dtype::kF32:
      if (!out.empty()) std::memcpy(out.data(), values.data(), out.size());
      return;
    case Dtype::kF16:
      return narrow<float16>(values, out, to_float16);
    case Dtype::kBF16:
      return narrow<bfloat16>(values, out, to_bfloat16);
    case Dtype::kF64:
      return narrow<double>(values, out, [](float x) { return double{x}; });
    default:
      fail_integer(dtype);
  }
}

}  // namespace lvggt
