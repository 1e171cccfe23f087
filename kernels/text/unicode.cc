// SPDX-License-Identifier: Apache-2.0
#include "kernels/text/unicode.h"

#include <gumbo.h>
#include <unicode/locid.h>
#include <unicode/normalizer2.h>
#include <unicode/uchar.h>
#include <unicode/unistr.h>

#include <cstdint>
#include <memory>

#include "lvggt/core/error.h"

namespace lvggt::text {
namespace {

// Length of the well-formed sequence at `i`, 0 if there is none: no overlong forms, surrogates or
// values above 10FFFF.
std::size_t sequence_length(std::string_view s, std::size_t i) {
  const auto byte = [&](std::size_t k) {
    return k < s.size() ? static_cast<std::uint8_t>(s[k]) : std::uint8_t{0};
  };
  const std::uint8_t first = byte(i);
  if (first < 0x80) return 1;
  const std::size_t length = first >= 0xF0 ? 4 : first >= 0xE0 ? 3 : 2;
  if (first < 0xC2 || first > 0xF4) return 0;
  for (std::size_t k = 1; k < length; ++k)
    if ((byte(i + k) & 0xC0) != 0x80) return 0;
  const std::uint8_t second = byte(i + 1);
  if ((first == 0xE0 && second < 0xA0) || (first == 0xED && second > 0x9F) ||
      (first == 0xF0 && second < 0x90) || (first == 0xF4 && second > 0x8F))
    return 0;
  return length;
}

icu::UnicodeString to_icu(std::u32string_view text) {
  return icu::UnicodeString::fromUTF32(reinterpret_cast<const UChar32*>(text.data()),
                                       static_cast<int32_t>(text.size()));
}

std::u32string from_icu(const icu::UnicodeString& text) {
  std::u32string result;
  for (int32_t i = 0; i < text.length(); i = text.moveIndex32(i, 1))
    result.push_back(static_cast<char32_t>(text.char32At(i)));
  return result;
}

std::u32string normalised(const icu::Normalizer2* (*form)(UErrorCode&),
                          const icu::UnicodeString& text) {
  UErrorCode status = U_ZERO_ERROR;
  const icu::Normalizer2* normalizer = form(status);
  icu::UnicodeString result;
  if (U_SUCCESS(status)) result = normalizer->normalize(text, status);
  if (U_FAILURE(status))
    fail(ErrorKind::kUnsupported, "ICU cannot normalise text: ", u_errorName(status));
  return from_icu(result);
}

}  // namespace

std::u32string decode_utf8(std::string_view text, const std::string& what) {
  std::u32string result;
  for (std::size_t i = 0; i < text.size();) {
    const std::size_t length = sequence_length(text, i);
    if (length == 0)
      fail(ErrorKind::kFormat, what, " is not UTF-8: byte ", i, " begins no character");
    const auto first = static_cast<std::uint8_t>(text[i]);
    char32_t c = length == 1 ? first : first & (0xFFu >> (length + 1));
    for (std::size_t k = 1; k < length; ++k)
      c = c << 6 | (static_cast<std::uint8_t>(text[i + k]) & 0x3Fu);
    result.push_back(c);
    i += length;
  }
  return result;
}

void append_utf8(std::string& out, char32_t c) {
  const auto put = [&](char32_t byte) { out.push_back(static_cast<char>(byte)); };
  const auto tail = [&](int shift) { put(0x80 | (c >> shift & 0x3F)); };
  if (c < 0x80) return put(c);
  if (c < 0x800) {
    put(0xC0 | c >> 6);
  } else if (c < 0x10000) {
    put(0xE0 | c >> 12);
    tail(6);
  } else {
    put(0xF0 | c >> 18);
    tail(12);
    tail(6);
  }
  tail(0);
}

std::string encode_utf8(std::u32string_view text) {
  std::string result;
  for (const char32_t c : text) append_utf8(result, c);
  return result;
}

bool is_letter(char32_t c) { return (U_GET_GC_MASK(static_cast<UChar32>(c)) & U_GC_L_MASK) != 0; }
bool is_number(char32_t c) { return (U_GET_GC_MASK(static_cast<UChar32>(c)) & U_GC_N_MASK) != 0; }
bool is_space(char32_t c) { return u_isUWhiteSpace(static_cast<UChar32>(c)); }

std::u32string normal_form_c(const std::u32string& text) {
  return normalised(&icu::Normalizer2::getNFCInstance, to_icu(text));
}
std::u32string compatible_form(char32_t c) {
  return normalised(&icu::Normalizer2::getNFKCInstance,
                    icu::UnicodeString(static_cast<UChar32>(c)));
}
std::u32string lower_case(const std::u32string& text) {
  return from_icu(to_icu(text).toLower(icu::Locale::getRoot()));
}
std::u32string upper_case(const std::u32string& text) {
  return from_icu(to_icu(text).toUpper(icu::Locale::getRoot()));
}

std::u32string named_reference(std::u32string_view name) {
  // A text area holds text and references only, which is what the parser then gives back.
  const std::string written = "&" + encode_utf8(name);
  const std::string page = "<textarea>" + written;
  const std::unique_ptr<GumboOutput, void (*)(GumboOutput*)> output(
      gumbo_parse_with_options(&kGumboDefaultOptions, page.data(), page.size()),
      [](GumboOutput* parsed) { gumbo_destroy_output(&kGumboDefaultOptions, parsed); });
  const GumboNode* node = output->root;
  while (node != nullptr && node->type == GUMBO_NODE_ELEMENT) {
    const GumboVector& children = node->v.element.children;
    if (children.length == 0) return {};
    // <html> holds <head> and <body>; the text is in the last child each time.
    node = static_cast<const GumboNode*>(children.data[children.length - 1]);
  }
  if (node == nullptr || node->type != GUMBO_NODE_TEXT) return {};
  const std::string found = node->v.text.text;
  return found == written ? std::u32string() : decode_utf8(found, "an HTML reference");
}

}  // namespace lvggt::text
