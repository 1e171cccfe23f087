// SPDX-License-Identifier: Apache-2.0
#include "lvggt/core/reserved_memory.h"

#include <sys/mman.h>

#include "lvggt/core/error.h"

namespace lvggt {

ReservedMemory::ReservedMemory(std::size_t num_bytes) {
  if (num_bytes == 0) return;
  void* p = mmap(nullptr, num_bytes, PROT_READ | PROT_WRITE,
                 MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
  if (p == MAP_FAILED)
    fail(ErrorKind::kMemory, "memory: a range of ", num_bytes, " bytes cannot be reserved");
  data_ = static_cast<std::byte*>(p);
  num_bytes_ = num_bytes;
}

ReservedMemory::~ReservedMemory() {
  if (data_ != nullptr) munmap(data_, num_bytes_);
}

}  // namespace lvggt
