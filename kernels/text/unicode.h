// SPDX-License-Identifier: Apache-2.0
// Private: text as code points. ICU stays behind this header and text_cleaning.cc.
#pragma once

#include <string>
#include <string_view>

namespace lvggt::text {

// The code points of UTF-8; kFormat naming the first byte that is none.
std::u32string decode_utf8(std::string_view text, const std::string& what);
std::string encode_utf8(std::u32string_view text);
void append_utf8(std::string& out, char32_t c);

// Classes of Unicode 15.
bool is_letter(char32_t c);  // \p{L}
bool is_number(char32_t c);  // \p{N}
bool is_space(char32_t c);   // White_Space

std::u32string normal_form_c(const std::u32string& text);
std::u32string compatible_form(char32_t c);  // NFKC
std::u32string lower_case(const std::u32string& text);
std::u32string upper_case(const std::u32string& text);

// What HTML makes of "&" + name for the longest prefix of `name` that is a named reference: its
// text, followed by the rest of the name. Empty when there is none. `name` is made of ASCII letters
// and digits, and maybe a semicolon at its end.
std::u32string named_reference(std::u32string_view name);

}  // namespace lvggt::text
