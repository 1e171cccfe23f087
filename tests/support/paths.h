// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace lvggt::test {

// Path of a file under tests/: test_data("golden/config_tiny.json").
std::string test_data(std::string_view name);

// Path of one of our programs as it was built: program("lift_video"). Functions rather than
// definitions for the compiler, so that objects do not depend on where the checkout lies and a
// compiler cache serves every checkout.
std::string program(std::string_view name);

}  // namespace lvggt::test
