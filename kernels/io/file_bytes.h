// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

namespace lvggt::detail {

// Bytes of a regular file; kRead if it is missing, unreadable, a directory or a device.
std::int64_t regular_file_size(const std::string& path);

// The first bytes of a regular file, at most `count`.
std::vector<std::byte> read_file_head(const std::string& path, std::size_t count);

// A whole regular file; kLimit if it has more than max_bytes.
std::vector<std::byte> read_whole_file(const std::string& path, std::int64_t max_bytes);

}  // namespace lvggt::detail
