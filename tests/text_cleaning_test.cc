// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/text_cleaning.h"

#include <doctest/doctest.h>

#include "lvggt/io/json.h"
#include "tests/support/paths.h"
#include "tests/support/safetensors_bytes.h"

using namespace lvggt;
using namespace lvggt::test;

TEST_CASE("clean_text: all 520 strings of the reference become what its tokeniser sees") {
  const std::string path = test_data("golden/language/tokenizer_seed1.json");
  std::int64_t strings = 0;
  const Json json = Json::read(path);
  for (const Json& entry : json.as_array(path)) {
    const std::string& text = entry.find("text")->as_string("text");
    CAPTURE(text);
    CHECK(clean_text(text) == entry.find("clean")->as_string("clean"));
    ++strings;
  }
  CHECK(strings == 520);
}

TEST_CASE("clean_text: HTML references are replaced twice, by their longest name") {
  CHECK(clean_text("&amp;amp;eacute;") == "é");
  CHECK(clean_text("&notit; &notin;") == "¬it; ∉");
  CHECK(clean_text("&copy2020 &unknown; &") == "©2020 &unknown; &");
  CHECK(clean_text("&#x41;&#66;&#128;&#xD800;&#99999999999999;") == "ab€\uFFFD\uFFFD");
  CHECK(clean_text("a&#1;b&#xFDD0;c") == "abc");
  CHECK(clean_text("<b>&amp;amp;lt;</b>") == "<b>&lt;</b>");  // tags keep one layer of references
  CHECK(clean_text("&EACUTE;") == "é");
}

TEST_CASE("clean_text: lower case has full mappings and the final sigma") {
  CHECK(clean_text("ΟΔΟΣ ΟΔΟΣ.") == "οδος οδος.");
  CHECK(clean_text("İ") == "i̇");
  CHECK(clean_text("STRAẞE") == "straße");
}

TEST_CASE("repair_text: text read in the wrong encoding is read again, other text is left alone") {
  CHECK(repair_text("schÃ¶n") == "schön");
  CHECK(repair_text("Ð¿Ñ€Ð¸Ð²ÐµÑ‚") == "привет");
  CHECK(repair_text("itâ€™s") == "it's");
  CHECK(repair_text("ðŸ˜€") == "😀");
  CHECK(repair_text("Ã\u0083Â©t") == "ét");  // twice over
  for (const char* text : {"CAFÉ…", "voilà\u00A0»", "naïve façade", "ÄÖÜ äöü ß", "«É»", "5° − 3°",
                           "Ñandú", "smørrebrød"})
    CHECK(repair_text(text) == text);
}

TEST_CASE("repair_text: control characters and terminal escapes go, line ends are one kind") {
  CHECK(repair_text("\x1b[1;31mred\x1b[0m\x07") == "red");
  CHECK(repair_text("a\r\nb\rc\u2028d") == "a\nb\nc\nd");
  CHECK(repair_text("a\u0085b") == "a…b");
  CHECK(repair_text("") == "");
}

TEST_CASE("D06 clean_text: invalid UTF-8 is refused with the byte it begins at") {
  for (const std::string& text :
       {std::string("ab\xff"), std::string("ab\xc0\x80"), std::string("ab\xed\xa0\x80"),
        std::string("ab\xe2\x82"), std::string("ab\xf4\x90\x80\x80")}) {
    const Outcome outcome = outcome_of([&] { clean_text(text); });
    CHECK(outcome.kind == ErrorKind::kFormat);
    CHECK(outcome.says("the text is not UTF-8: byte 2 begins no character"));
  }
}
