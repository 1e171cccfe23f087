// SPDX-License-Identifier: Apache-2.0
// A user's program: includes the library in two translation units, links it and sees it report an
// error.
#include <lvggt/lvggt.h>

#include <cstdio>

bool all_chunks_run();  // other.cc

int main() {
  lvggt::Context ctx(2);
  if (!all_chunks_run()) return 1;
  try {
    lvggt::Context too_many(lvggt::kMaxThreads + 1);
  } catch (const lvggt::Error& error) {
    std::printf("refused as it should be: %s\n", error.what());
    return lvggt::exit_code(error.kind()) == 2 ? 0 : 1;
  }
  return 1;
}
