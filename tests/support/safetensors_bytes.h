// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstring>
#include <string>
#include <string_view>

#include "lvggt/core/error.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/safetensors.h"
#include "tests/support/temp_dir.h"

namespace lvggt::test {

// The bytes of a safetensors file: header length, header, data.
inline std::string safetensors_bytes(std::uint64_t length, std::string_view header,
                                     std::string_view data = {}) {
  std::string bytes(sizeof(length), '\0');
  std::memcpy(bytes.data(), &length, sizeof(length));
  return bytes.append(header).append(data);
}
inline std::string safetensors_bytes(std::string_view header, std::string_view data = {}) {
  return safetensors_bytes(header.size(), header, data);
}

// What opening a file ends in.
struct Outcome {
  bool accepted = false;
  ErrorKind kind = ErrorKind::kUsage;
  std::string message;

  bool says(std::string_view text) const { return message.find(text) != std::string::npos; }
};

template <class F>
Outcome outcome_of(F&& f) {
  try {
    f();
  } catch (const Error& error) {
    return {false, error.kind(), error.what()};
  }
  return {true, ErrorKind::kUsage, "accepted"};
}

// Opens a file with these bytes. Every message must name the file.
inline Outcome open_bytes(std::string_view bytes, const Limits& limits = {}) {
  const TempDir dir;
  const std::string path = dir / "weights.safetensors";
  write_file(path, bytes);
  Outcome outcome = outcome_of([&] { Safetensors::open(path, limits); });
  if (!outcome.accepted && !outcome.says(path))
    outcome.message = "the file is not named: " + outcome.message;
  return outcome;
}

inline Outcome open_header(std::string_view header, std::string_view data = {},
                           const Limits& limits = {}) {
  return open_bytes(safetensors_bytes(header, data), limits);
}

}  // namespace lvggt::test
