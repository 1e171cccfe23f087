// SPDX-License-Identifier: Apache-2.0
#include "examples/check_reference/comparison.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <limits>

#include "lvggt/io/json_writer.h"

namespace check_reference {
namespace {

// Outputs up to this size are stored whole in a file of samples.
constexpr std::size_t kSampledFrom = 4096;

constexpr double kInfinity = std::numeric_limits<double>::infinity();

std::vector<float> sampled(std::span<const float> values, std::int64_t stride) {
  if (values.size() <= kSampledFrom) return {values.begin(), values.end()};
  std::vector<float> samples;
  for (std::size_t i = 0; i < values.size(); i += static_cast<std::size_t>(stride))
    samples.push_back(values[i]);
  return samples;
}

// Mean, population standard deviation, minimum, maximum.
std::vector<float> statistics(std::span<const float> values) {
  double sum = 0, squares = 0;
  float low = values[0], high = values[0];
  for (const float v : values) {
    sum += v;
    low = std::min(low, v);
    high = std::max(high, v);
  }
  const double mean = sum / static_cast<double>(values.size());
  for (const float v : values) squares += (v - mean) * (v - mean);
  const double deviation = std::sqrt(squares / static_cast<double>(values.size()));
  return {static_cast<float>(mean), static_cast<float>(deviation), low, high};
}

}  // namespace

Comparison::Comparison(const lvggt::Safetensors& file, double tolerance)
    : file_(file), tolerance_(tolerance) {
  const auto found = file.metadata().find("stride");
  if (found == file.metadata().end()) return;
  const std::string& text = found->second;
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), stride_);
  if (error != std::errc() || end != text.data() + text.size() || stride_ < 1)
    lvggt::fail(lvggt::ErrorKind::kFormat, file.path(), ": metadata \"stride\" is \"", text,
                "\", not a positive number");
}

void Comparison::compare(const std::string& name, std::span<const float> values) {
  const lvggt::TensorEntry* entry = file_.find(name);
  if (entry == nullptr || !seen_.insert(name).second) return;
  const std::vector<float> samples = sampled(values, stride_ > 1 ? stride_ : 1);
  const std::span<const float> ours = stride_ > 1 ? std::span<const float>(samples) : values;
  if (entry->size() != static_cast<std::int64_t>(ours.size())) {
    add_failure(name, "has " + std::to_string(ours.size()) + " values where the reference has " +
                          std::to_string(entry->size()));
    return;
  }
  std::vector<float> expected(ours.size());
  file_.read_into(name, expected);
  judge(name, ours, expected, tolerance_);

  const std::string stats_name = name + ".stats";
  if (!wants(stats_name) || values.empty()) return;
  seen_.insert(stats_name);
  std::vector<float> expected_stats(static_cast<std::size_t>(file_.at(stats_name).size()));
  file_.read_into(stats_name, expected_stats);
  const std::vector<float> stats = statistics(values);
  if (stats.size() != expected_stats.size()) {
    add_failure(stats_name, "does not hold mean, deviation, minimum and maximum");
    return;
  }
  judge(stats_name, stats, expected_stats, tolerance_);
}

// The file's values for a tensor that is compared now; empty when there is none, or when their
// number is not that of ours (or above it, where a prefix will do): then the verdict is recorded.
std::vector<float> Comparison::take(const std::string& name, std::span<const float> ours,
                                    bool prefix) {
  const lvggt::TensorEntry* entry = file_.find(name);
  if (entry == nullptr || !seen_.insert(name).second) return {};
  const auto size = static_cast<std::size_t>(entry->size());
  if (prefix ? size > ours.size() : size != ours.size()) {
    add_failure(name, "has " + std::to_string(ours.size()) + " values where the reference has " +
                          std::to_string(size));
    return {};
  }
  std::vector<float> expected(size);
  file_.read_into(name, expected);
  return expected;
}

void Comparison::compare_within(const std::string& name, std::span<const float> values,
                                double tolerance) {
  const std::vector<float> expected = take(name, values, false);
  if (!expected.empty()) judge(name, values, expected, tolerance);
}

void Comparison::compare_l2(const std::string& name, std::span<const float> values,
                            double tolerance) {
  const std::vector<float> expected = take(name, values, true);
  if (!expected.empty())
    judge(name, values.first(expected.size()), expected, tolerance, Measure::kL2);
}

void Comparison::compare_steps(const std::string& name, std::span<const float> values,
                               double tolerance) {
  const std::vector<float> expected = take(name, values, false);
  if (expected.empty()) return;
  Line line = step_errors(name, values, expected);
  if (!(line.rel_err <= tolerance)) line.verdict = Verdict::kFail;
  add(std::move(line));
}

