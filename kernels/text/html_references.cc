// SPDX-License-Identifier: Apache-2.0
#include "kernels/text/html_references.h"

#include <algorithm>
#include <string_view>

#include "kernels/text/unicode.h"

namespace lvggt::text {
namespace {

constexpr std::size_t kLongestName = 32;        // of html.unescape, without the semicolon
constexpr std::size_t kLongestClosedName = 24;  // of ftfy, without '&', '#' and semicolon

constexpr char32_t kWindows1252[32] = {
    0x20AC, 0x81,   0x201A, 0x0192, 0x201E, 0x2026, 0x2020, 0x2021, 0x02C6, 0x2030, 0x0160,
    0x2039, 0x0152, 0x8D,   0x017D, 0x8F,   0x90,   0x2018, 0x2019, 0x201C, 0x201D, 0x2022,
    0x2013, 0x2014, 0x02DC, 0x2122, 0x0161, 0x203A, 0x0153, 0x9D,   0x017E, 0x0178};

bool is_digit(char32_t c) { return c >= '0' && c <= '9'; }
bool is_hex(char32_t c) { return is_digit(c) || (c >= 'a' && c <= 'f') || (c >= 'A' && c <= 'F'); }
// Every name that HTML knows is made of these.
bool is_name_part(char32_t c) {
  return is_digit(c) || (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z');
}

// What a numeric reference stands for; nothing for numbers that are no character of a text.
std::u32string numbered(char32_t number) {
  if (number == 0 || number > 0x10FFFF || (number >= 0xD800 && number <= 0xDFFF)) return U"\uFFFD";
  if (number == 0x0D) return U"\r";
  if (number >= 0x80 && number <= 0x9F) return {windows_1252(number)};
  const bool control =
      number <= 8 || number == 0x0B || (number >= 0x0E && number <= 0x1F) || number == 0x7F;
  const bool no_character = (number >= 0xFDD0 && number <= 0xFDEF) || (number & 0xFFFE) == 0xFFFE;
  if (control || no_character) return {};
  return {number};
}

struct Reference {
  std::size_t length = 0;  // characters after the '&'; 0: none here
  bool closed = false;     // with its semicolon
  std::u32string text;
};

// A numeric reference in `rest`, the text after "&#".
Reference number_reference(std::u32string_view rest) {
  const bool hex = !rest.empty() && (rest[0] == 'x' || rest[0] == 'X');
  std::size_t i = hex ? 1 : 0;
  const std::size_t first = i;
  char32_t number = 0;
  for (; i < rest.size() && (hex ? is_hex(rest[i]) : is_digit(rest[i])); ++i) {
    const char32_t digit = is_digit(rest[i]) ? rest[i] - '0' : (rest[i] | 0x20) - 'a' + 10;
    number = std::min<char32_t>(number * (hex ? 16 : 10) + digit, 0x110000);
  }
  if (i == first) return {};
  const bool closed = i < rest.size() && rest[i] == ';';
  return {1 + i + (closed ? 1 : 0), closed, numbered(number)};
}

// The reference in `rest`, the text after an '&'.
Reference reference_at(std::u32string_view rest) {
  if (!rest.empty() && rest[0] == '#') return number_reference(rest.substr(1));
  std::size_t length = 0;
  while (length < rest.size() && length < kLongestName && is_name_part(rest[length])) ++length;
  if (length == 0) return {};
  const bool closed = length < rest.size() && rest[length] == ';';
  const std::size_t end = length + (closed ? 1 : 0);
  std::u32string text = named_reference(rest.substr(0, end));
  if (text.empty()) return {};
  return {end, closed, std::move(text)};
}

// ftfy's form, &#?[0-9A-Za-z]{1,24};
Reference closed_reference_at(std::u32string_view rest) {
  std::size_t i = !rest.empty() && rest[0] == '#' ? 1 : 0;
  const std::size_t first = i;
  while (i < rest.size() && is_name_part(rest[i])) ++i;
  if (i == first || i - first > kLongestClosedName || i == rest.size() || rest[i] != ';') return {};
  const std::u32string_view name = rest.substr(0, i + 1);
  Reference found = reference_at(name);
  // A shorter name without semicolon leaves the rest standing: not what was meant.
  if (found.length > 0 && (found.text.empty() || found.text.back() != ';')) return found;
  const std::u32string lower = lower_case(std::u32string(name));
  if (first == 1 || upper_case(lower) != name) return {};
  found = reference_at(lower);
  if (found.length == 0 || found.text.back() == ';') return {};
  found.text = upper_case(found.text);
  return found;
}

template <class Find>
std::u32string replaced(const std::u32string& text, const Find& find) {
  std::u32string result;
  for (std::size_t i = 0; i < text.size();) {
    if (text[i] == '&') {
      const Reference found = find(std::u32string_view(text).substr(i + 1));
      if (found.length > 0) {
        result += found.text;
        i += 1 + found.length;
        continue;
      }
    }
    result.push_back(text[i++]);
  }
  return result;
}

}  // namespace

char32_t windows_1252(char32_t byte) {
  return byte >= 0x80 && byte <= 0x9F ? kWindows1252[byte - 0x80] : byte;
}

std::u32string replace_references(const std::u32string& text) {
  return replaced(text, reference_at);
}

std::u32string replace_closed_references(const std::u32string& text) {
  return replaced(text, closed_reference_at);
}

}  // namespace lvggt::text
