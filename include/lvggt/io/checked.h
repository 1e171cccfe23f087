// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <span>

#include "lvggt/core/error.h"

namespace lvggt {

// Arithmetic on sizes that come from files: empty when the result does not fit 63 bits, the range
// of every extent and offset in lvggt. Loaders multiply and add such numbers only through these.
inline std::optional<std::int64_t> checked_mul(std::int64_t a, std::int64_t b) {
  std::int64_t result;
  if (a < 0 || b < 0 || __builtin_mul_overflow(a, b, &result)) return std::nullopt;
  return result;
}

inline std::optional<std::int64_t> checked_add(std::int64_t a, std::int64_t b) {
  std::int64_t result;
  if (a < 0 || b < 0 || __builtin_add_overflow(a, b, &result)) return std::nullopt;
  return result;
}

// a * b of sizes that were checked before; an Error of kind kLimit, never a wrapped number, if they
// were not.
inline std::int64_t size_product(std::int64_t a, std::int64_t b) {
  const auto product = checked_mul(a, b);
  if (!product) fail(ErrorKind::kLimit, "a size of ", a, " times ", b, " does not fit 63 bits");
  return *product;
}

// Number of elements of a shape; empty when the product of the extents other than 0 does not fit,
// so that the answer does not depend on where among them a 0 stands.
inline std::optional<std::int64_t> checked_volume(std::span<const std::int64_t> shape) {
  std::int64_t volume = 1;
  bool zero = false;
  for (const std::int64_t extent : shape) {
    if (extent == 0) {
      zero = true;
      continue;
    }
    const auto product = checked_mul(volume, extent);
    if (!product) return std::nullopt;
    volume = *product;
  }
  return zero ? 0 : volume;
}

}  // namespace lvggt
