// SPDX-License-Identifier: Apache-2.0
#pragma once

namespace lvggt::bench {

// Takes --simd=NAME out of the arguments and every instruction set better than NAME away from the
// kernels, as on a machine that lacks them. Throws Error (usage) if this machine has none of that
// name.
void apply_simd_option(int* argc, char** argv);

}  // namespace lvggt::bench
