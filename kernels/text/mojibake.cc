// SPDX-License-Identifier: Apache-2.0
#include "kernels/text/mojibake.h"

#include <cstddef>
#include <cstdint>

#include "kernels/text/html_references.h"

namespace lvggt::text {
namespace {

// The byte that was misread as this character, or -1.
int byte_of(char32_t c) {
  if (c <= 0xFF) return static_cast<int>(c);
  for (char32_t byte = 0x80; byte <= 0x9F; ++byte)
    if (windows_1252(byte) == c) return static_cast<int>(byte);
  return -1;
}

struct Sequence {
  std::size_t length = 0;  // 0: none here
  char32_t character = 0;
};

constexpr char32_t kNoBreakSpace = 0xA0;

// The UTF-8 sequence whose bytes the characters from `i` on are, if they are one.
Sequence sequence_at(const std::u32string& text, std::size_t i) {
  const char32_t lead = text[i];
  if (lead < 0xC2 || lead > 0xF4) return {};
  const std::size_t length = lead >= 0xF0 ? 4 : lead >= 0xE0 ? 3 : 2;
  if (i + length > text.size()) return {};
  char32_t character = lead & (0xFFu >> (length + 1));
  for (std::size_t k = 1; k < length; ++k) {
    const int byte = byte_of(text[i + k]);
    if (byte < 0x80 || byte > 0xBF) return {};
    // "voila »" has a no-break space after its accent: only what no language writes before one.
    if (text[i + k] == kNoBreakSpace && lead != 0xC2 && lead != 0xC3 && lead != 0xE2) return {};
    character = character << 6 | static_cast<char32_t>(byte & 0x3F);
  }
  const bool overlong = (length == 3 && character < 0x800) || (length == 4 && character < 0x10000);
  const bool surrogate = character >= 0xD800 && character <= 0xDFFF;
  if (overlong || surrogate || character > 0x10FFFF) return {};
  return {length, character};
}

// Whether the sequence is beyond doubt by itself: most pairs of Latin-1 characters are rare, but an
// accented capital before a quotation mark is not.
bool certain(char32_t lead, const Sequence& sequence) {
  return sequence.length >= 3 || lead == 0xC2 || lead == 0xC3;
}

}  // namespace

std::u32string repair_encoding(const std::u32string& text) {
  std::u32string result;
  bool after_repaired = false;
  for (std::size_t i = 0; i < text.size();) {
    const Sequence found = sequence_at(text, i);
    const std::size_t next = i + found.length;
    if (found.length > 0 && (certain(text[i], found) || after_repaired ||
                             (next < text.size() && sequence_at(text, next).length > 0))) {
      result.push_back(found.character);
      after_repaired = true;
      i = next;
      continue;
    }
    after_repaired = false;
    result.push_back(windows_1252(text[i++]));
  }
  return result;
}

}  // namespace lvggt::text
