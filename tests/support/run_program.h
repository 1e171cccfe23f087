// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "tests/support/child_process.h"

namespace lvggt::test {

// How a program ended, and what it said.
struct ProgramResult {
  int status = 0;
  std::string out, err;
  bool says(const std::string& text) const { return err.find(text) != std::string::npos; }
  bool prints(const std::string& text) const { return out.find(text) != std::string::npos; }
};

inline ProgramResult run_program(const std::string& path, std::vector<std::string> arguments) {
  arguments.insert(arguments.begin(), path);
  ChildProcess child(arguments);
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

}  // namespace lvggt::test
