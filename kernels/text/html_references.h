// SPDX-License-Identifier: Apache-2.0
// Private: HTML character references.
#pragma once

#include <string>

namespace lvggt::text {

// All references of a text replaced, by the rules of HTML5 as Python's html.unescape has them: the
// longest known name counts, with or without semicolon; numbers of Windows-1252's control range
// mean its characters; numbers of no character vanish.
std::u32string replace_references(const std::u32string& text);

// Only references that end in a semicolon: what ftfy replaces. A name in capitals that HTML does
// not have means the capital of the one it has (&EACUTE;).
std::u32string replace_closed_references(const std::u32string& text);

// The character that Windows-1252 has for a byte of 80 to 9F, or the byte's own number where it has
// none.
char32_t windows_1252(char32_t byte);

}  // namespace lvggt::text
