// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>  // says whether this is glibc

#ifdef __GLIBC__
#include <malloc.h>
#endif

namespace lvggt::cli {

// Large blocks go back to the system as soon as they are freed, for the rest of the process. Left
// alone, glibc keeps ever larger ones for itself, in a heap for each thread: tensors that were read
// and packed stayed in memory, up to a tenth of a run's peak more than was planned. To be called
// before threads start.
inline void return_freed_memory() {
#ifdef __GLIBC__
  mallopt(M_MMAP_THRESHOLD, 256 << 10);
#endif
}

}  // namespace lvggt::cli
