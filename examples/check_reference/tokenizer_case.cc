// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdio>
#include <map>
#include <vector>

#include "examples/check_reference/encoder_cases.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/language/bpe_tokenizer.h"
#include "lvggt/language/text_cleaning.h"

namespace check_reference {
namespace {

using namespace lvggt;

constexpr std::int64_t kContext = 77;

const Json& member(const Json& object, const char* key, const std::string& place) {
  const Json* value = object.find(key);
  if (value == nullptr) fail(ErrorKind::kFormat, place, ": has no \"", key, "\"");
  return *value;
}

std::string ids_text(const std::vector<std::int64_t>& ids) {
  std::string text;
  for (const std::int64_t id : ids) text += (text.empty() ? "" : " ") + std::to_string(id);
  return text;
}

// Strings of one kind and how many of them have other ids or another clean text.
struct Kind {
  std::int64_t strings = 0, wrong = 0;
};

// What is wrong with one string, or nothing.
std::string fault_of(const Json& entry, const std::string& place, const BpeTokenizer& tokenizer) {
  const std::string& text = member(entry, "text", place).as_string(place);
  const std::string& clean = member(entry, "clean", place).as_string(place);
  std::vector<std::int64_t> expected;
  for (const Json& id : member(entry, "ids", place).as_array(place))
    expected.push_back(id.as_int64(place));
  std::int64_t full = static_cast<std::int64_t>(expected.size());
  if (const Json* truncated = entry.find("truncated_from")) full = truncated->as_int64(place);

  const BpeTokenizer::Ids ours = tokenizer.encode(text, kContext);
  std::string fault;
  if (clean_text(text) != clean)
    fault = "clean text is " + json_quote(clean_text(text)) + ", expected " + json_quote(clean);
  if (ours.ids != expected)
    fault += (fault.empty() ? "" : "; ") + ("ids are " + ids_text(ours.ids)) + ", expected " +
             ids_text(expected);
  if (ours.full_length != full)
    fault +=
        (fault.empty() ? "" : "; ") + concat("length is ", ours.full_length, ", expected ", full);
  return fault;
}

}  // namespace

bool is_tokenizer_case(const Json& json) {
  if (!json.is_array()) return false;
  const Json::Array& entries = json.as_array("");
  return !entries.empty() && entries.front().find("ids") != nullptr &&
         entries.front().find("text") != nullptr;
}

bool check_tokenizer(const Json& json, const std::string& path, const std::string& vocabulary,
                     bool as_json) {
  const BpeTokenizer tokenizer = BpeTokenizer::open(vocabulary);
  std::map<std::string, Kind> kinds;
  std::vector<std::string> faults;
  std::int64_t number = 0;
  for (const Json& entry : json.as_array(path)) {
    const std::string place = concat(path, ": string ", number++);
    const Json* name = entry.find("kind");
    Kind& kind = kinds[name == nullptr ? "string" : name->as_string(place)];
    ++kind.strings;
    const std::string fault = fault_of(entry, place, tokenizer);
    if (fault.empty()) continue;
    ++kind.wrong;
    faults.push_back(place + ": " + fault);
  }
  std::string report;
  if (as_json) {
    JsonWriter out;
    out.begin_object();
    out.field("case", "tokenizer");
    out.field("ok", faults.empty());
    out.key("kinds");
    out.begin_array();
    for (const auto& [name, kind] : kinds) {
      out.begin_object();
      out.field("name", name);
      out.field("strings", kind.strings);
      out.field("wrong", kind.wrong);
      out.field("ok", kind.wrong == 0);
      out.end_object();
    }
    out.end_array();
    out.key("faults");
    out.begin_array();
    for (const std::string& fault : faults) out.value(fault);
    out.end_array();
    out.end_object();
    report = out.take();
  } else {
    for (const std::string& fault : faults) report += fault + "\n";
    for (const auto& [name, kind] : kinds) {
      std::string padded = name;
      padded.resize(std::max<std::size_t>(padded.size(), 12), ' ');
      report += concat(padded, "  ", kind.wrong, " wrong of ", kind.strings, " strings  ",
                       kind.wrong == 0 ? "ok" : "FAIL", "\n");
    }
  }
  if (std::fwrite(report.data(), 1, report.size(), stdout) != report.size() ||
      std::fflush(stdout) != 0)
    fail(ErrorKind::kWrite, "standard output: cannot be written");
  return faults.empty();
}

}  // namespace check_reference
