// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <CLI/CLI.hpp>
#include <cstdint>
#include <exception>
#include <iostream>
#include <new>
#include <string>

#include "lvggt/core/error.h"

namespace lvggt::weights {

inline constexpr const char* kExitCodes =
    "Exit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input file, 4 memory or a "
    "limit.";

// Parses the command line and runs `body`, with every fault as one line on stderr and its exit
// status.
template <class Body>
int run_program(CLI::App& app, int argc, char** argv, Body&& body) {
  app.set_version_flag("--version", LVGGT_VERSION);
  try {
    app.parse(argc, argv);
  } catch (const CLI::ParseError& error) {
    return app.exit(error) == 0 ? 0 : exit_code(ErrorKind::kUsage);
  }
  try {
    body();
    std::cout.flush();
    if (!std::cout) fail(ErrorKind::kWrite, "cannot write to standard output");
    return 0;
  } catch (const Error& error) {
    std::cerr << app.get_name() << ": " << error.what() << '\n';
    return exit_code(error.kind());
  } catch (const std::bad_alloc&) {
    std::cerr << app.get_name() << ": there is not enough memory\n";
    return exit_code(ErrorKind::kMemory);
  } catch (const std::exception& error) {
    std::cerr << app.get_name() << ": " << error.what() << '\n';
    return 1;
  }
}

// "4.88 GB", decimal as file managers count.
inline std::string size_text(std::int64_t num_bytes) {
  constexpr const char* kUnits[] = {"bytes", "kB", "MB", "GB", "TB"};
  auto value = static_cast<double>(num_bytes);
  std::size_t unit = 0;
  for (; value >= 1000 && unit + 1 < std::size(kUnits); ++unit) value /= 1000;
  std::ostringstream out;
  out.imbue(std::locale::classic());
  out << std::fixed << std::setprecision(unit == 0 ? 0 : 2) << value << ' ' << kUnits[unit];
  return out.str();
}

}  // namespace lvggt::weights
