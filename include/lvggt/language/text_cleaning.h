// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <string_view>

namespace lvggt {

// What OpenCLIP does to a text before tokenising it: repair_text(), HTML character references
// replaced twice (HTML5 rules, those without semicolon included), white space collapsed and
// stripped, Unicode lower case with full mappings and final sigma. Text and result are UTF-8; a
// text that is not is a kFormat Error that names the byte. Needs lvggt::text.
std::string clean_text(std::string_view text);

// The repairs of ftfy.fix_text that change tokens, as rules of our own, line by line until nothing
// changes:
//   - character references with a semicolon, unless the text has a '<'
//   - UTF-8 that was read as Latin-1 or Windows-1252 is read again: sequences of three or four
//     bytes, of two bytes led by C2 or C3 (the accents of European languages), and two or more
//     sequences of two bytes in a row; a no-break space belongs to one only after those leads or E2
//   - C1 control characters are what Windows-1252 has there
//   - ligatures of Latin letters, full- and half-width forms, curly quotes, line ends
//   - terminal escapes and control characters are removed
//   - normal form C
// Other encodings that ftfy tries (Mac Roman, Windows-1250, ...) are not.
std::string repair_text(std::string_view text);

// Checks that a text is UTF-8; `what` opens the message. Errors: kFormat.
void check_utf8(std::string_view text, const std::string& what);

}  // namespace lvggt