void Comparison::show_steps(const std::string& name, const std::string& line_name,
                            std::span<const float> values, std::span<const double> limits,
                            const std::string& why) {
  const lvggt::TensorEntry* entry = file_.find(name);
  if (entry == nullptr || entry->size() != static_cast<std::int64_t>(values.size())) return;
  std::vector<float> expected(values.size());
  file_.read_into(name, expected);
  Line line = step_errors(line_name, values, expected);
  line.verdict = Verdict::kShown;
  line.note = why;
  for (std::size_t i = 0; i < std::min(limits.size(), values.size()); ++i) {
    const Line step =
        step_errors(line_name, values.subspan(i, 1), std::span(expected).subspan(i, 1));
    if (step.rel_err <= limits[i]) continue;
    line.verdict = Verdict::kFail;
    line.note = lvggt::concat("step ", i + 1, " is off by ", step.rel_err, ", limit ", limits[i]);
  }
  add(std::move(line));
}

Comparison::Line Comparison::step_errors(const std::string& name, std::span<const float> values,
                                         std::span<const float> expected) {
  Line line{name, 0, 0, 0, Verdict::kOk, {}, Measure::kMax};
  for (std::size_t i = 0; i < expected.size(); ++i) {
    const double difference = std::abs(static_cast<double>(values[i]) - expected[i]);
    const double error = std::isnan(difference) ? kInfinity : difference;
    line.max_abs_err = std::max(line.max_abs_err, error);
    line.rel_err = std::max(line.rel_err, error / std::abs(expected[i]));
  }
  return line;
}

void Comparison::compare_moved(const std::string& name, std::span<const float> values,
                               std::span<const float> before, double tolerance) {
  std::vector<float> expected = take(name, values, true);
  if (expected.empty()) return;
  std::vector<float> moved(expected.size());
  for (std::size_t i = 0; i < expected.size(); ++i) {
    moved[i] = values[i] - before[i];
    expected[i] -= before[i];
  }
  judge(name, moved, expected, tolerance, Measure::kL2);
  moved_.insert(moved_.end(), moved.begin(), moved.end());
  moved_expected_.insert(moved_expected_.end(), expected.begin(), expected.end());
}

void Comparison::end_moved(const std::string& name, double tolerance) {
  if (!moved_.empty()) judge(name, moved_, moved_expected_, tolerance, Measure::kL2);
  moved_.clear();
  moved_expected_.clear();
}

void Comparison::compare(const std::string& name, const std::vector<std::int64_t>& values) {
  if (!wants(name) || !seen_.insert(name).second) return;
  const std::vector<std::int64_t> expected = file_.read_int64(name);
  if (expected.size() != values.size()) {
    add_failure(name, "has " + std::to_string(values.size()) + " values where the reference has " +
                          std::to_string(expected.size()));
    return;
  }
  Line line{name, 0, 0, 0, Verdict::kOk, {}, Measure::kMax};
  double largest = 0;
  for (std::size_t i = 0; i < values.size(); ++i) {
    line.max_abs_err =
        std::max(line.max_abs_err, std::abs(static_cast<double>(values[i] - expected[i])));
    largest = std::max(largest, std::abs(static_cast<double>(expected[i])));
  }
  if (line.max_abs_err != 0) line.rel_err = largest > 0 ? line.max_abs_err / largest : kInfinity;
  if (line.max_abs_err != 0) line.verdict = Verdict::kFail;  // whole numbers are exact
  add(std::move(line));
}

void Comparison::compare_masks(const std::string& name, const std::uint8_t* values,
                               std::int64_t size, std::int64_t pixels, std::int64_t wrong) {
  if (!wants(name) || !seen_.insert(name).second) return;
  const std::vector<std::int64_t> expected = file_.read_int64(name);
  if (static_cast<std::int64_t>(expected.size()) != size) {
    add_failure(name, "has " + std::to_string(size) + " values where the reference has " +
                          std::to_string(expected.size()));
    return;
  }
  std::int64_t most = 0, differing = 0;
  for (std::int64_t i = 0; i < size; ++i) {
    if (i % pixels == 0) differing = 0;
    differing += expected[static_cast<std::size_t>(i)] != values[i];
    most = std::max(most, differing);
  }
  const auto count = static_cast<double>(most);
  Line line{name, count, count / static_cast<double>(pixels), 0, Verdict::kOk, {}, Measure::kMax};
  if (most > wrong) {
    line.verdict = Verdict::kFail;
    line.note = std::to_string(most) + " pixels of one mask differ";
  }
  add(std::move(line));
}

