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

  // A tensor that needs no check: an input, a weight, a statement about the reference itself.
  void accept(const std::string& name) { seen_.insert(name); }
  // A tensor that is not computed, and why; it is listed, but fails nothing.
  void skip(const std::string& name, const std::string& why);

  // Fails every tensor that nothing was computed for; call once, at the end.
  void finish();

  bool ok() const { return ok_; }
  std::string text() const;
  std::string json(const std::string& case_name) const;

 private:
  enum class Verdict { kOk, kFail, kNotChecked, kSkipped };
  struct Line {
    std::string name;
    double max_abs_err = 0, rel_err = 0;
    double rel_l2 = 0;  // |ours - ref| / |ref|, Euclidean norms
    Verdict verdict = Verdict::kOk;
    std::string note;  // why it failed, when the numbers do not say
  };
  void judge(const std::string& name, std::span<const float> ours, std::span<const float> expected);
  void add_failure(const std::string& name, const std::string& note);

  const lvggt::Safetensors& file_;
  double tolerance_;
  std::int64_t stride_ = 1;
  std::set<std::string, std::less<>> seen_;
  std::vector<Line> lines_;
  bool ok_ = true;
};

}  // namespace check_reference
