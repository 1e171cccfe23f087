// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>

namespace lvggt {

// SHA-256 as 64 lower-case hexadecimal digits.
std::string sha256(std::span<const std::byte> bytes);

// SHA-256 of a file's content, read in blocks.
std::string sha256_file(const std::string& path);

// Checks that the SHA-256 of `path` is `expected`, 64 hexadecimal digits in either case. Errors:
// kUsage when `expected` is not that, kMismatch naming both sums when they differ.
void check_sha256(const std::string& path, const std::string& expected);

}  // namespace lvggt
