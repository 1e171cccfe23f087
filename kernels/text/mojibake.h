// SPDX-License-Identifier: Apache-2.0
// Private: UTF-8 that was read as Latin-1 or Windows-1252.
#pragma once

#include <string>

namespace lvggt::text {

// One pass over a text: sequences that can hardly be anything else are read again as UTF-8 (the
// rules are those of lvggt/language/text_cleaning.h), then C1 control characters become what
// Windows-1252 has in their place.
std::u32string repair_encoding(const std::u32string& text);

}  // namespace lvggt::text
