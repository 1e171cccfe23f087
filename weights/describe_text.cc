// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <sstream>

#include "kernels/io/printable.h"
#include "lvggt/cli/program.h"
#include "lvggt/io/json_writer.h"
#include "weights/describe.h"

namespace lvggt {
namespace {

// Lists longer than this are cut for people; the JSON form has everything.
constexpr std::size_t kMaxListed = 10;

// "1,219,050,724"
std::string grouped(std::int64_t number) {
  std::string digits = std::to_string(number);
  for (std::size_t i = digits.size(); i > 3; i -= 3) digits.insert(i - 3, ",");
  return digits;
}

class Report {
 public:
  void line(std::string label, const std::string& text) {
    label.resize(std::max<std::size_t>(label.size() + 1, 16), ' ');
    out_ << label << text << '\n';
  }
  void list(const std::string& label, const std::vector<std::string>& items) {
    if (items.empty()) return;
    line(label, concat(items.size(), items.size() == 1 ? " tensor" : " tensors"));
    for (std::size_t i = 0; i < std::min(items.size(), kMaxListed); ++i) line("", items[i]);
    if (items.size() > kMaxListed) line("", "...");
  }
  std::string text() const { return out_.str(); }

 private:
  std::ostringstream out_;
};

void report_config(const WeightsDescription& d, Report& report) {
  if (!d.config) {
    report.line("configuration", "unknown; convert the file to see it");
    return;
  }
  const ModelConfig& c = *d.config;
  report.line("configuration",
              d.config_from_metadata ? "in the metadata" : "as far as the shapes tell");
  report.line("", concat("width ", c.embed_dim, ", ", c.dino_depth, " encoder blocks, ",
                         c.agg_depth, " frame and global blocks each, ", c.agg_heads, " heads"));
  report.line("", concat("images of ", c.img_size, " pixels, patches of ", c.patch_size,
                         ", language dimension ", c.lang_dim));
  const bool complete = d.missing.empty() && d.misshapen.empty();
  report.line("", complete ? "every tensor that it needs is there in its shape"
                           : "the tensors do not fit it:");
  report.list("missing", d.missing);
  report.list("misshapen", d.misshapen);
  report.list("not needed", d.extra);
}

void write_list(JsonWriter& json, const char* key, const std::vector<std::string>& items) {
  json.key(key);
  json.begin_array();
  for (const std::string& item : items) json.value(item);
  json.end_array();
}

}  // namespace

std::string description_text(const WeightsDescription& d, const std::string& sha256) {
  Report report;
  for (const std::string& file : d.files) report.line(file == d.files.front() ? "file" : "", file);
  report.line("format", d.format);
  report.line("contents", d.contents);
  for (const std::string& note : d.notes) report.line("note", note);
  std::string types;
  for (const auto& [dtype, count] : d.dtypes)
    types += (types.empty() ? "" : ", ") + concat(dtype, " in ", count);
  report.line("tensors", concat(grouped(d.num_tensors), " (", types, ")"));
  report.line("parameters", concat(grouped(d.num_values), ", ",
                                   cli::bytes_text(static_cast<std::size_t>(d.num_bytes))));
  for (const auto& [name, part] : d.parts)
    report.line("",
                concat(name, ": ", grouped(part.num_values), " in ", part.num_tensors, " tensors"));
  report_config(d, report);
  for (const auto& [key, value] : d.metadata)
    report.line("metadata", printable(key) + " = " + printable(value));
  if (!sha256.empty()) report.line("sha256", sha256);
  report.line("licence", d.licence);
  if (d.checked && d.suspicious.empty()) report.line("values", "all finite, none suspicious");
  report.list("suspicious", d.suspicious);
  return report.text();
}

std::string description_json(const WeightsDescription& d, const std::string& sha256) {
  JsonWriter json;
  json.begin_object();
  write_list(json, "files", d.files);
  json.field("format", d.format);
  json.field("contents", d.contents);
  json.field("licence", d.licence);
  write_list(json, "notes", d.notes);
  json.field("tensors", d.num_tensors);
  json.field("parameters", d.num_values);
  json.field("bytes", d.num_bytes);
  json.key("dtypes");
  json.begin_object();
  for (const auto& [dtype, count] : d.dtypes) json.field(dtype, count);
  json.end_object();
  json.key("parts");
  json.begin_object();
  for (const auto& [name, part] : d.parts) {
    json.key(name);
    json.begin_object();
    json.field("tensors", part.num_tensors);
    json.field("parameters", part.num_values);
    json.end_object();
  }
  json.end_object();
  json.key("metadata");
  json.begin_object();
  for (const auto& [key, value] : d.metadata) json.field(key, value);
  json.end_object();
  if (d.config) {
    json.field("config_from", d.config_from_metadata ? "metadata" : "shapes");
    json.field("config", to_json(*d.config));
    write_list(json, "missing", d.missing);
    write_list(json, "misshapen", d.misshapen);
    write_list(json, "not_needed", d.extra);
  }
  if (!sha256.empty()) json.field("sha256", sha256);
  if (d.checked) write_list(json, "suspicious", d.suspicious);
  json.end_object();
  return json.take() + "\n";
}

}  // namespace lvggt
