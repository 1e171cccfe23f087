// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string_view>

#include "lvggt/core/error.h"

namespace lvggt {

// How packed weights and cached keys and values are kept. Everything is computed from float32; the
// narrower types save memory, and int8 weights time, at the price of rounding.
enum class Storage {
  kF32,
  kBf16,  // 8 bits of mantissa
  kF16,   // 11 bits of mantissa, largest value 65504
  kI8,    // integers times a scale: one an output channel (weights), one a token and head (keys,
          // values)
};

constexpr std::size_t storage_bytes(Storage storage) {
  return storage == Storage::kF32 ? 4 : storage == Storage::kI8 ? 1 : 2;
}

constexpr std::string_view storage_name(Storage storage) {
  switch (storage) {
    case Storage::kF32:
      return "f32";
    case Storage::kBf16:
      return "bf16";
    case Storage::kF16:
      return "f16";
    case Storage::kI8:
      return "int8";
  }
  return "";
}

// The storage of that name; `option` opens the message when there is none.
inline Storage parse_storage(std::string_view name, std::string_view option) {
  for (const Storage storage : {Storage::kF32, Storage::kBf16, Storage::kF16, Storage::kI8}) {
    if (name == storage_name(storage)) return storage;
  }
  fail(ErrorKind::kUsage, option, ": '", name, "' is none of f32, bf16, f16, int8");
}

}  // namespace lvggt
