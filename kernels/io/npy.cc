// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/npy.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <limits>
#include <type_traits>

#include "kernels/io/npy_header.h"
#include "lvggt/core/float16.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/checked.h"

namespace lvggt {

namespace {

constexpr std::string_view kMagic = "\x93NUMPY";
constexpr std::int64_t kPreambleBytes = 8;  // magic and version

// Calls body(T{}) with the C++ type that stores elements of this type; F16 as float16.
template <class Body>
void with_type(Dtype dtype, Body&& body) {
  switch (dtype) {
    case Dtype::kF32:
      return body(float{});
    case Dtype::kF64:
      return body(double{});
    case Dtype::kF16:
      return body(float16{});
    case Dtype::kI8:
      return body(std::int8_t{});
    case Dtype::kBool:
    case Dtype::kU8:
      return body(std::uint8_t{});
    case Dtype::kI16:
      return body(std::int16_t{});
    case Dtype::kU16:
      return body(std::uint16_t{});
    case Dtype::kI32:
      return body(std::int32_t{});
    case Dtype::kU32:
      return body(std::uint32_t{});
    case Dtype::kI64:
      return body(std::int64_t{});
    case Dtype::kU64:
      return body(std::uint64_t{});
    case Dtype::kBF16:
      break;  // no .npy file has it
  }
}

template <class T>
T load(const std::byte* bytes) {
  T value;
  std::memcpy(&value, bytes, sizeof(T));
  return value;
}

template <class T>
float as_float(T value) {
  if constexpr (std::is_same_v<T, float16>)
    return to_float(value);
  else
    return static_cast<float>(value);
}

// Whether a stored value is a whole number that int64 holds.
template <class T>
bool as_int64(T value, std::int64_t& out) {
  if constexpr (std::is_same_v<T, float16>) {
    return as_int64(to_float(value), out);
  } else if constexpr (std::is_floating_point_v<T>) {
    constexpr T kLargest = static_cast<T>(std::int64_t{1} << 53);
    if (!(value >= -kLargest && value <= kLargest)) return false;
    out = static_cast<std::int64_t>(value);
    return static_cast<T>(out) == value;
  } else if constexpr (std::is_same_v<T, std::uint64_t>) {
    out = static_cast<std::int64_t>(value);
    return value <= static_cast<std::uint64_t>(std::numeric_limits<std::int64_t>::max());
  } else {
    out = value;
    return true;
  }
}

// Where element `idx`, counted in row-major order, stands in column-major order.
std::int64_t fortran_index(std::int64_t idx, const std::vector<std::int64_t>& shape) {
  std::int64_t result = 0, stride = 1;
  std::int64_t rest = 1;
  for (const std::int64_t extent : shape) rest = size_product(rest, extent);
  for (const std::int64_t extent : shape) {
    rest /= extent;
    result += idx / rest * stride;
    idx %= rest;
    stride *= extent;
  }
  return result;
}

}  // namespace

NpyFile::NpyFile(const std::string& path, const Limits& limits) : file_(path) {
  std::array<unsigned char, 12> preamble{};
  const std::int64_t available = std::min<std::int64_t>(file_.size(), preamble.size());
  file_.read_at(0, preamble.data(), static_cast<std::size_t>(available));
  if (file_.size() == 0)
    fail(ErrorKind::kFormat, path, " is empty, but a numpy array (.npy) is expected");
  if (available < kPreambleBytes ||
      std::memcmp(preamble.data(), kMagic.data(), kMagic.size()) != 0) {
    const std::string hint = content_hint(
        {reinterpret_cast<const char*>(preamble.data()), static_cast<std::size_t>(available)});
    fail(ErrorKind::kFormat, path, " does not start as a numpy array (.npy) does",
         hint.empty() ? "" : "; ", hint);
  }
  const int major = preamble[6], minor = preamble[7];
  if (major < 1 || major > 3 || minor != 0)
    fail(ErrorKind::kUnsupported, path, ": is .npy format ", major, ".", minor,
         ", but 1.0, 2.0 and 3.0 are read");
  const std::int64_t length_bytes = major == 1 ? 2 : 4;
  std::int64_t header_bytes = 0;
  for (std::int64_t i = length_bytes; i-- > 0;)
    header_bytes = header_bytes << 8 | preamble[static_cast<std::size_t>(kPreambleBytes + i)];
  data_offset_ = kPreambleBytes + length_bytes + header_bytes;
  if (data_offset_ > file_.size())
    fail(ErrorKind::kFormat, path, ": its .npy header of ", header_bytes,
         " bytes reaches beyond the end of the file of ", file_.size(), " bytes");
  if (header_bytes > kMaxNpyHeaderBytes)
    fail(ErrorKind::kLimit, path, ": its .npy header has ", header_bytes,
         " bytes, more than the limit of ", kMaxNpyHeaderBytes);
  std::string header(static_cast<std::size_t>(header_bytes), '\0');
  file_.read_at(kPreambleBytes + length_bytes, header.data(), header.size());
  detail::NpyHeader parsed = detail::parse_npy_header(header, path, limits);
  dtype_ = parsed.dtype;
  fortran_order_ = parsed.fortran_order && parsed.shape.size() > 1;
  shape_ = std::move(parsed.shape);

  const auto volume = checked_volume(shape_);
  const auto bytes = volume ? checked_mul(*volume, dtype_size(dtype_)) : std::nullopt;
  if (!bytes) fail(ErrorKind::kFormat, path, ": its shape has more elements than 63 bits count");
  const std::int64_t found = file_.size() - data_offset_;
  if (found != *bytes)
    fail(ErrorKind::kFormat, path, ": has ", found, " bytes of data, but ", *volume,
         " elements of type ", dtype_name(dtype_), " take ", *bytes,
         found < *bytes ? "; the file is cut short" : "");
  size_ = *volume;
}

void NpyFile::check_rank(int rank) const {
  LVGGT_CHECK(shape_.size() == static_cast<std::size_t>(rank), path(), ": has ", shape_.size(),
              " dimensions, but ", rank, " are expected");
}

// The stored bytes of elements [first, first + num) in row-major order.
std::vector<std::byte> NpyFile::stored(std::int64_t first, std::size_t num) const {
  LVGGT_CHECK(first >= 0 && first <= size_ && static_cast<std::int64_t>(num) <= size_ - first,
              path(), ": elements ", first, " to ", first + static_cast<std::int64_t>(num),
              " are asked for, but it has ", size_);
  const std::int64_t element = dtype_size(dtype_);
  const auto width = static_cast<std::size_t>(element);
  std::vector<std::byte> bytes(num * width);
  if (!fortran_order_) {
    file_.read_at(data_offset_ + size_product(first, element), bytes.data(), bytes.size());
    return bytes;
  }
  std::vector<std::byte> all(static_cast<std::size_t>(size_product(size_, element)));
  file_.read_at(data_offset_, all.data(), all.size());
  for (std::size_t i = 0; i < num; ++i) {
    const std::int64_t at = fortran_index(first + static_cast<std::int64_t>(i), shape_);
    std::memcpy(bytes.data() + i * width, all.data() + static_cast<std::size_t>(at) * width, width);
  }
  return bytes;
}

void NpyFile::read_part(std::int64_t first, std::span<float> out) const {
  const std::vector<std::byte> bytes = stored(first, out.size());
  with_type(dtype_, [&](auto type) {
    using T = decltype(type);
    for (std::size_t i = 0; i < out.size(); ++i)
      out[i] = as_float(load<T>(bytes.data() + i * sizeof(T)));
  });
}

void NpyFile::read_part(std::int64_t first, std::span<std::int64_t> out) const {
  const std::vector<std::byte> bytes = stored(first, out.size());
  with_type(dtype_, [&](auto type) {
    using T = decltype(type);
    for (std::size_t i = 0; i < out.size(); ++i) {
      const T value = load<T>(bytes.data() + i * sizeof(T));
      if (!as_int64(value, out[i])) {
        std::string text = "above 2^63 - 1";
        if constexpr (!std::is_integral_v<T>) text = concat(as_float(value));
        fail(ErrorKind::kFormat, path(), ": element ", first + static_cast<std::int64_t>(i), " is ",
             text, ", but a whole number is expected");
      }
    }
  });
}

void write_npy(const std::string& path, Dtype dtype, std::span<const std::int64_t> shape,
               std::span<const std::byte> bytes) {
  const auto volume = checked_volume(shape);
  const auto expected = volume ? checked_mul(*volume, dtype_size(dtype)) : std::nullopt;
  LVGGT_CHECK(expected && static_cast<std::size_t>(*expected) == bytes.size(), "npy: ", path, ": ",
              bytes.size(), " bytes are not those of the shape");
  std::string header = detail::npy_header_text(dtype, {shape.begin(), shape.end()});
  // The data start at a multiple of 64 bytes; the header ends in a newline.
  constexpr std::size_t kStart = kPreambleBytes + 2, kAlign = 64;
  header.append((kAlign - (kStart + header.size() + 1) % kAlign) % kAlign, ' ');
  header += '\n';
  std::string preamble(kMagic);
  preamble += '\1';
  preamble += '\0';
  preamble += static_cast<char>(header.size() & 0xff);
  preamble += static_cast<char>(header.size() >> 8);
  AtomicFile file(path);
  file.write(preamble);
  file.write(header);
  file.write(bytes.data(), bytes.size());
  file.commit();
}

}  // namespace lvggt
