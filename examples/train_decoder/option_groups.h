// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "examples/train_decoder/options.h"
#include "lvggt/cli/program.h"

namespace train_decoder {

// Declares the options with their help.
void add_options(lvggt::cli::Program& program, Options& options);

}  // namespace train_decoder
