// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/captions.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <limits>

#include "lvggt/core/error.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/json.h"

namespace lvggt {
namespace {

constexpr std::array<std::string_view, 3> kColumns = {"frame", "object", "sentence"};
constexpr std::string_view kByteOrderMark = "\xef\xbb\xbf";

std::string_view stripped(std::string_view text) {
  const std::size_t first = text.find_first_not_of(" \t\r\n");
  if (first == std::string_view::npos) return {};
  return text.substr(first, text.find_last_not_of(" \t\r\n") + 1 - first);
}

bool parse_integer(std::string_view text, std::int64_t& value) {
  text = stripped(text);
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  return error == std::errc() && end == text.data() + text.size() && value >= 0;
}

// Where the columns are, by the names in the first row; in the published order when it has none.
struct Header {
  std::array<std::size_t, 3> column = {0, 1, 2};
  bool present = false;
};

Header header_of(const std::vector<std::string>& row, const std::string& path) {
  Header header;
  std::int64_t ignored = 0;
  if (row.empty() || parse_integer(row[0], ignored)) return header;
  header.present = true;
  for (std::size_t i = 0; i < kColumns.size(); ++i) {
    const auto found = std::find_if(row.begin(), row.end(), [&](const std::string& name) {
      return stripped(name) == kColumns[i];
    });
    if (found == row.end())
      fail(ErrorKind::kFormat, path, ": the first row has no column \"", kColumns[i],
           "\"; the columns are frame, object and sentence");
    header.column[i] = static_cast<std::size_t>(found - row.begin());
  }
  return header;
}

}  // namespace

std::vector<std::vector<std::string>> parse_csv(std::string_view text, const std::string& source) {
  if (text.starts_with(kByteOrderMark)) text.remove_prefix(kByteOrderMark.size());
  std::vector<std::vector<std::string>> rows;
  std::vector<std::string> row;
  std::string field;
  bool quoted = false, was_quoted = false;
  const auto end_field = [&] {
    row.push_back(std::move(field));
    field.clear();
    was_quoted = false;
  };
  const auto end_row = [&] {
    if (row.empty() && field.empty() && !was_quoted) return;  // an empty line
    end_field();
    rows.push_back(std::move(row));
    row.clear();
  };
  for (std::size_t i = 0; i < text.size(); ++i) {
    const char c = text[i];
    if (quoted) {
      if (c != '"') {
        field += c;
      } else if (i + 1 < text.size() && text[i + 1] == '"') {
        field += text[++i];
      } else {
        quoted = false;
      }
    } else if (c == '"' && field.empty() && !was_quoted) {
      quoted = was_quoted = true;
    } else if (c == ',') {
      end_field();
    } else if (c == '\n') {
      end_row();
    } else if (c == '"') {
      fail(ErrorKind::kFormat, source, ": row ", rows.size() + 1,
           " has a quote inside of a field; double it, and put the field in quotes");
    } else if (c != '\r') {
      field += c;
    }
  }
  if (quoted)
    fail(ErrorKind::kFormat, source, ": row ", rows.size() + 1, " has a quote that is not closed");
  end_row();
  return rows;
}

Captions read_captions(const std::string& path) {
  const auto rows = parse_csv(read_text_file(path), path);
  if (rows.empty()) fail(ErrorKind::kFormat, path, ": holds no captions");
  const Header header = header_of(rows.front(), path);
  Captions captions;
  for (std::size_t r = header.present ? 1 : 0; r < rows.size(); ++r) {
    const auto& row = rows[r];
    const std::size_t needed = *std::max_element(header.column.begin(), header.column.end()) + 1;
    if (row.size() < needed || (!header.present && row.size() != kColumns.size()))
      fail(ErrorKind::kFormat, path, ": row ", r + 1, " has ", row.size(),
           " columns, expected frame, object and sentence; a sentence with a comma needs quotes");
    std::int64_t frame = 0, object = 0;
    if (!parse_integer(row[header.column[0]], frame) ||
        !parse_integer(row[header.column[1]], object) ||
        object > std::numeric_limits<std::int32_t>::max())
      fail(ErrorKind::kFormat, path, ": row ", r + 1, " has the frame ",
           json_quote(row[header.column[0]]), " and the object ", json_quote(row[header.column[1]]),
           ", which must be whole numbers");
    const std::string_view sentence = stripped(row[header.column[2]]);
    if (sentence.empty()) continue;
    if (!captions[frame].emplace(static_cast<std::int32_t>(object), sentence).second)
      fail(ErrorKind::kFormat, path, ": row ", r + 1, " describes object ", object, " of frame ",
           frame, " again");
  }
  return captions;
}

}  // namespace lvggt
