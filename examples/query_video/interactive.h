// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>

#include "examples/query_video/session.h"

namespace query_video {

// Reads a question a line from the standard input and answers it on the standard output, with
// pictures in `out` if it is not empty; a line that begins with "state:" asks for a state. An error
// about a line is said, and the next line read. The codes stay in memory if they fit into half of
// `memory`, the bytes that are left. Returns the exit status at the end of the input, or
// when the user interrupts.
int converse(Session& session, const std::string& out, std::size_t memory, lvggt::Context& ctx);

}  // namespace query_video
