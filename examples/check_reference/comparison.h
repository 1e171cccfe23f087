// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <set>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/lvggt.h"

namespace check_reference {

// Compares computed values with the tensors of one reference file and keeps the verdicts.
class Comparison {
 public:
  Comparison(const lvggt::Safetensors& file, double tolerance);

  const lvggt::Safetensors& file() const { return file_; }

  // Whether the file holds a tensor of that name.
  bool wants(std::string_view name) const { return file_.find(name) != nullptr; }

  // The whole output of that name, row-major, against the file's tensor; nothing if there is none.
  // In a file of samples (metadata "stride") the tensor holds every stride-th element of outputs of
  // more than 4096, and NAME.stats their mean, standard deviation, minimum and maximum.
  void compare(const std::string& name, std::span<const float> values);
  template <int R>
  void compare(const std::string& name, const lvggt::Tensor<float, R>& values) {
    compare(name, {values.data(), static_cast<std::size_t>(values.size())});
  }
  void compare(const std::string& name, const std::vector<std::int64_t>& values);

  // Masks of 0 and 1, one after the other: at most `wrong` of every `pixels` values may differ.
  void compare_masks(const std::string& name, const std::uint8_t* values, std::int64_t size,
                     std::int64_t pixels, std::int64_t wrong);

  // The same with a limit of its own for rel_err.
  void compare_within(const std::string& name, std::span<const float> values, double tolerance);

  // The same by Euclidean norms, |ours - ref| / |ref| <= tolerance; the file's tensor may hold the
  // first elements only.
  void compare_l2(const std::string& name, std::span<const float> values, double tolerance);

  // Numbers of a sequence of steps, each by |ours - ref| / |ref| <= tolerance.
  void compare_steps(const std::string& name, std::span<const float> values, double tolerance);
  // The same under a name of its own, where only the first steps can be held to limits, one each;
  // the later ones are for information, and `why` says why.
  void show_steps(const std::string& name, const std::string& line, std::span<const float> values,
                  std::span<const double> limits, const std::string& why);

  // How far parameters have moved from `before`, |moved - moved ref| / |moved ref| by Euclidean
  // norms: each against `tolerance`; and, with end_moved(), all since the last end_moved()
  // together.
  void compare_moved(const std::string& name, std::span<const float> values,
                     std::span<const float> before, double tolerance);
  void end_moved(const std::string& name, double tolerance);

  // A tensor that needs no check: an input, a weight, a statement about the reference itself.
  void accept(const std::string& name) { seen_.insert(name); }
  // A tensor that is not computed, and why; it is listed, but fails nothing.
  void skip(const std::string& name, const std::string& why);

  // Fails every tensor that nothing was computed for; call once, at the end of a run.
  void finish();

  // Everything once more, computed another way: `label` is put before the names of all lines from
  // here on. An earlier run is finished first.
  void begin_run(const std::string& label);

  bool ok() const { return ok_; }
  std::string text() const;
  std::string json(const std::string& case_name) const;

 private:
  enum class Verdict { kOk, kFail, kNotChecked, kSkipped, kShown };
  enum class Measure { kMax, kL2 };
  struct Line {
    std::string name;
    double max_abs_err = 0, rel_err = 0;
    double rel_l2 = 0;  // |ours - ref| / |ref|, Euclidean norms
    Verdict verdict = Verdict::kOk;
    std::string note;  // why it failed, when the numbers do not say
    Measure measure = Measure::kMax;
  };
  Line step_errors(const std::string& name, std::span<const float> values,
                   std::span<const float> expected);
  void judge(const std::string& name, std::span<const float> ours, std::span<const float> expected,
             double tolerance, Measure measure = Measure::kMax);
  std::vector<float> take(const std::string& name, std::span<const float> ours, bool prefix);
  void add_failure(const std::string& name, const std::string& note);
  void add(Line line);

  const lvggt::Safetensors& file_;
  double tolerance_;
  std::int64_t stride_ = 1;
  std::string label_;
  std::set<std::string, std::less<>> seen_;
  std::vector<Line> lines_;
  bool ok_ = true;
  std::vector<float> moved_, moved_expected_;  // since the last end_moved()
};

}  // namespace check_reference
