// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cerrno>
#include <string>
#include <system_error>

namespace lvggt {

// The system's words for an errno value, such as "No such file or directory".
inline std::string system_error_text(int error) { return std::generic_category().message(error); }

}  // namespace lvggt
