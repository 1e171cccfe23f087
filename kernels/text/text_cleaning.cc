// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/text_cleaning.h"

#include "kernels/text/html_references.h"
#include "kernels/text/mojibake.h"
#include "kernels/text/unicode.h"

namespace lvggt {
namespace {

// Each pass of the repairs undoes one layer of damage; a text has few.
constexpr int kMostPasses = 16;

bool is_latin_ligature(char32_t c) {
  return c == 0x132 || c == 0x133 || c == 0x149 || (c >= 0x1C4 && c <= 0x1CC) ||
         (c >= 0x1F1 && c <= 0x1F3) || (c >= 0xFB00 && c <= 0xFB06);
}

bool is_wide_form(char32_t c) { return c == 0x3000 || (c >= 0xFF01 && c <= 0xFFEF); }

// What one character becomes; itself for most.
std::u32string repaired(char32_t c) {
  if (c == 0xFB05) return U"\u017Ft";  // a ligature with the long s, which stays long
  if (is_latin_ligature(c) || is_wide_form(c)) return text::compatible_form(c);
  if (c == '\r' || c == 0x2028 || c == 0x2029) return U"\n";
  return {c};
}

// After ligatures, one of which holds an apostrophe of its own.
char32_t straightened(char32_t c) {
  if (c == 0x2BC || (c >= 0x2018 && c <= 0x201B)) return '\'';
  if (c >= 0x201C && c <= 0x201F) return '"';
  return c;
}

bool is_removed_control(char32_t c) {
  return c <= 0x08 || c == 0x0B || (c >= 0x0E && c <= 0x1F) || c == 0x7F ||
         (c >= 0x206A && c <= 0x206F) || c == 0xFEFF || (c >= 0xFFF9 && c <= 0xFFFC);
}

// Length of the terminal escape at `i` (ESC [ digits and semicolons, a letter), or 0.
std::size_t escape_length(const std::u32string& text, std::size_t i) {
  if (text[i] != 0x1B || i + 1 >= text.size() || text[i + 1] != '[') return 0;
  std::size_t end = i + 2;
  while (end < text.size() && ((text[end] >= '0' && text[end] <= '9') || text[end] == ';')) ++end;
  if (end == text.size()) return 0;
  const char32_t letter = text[end] | 0x20;
  return letter >= 'a' && letter <= 'z' ? end + 1 - i : 0;
}

std::u32string without_controls(const std::u32string& text) {
  std::u32string result;
  for (std::size_t i = 0; i < text.size();) {
    if (const std::size_t length = escape_length(text, i); length > 0) {
      i += length;
      continue;
    }
    if (!is_removed_control(text[i])) result.push_back(text[i]);
    ++i;
  }
  return result;
}

std::u32string repair_line(std::u32string line, bool references) {
  for (int pass = 0; pass < kMostPasses; ++pass) {
    std::u32string next = references ? text::replace_closed_references(line) : line;
    next = text::repair_encoding(next);
    std::u32string characters;
    for (std::size_t i = 0; i < next.size(); ++i) {
      if (next[i] == '\r' && i + 1 < next.size() && next[i + 1] == '\n') continue;
      for (const char32_t part : repaired(next[i])) characters.push_back(straightened(part));
    }
    next = text::normal_form_c(without_controls(characters));
    if (next == line) break;
    line = std::move(next);
  }
  return line;
}

std::u32string repair(const std::u32string& whole) {
  std::u32string result;
  bool references = true;
  for (std::size_t begin = 0; begin < whole.size();) {
    const std::size_t at = whole.find(U'\n', begin);
    const std::size_t end = at == std::u32string::npos ? whole.size() : at + 1;
    std::u32string line = whole.substr(begin, end - begin);
    // What has tags is HTML, and its references are meant to stay.
    references = references && line.find(U'<') == std::u32string::npos;
    result += repair_line(std::move(line), references);
    begin = end;
  }
  return result;
}

std::u32string collapse_spaces(const std::u32string& spaced) {
  std::u32string result;
  for (const char32_t c : spaced) {
    if (!text::is_space(c)) {
      result.push_back(c);
    } else if (!result.empty() && result.back() != ' ') {
      result.push_back(' ');
    }
  }
  if (!result.empty() && result.back() == ' ') result.pop_back();
  return result;
}

}  // namespace

void check_utf8(std::string_view text, const std::string& what) { text::decode_utf8(text, what); }

std::string repair_text(std::string_view text) {
  return text::encode_utf8(repair(text::decode_utf8(text, "the text")));
}

std::string clean_text(std::string_view text) {
  std::u32string clean = repair(text::decode_utf8(text, "the text"));
  for (int i = 0; i < 2; ++i) clean = text::replace_references(clean);
  return text::encode_utf8(text::lower_case(collapse_spaces(clean)));
}

}  // namespace lvggt
