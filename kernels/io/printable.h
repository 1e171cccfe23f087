// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace lvggt {

// Text from a file made fit for a message: control characters as \xNN, long text cut.
inline std::string printable(std::string_view text) {
  constexpr std::size_t kMaxShown = 160;
  static constexpr char kDigits[] = "0123456789abcdef";
  std::string out;
  for (const char c : text.substr(0, kMaxShown)) {
    const auto byte = static_cast<unsigned char>(c);
    if (byte < 0x20 || byte == 0x7f) {
      out += "\\x";
      out += kDigits[byte >> 4];
      out += kDigits[byte & 15];
    } else {
      out += c;
    }
  }
  if (text.size() > kMaxShown) out += "...";
  return out;
}

inline std::string in_quotes(std::string_view text) { return "'" + printable(text) + "'"; }

}  // namespace lvggt
