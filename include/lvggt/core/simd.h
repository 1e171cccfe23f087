// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>
#include <vector>

namespace lvggt {

// Name of the instruction set that the kernels run on: the best one that was compiled and that this
// CPU has, e.g. "AVX-512", "AVX2", "SSE4", "NEON".
std::string simd_target();

// All instruction sets that were compiled and that this CPU has, best first.
std::vector<std::string> simd_targets();

// Makes the kernels run on the instruction set of that name, one of simd_targets(), in the whole
// process: to compare them, or to see what another CPU would do. Before anything runs; a kUsage
// error for another name.
void use_simd_target(std::string_view name);

}  // namespace lvggt
