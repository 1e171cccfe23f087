// SPDX-License-Identifier: Apache-2.0
#include "lvggt/core/reserved_memory.h"

#include <sys/mman.h>
#include <sys/resource.h>

#include <cstdint>

#include "lvggt/core/error.h"

namespace lvggt {

void advise_huge_pages(void* data, std::size_t num_bytes) {
  // Whole pages inside of the range only; the rest may be somebody else's.
  constexpr std::uintptr_t kPage = 4096;
  const auto first = (reinterpret_cast<std::uintptr_t>(data) + kPage - 1) / kPage * kPage;
  const auto last = (reinterpret_cast<std::uintptr_t>(data) + num_bytes) / kPage * kPage;
#ifdef MADV_HUGEPAGE
  if (last > first) madvise(reinterpret_cast<void*>(first), last - first, MADV_HUGEPAGE);
#endif
}

ReservedMemory::ReservedMemory(std::size_t num_bytes) {
  if (num_bytes == 0) return;
  void* p = mmap(nullptr, num_bytes, PROT_READ | PROT_WRITE,
                 MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
  if (p == MAP_FAILED)
    fail(ErrorKind::kMemory, "memory: a range of ", num_bytes, " bytes cannot be reserved");
  data_ = static_cast<std::byte*>(p);
  num_bytes_ = num_bytes;
  if (num_bytes >= kHugeMemory) advise_huge_pages(data_, num_bytes_);
}

ReservedMemory::~ReservedMemory() {
  if (data_ != nullptr) munmap(data_, num_bytes_);
}

ReservedMemory reserve_with_room(std::size_t num_bytes) {
  constexpr std::size_t kRoom = std::size_t{1} << 34;  // of 2^47 that a process has
  rlimit limit{};
  if (num_bytes < kRoom && getrlimit(RLIMIT_AS, &limit) == 0 && limit.rlim_cur == RLIM_INFINITY) {
    try {
      return ReservedMemory(kRoom);
    } catch (const Error&) {  // a system that counts what is reserved
    }
  }
  return ReservedMemory(num_bytes);
}

}  // namespace lvggt
