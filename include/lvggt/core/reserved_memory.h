// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <utility>

namespace lvggt {

// Smallest memory that is worth huge pages: a few of them.
inline constexpr std::size_t kHugeMemory = std::size_t{8} << 20;

// Asks the system for huge pages in this memory, before it is written. Where there are none, or
// where they are reserved for others, nothing happens.
void advise_huge_pages(void* data, std::size_t num_bytes);

// Address space reserved up front; the system commits a page when it is first written and gives
// zeros when it is first read, from kHugeMemory up in huge pages where it can. For buffers whose
// full size is known but may never be needed.
class ReservedMemory {
 public:
  ReservedMemory() = default;
  explicit ReservedMemory(
      std::size_t num_bytes);  // kMemory when there is no such range of addresses
  ~ReservedMemory();
  ReservedMemory(ReservedMemory&& other) noexcept
      : data_(std::exchange(other.data_, nullptr)),
        num_bytes_(std::exchange(other.num_bytes_, 0)) {}
  ReservedMemory& operator=(ReservedMemory&& other) noexcept {
    std::swap(data_, other.data_);
    std::swap(num_bytes_, other.num_bytes_);
    return *this;
  }

  std::byte* data() const { return data_; }
  std::size_t num_bytes() const { return num_bytes_; }

 private:
  std::byte* data_ = nullptr;
  std::size_t num_bytes_ = 0;
};

// At least num_bytes for a buffer that may grow in place: address space that no process misses, or,
// where that is limited (ulimit -v), num_bytes only.
ReservedMemory reserve_with_room(std::size_t num_bytes);

}  // namespace lvggt
