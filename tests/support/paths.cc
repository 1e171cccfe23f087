// SPDX-License-Identifier: Apache-2.0
#include "tests/support/paths.h"

namespace lvggt::test {

std::string test_data(std::string_view name) {
  return std::string(LVGGT_TEST_DATA "/") + std::string(name);
}

std::string program(std::string_view name) {
  const std::string folder = name.starts_with("weights_") ? "/weights/" : "/examples/";
  return LVGGT_PROGRAMS + folder + std::string(name);
}

}  // namespace lvggt::test
