// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <string>
#include <string_view>
#include <vector>

namespace lvggt {

// Rows of comma-separated values (RFC 4180): fields in double quotes may hold commas, line ends and
// doubled quotes. `source` opens messages. Errors: kFormat for a quote that is not closed or stands
// inside of a field.
std::vector<std::vector<std::string>> parse_csv(std::string_view text, const std::string& source);

// What each object does in each frame: sentences by frame number (as in the file name) and object
// number (as in the masks).
using Captions = std::map<std::int64_t, std::map<std::int32_t, std::string>>;

// From CSV with the columns frame, object, sentence, in this order, or in any order under a first
// row that names them. Empty sentences are left out. Errors: kFormat for another number of columns,
// numbers that are none, and an object captioned twice in a frame, naming the row.
Captions read_captions(const std::string& path);

}  // namespace lvggt
