// SPDX-License-Identifier: Apache-2.0
// Phrases through the component that needs Unicode and tokenisers.
#include <lvggt/language/load_text_encoder.h>
#include <lvggt/language/text_cleaning.h>

#include <cstdio>

int main(int argc, char** argv) {
  if (lvggt::clean_text("  A&nbsp;CUP ") != "a cup") return 1;
  try {
    lvggt::load_text_encoder(argc > 1 ? argv[1] : "no such file");
  } catch (const lvggt::Error& error) {
    std::printf("%s\n", error.what());
    return error.kind() == lvggt::ErrorKind::kRead ? 0 : 1;
  }
  return 1;
}
