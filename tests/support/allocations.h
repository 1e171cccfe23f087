// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

namespace lvggt::test {

// How often this program has used the heap through C++ so far.
std::int64_t num_allocations();

}  // namespace lvggt::test