void Comparison::judge(const std::string& name, std::span<const float> ours,
                       std::span<const float> expected, double tolerance, Measure measure) {
  Line line{name, 0, 0, 0, Verdict::kOk, {}, Measure::kMax};
  double largest = 0, squared_error = 0, squared_norm = 0;
  for (std::size_t i = 0; i < ours.size(); ++i) {
    const double a = ours[i], b = expected[i];
    // Equal infinities differ by nothing; a NaN differs from everything.
    const double error = a == b ? 0 : std::abs(a - b);
    line.max_abs_err = error <= line.max_abs_err ? line.max_abs_err
                       : std::isnan(error)       ? kInfinity
                                                 : error;
    if (std::isfinite(b)) largest = std::max(largest, std::abs(b));
    squared_error += error * error;
    squared_norm += b * b;
  }
  if (squared_error > 0) line.rel_l2 = std::sqrt(squared_error / squared_norm);
  if (line.max_abs_err > 0) line.rel_err = largest > 0 ? line.max_abs_err / largest : kInfinity;
  line.measure = measure;
  const double error = measure == Measure::kL2 ? line.rel_l2 : line.rel_err;
  if (!(error <= tolerance)) line.verdict = Verdict::kFail;
  add(std::move(line));
}

void Comparison::add(Line line) {
  line.name = label_ + line.name;
  ok_ = ok_ && line.verdict != Verdict::kFail && line.verdict != Verdict::kNotChecked;
  lines_.push_back(std::move(line));
}

void Comparison::add_failure(const std::string& name, const std::string& note) {
  add({name, kInfinity, kInfinity, kInfinity, Verdict::kFail, note, Measure::kMax});
}

void Comparison::skip(const std::string& name, const std::string& why) {
  if (!wants(name) || !seen_.insert(name).second) return;
  add({name, 0, 0, 0, Verdict::kSkipped, why, Measure::kMax});
}

void Comparison::finish() {
  for (const lvggt::TensorEntry& entry : file_.entries()) {
    const std::string& name = entry.name;
    if (seen_.contains(name) || name.starts_with("weight.") || name.ends_with(".noise")) continue;
    add({name, 0, 0, 0, Verdict::kNotChecked, "nothing was computed for it", Measure::kMax});
  }
}

void Comparison::begin_run(const std::string& label) {
  if (!seen_.empty()) finish();
  seen_.clear();
  label_ = label;
}

std::string Comparison::text() const {
  std::size_t width = 4;
  for (const Line& line : lines_) width = std::max(width, line.name.size());
  std::string text;
  for (const Line& line : lines_) {
    std::string name = line.name;
    name.resize(width, ' ');
    char numbers[64];
    std::snprintf(numbers, sizeof numbers, "%.3e  %.3e", line.max_abs_err,
                  line.measure == Measure::kL2 ? line.rel_l2 : line.rel_err);
    switch (line.verdict) {
      case Verdict::kOk:
        text += name + "  " + numbers + "  ok\n";
        break;
      case Verdict::kFail:
        text +=
            name + "  " + numbers + "  FAIL" + (line.note.empty() ? "" : "  " + line.note) + "\n";
        break;
      case Verdict::kNotChecked:
        text += name + "  -  -  FAIL  not checked: " + line.note + "\n";
        break;
      case Verdict::kSkipped:
        text += name + "  -  -  skipped  " + line.note + "\n";
        break;
      case Verdict::kShown:
        text += name + "  " + numbers + "  not judged  " + line.note + "\n";
        break;
    }
  }
  return text;
}

std::string Comparison::json(const std::string& case_name) const {
  lvggt::JsonWriter out;
  const auto number = [&](const char* key, double value) {
    out.key(key);
    if (std::isfinite(value)) {
      out.value(value);
    } else {
      out.null();
    }
  };
  out.begin_object();
  out.field("case", case_name);
  out.field("tolerance", tolerance_);
  out.field("ok", ok_);
  out.key("tensors");
  out.begin_array();
  for (const Line& line : lines_) {
    if (line.verdict == Verdict::kSkipped || line.verdict == Verdict::kShown) continue;
    out.begin_object();
    out.field("name", line.name);
    number("max_abs_err", line.verdict == Verdict::kNotChecked ? kInfinity : line.max_abs_err);
    number("rel_err", line.verdict == Verdict::kNotChecked ? kInfinity : line.rel_err);
    number("rel_l2", line.verdict == Verdict::kNotChecked ? kInfinity : line.rel_l2);
    out.field("ok", line.verdict == Verdict::kOk);
    if (!line.note.empty()) out.field("note", line.note);
    out.end_object();
  }
  out.end_array();
  out.key("skipped");
  out.begin_array();
  for (const Line& line : lines_)
    if (line.verdict == Verdict::kSkipped) out.value(line.name);
  out.end_array();
  out.key("not_judged");
  out.begin_array();
  for (const Line& line : lines_) {
    if (line.verdict != Verdict::kShown) continue;
    out.begin_object();
    out.field("name", line.name);
    number("max_abs_err", line.max_abs_err);
    number("rel_err", line.rel_err);
    out.field("note", line.note);
    out.end_object();
  }
  out.end_array();
  out.end_object();
  return out.take();
}

}  // namespace check_reference
