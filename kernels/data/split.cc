// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/split.h"

#include <algorithm>
#include <charconv>

#include "lvggt/core/error.h"

namespace lvggt {

namespace {

// A number of at most 18 digits at the front of `text`, which is removed.
bool take_number(std::string_view& text, std::int64_t& number) {
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
  if (error != std::errc() || number < 0) return false;
  text.remove_prefix(static_cast<std::size_t>(end - text.data()));
  return true;
}

}  // namespace

FrameRanges FrameRanges::parse(std::string_view text, std::string_view option) {
  FrameRanges result;
  std::string_view rest = text;
  for (bool more = true; more;) {
    std::int64_t first = 0;
    bool fine = take_number(rest, first);
    std::int64_t last = first;
    if (fine && rest.starts_with('-')) {
      rest.remove_prefix(1);
      fine = take_number(rest, last);
    }
    more = fine && rest.starts_with(',');
    if (!fine || last < first || (!more && !rest.empty()))
      fail(ErrorKind::kUsage, option, ": '", text,
           "' is no list of frame numbers like 1-48,60,72-80");
    if (more) rest.remove_prefix(1);
    result.ranges_.emplace_back(first, last);
  }
  std::sort(result.ranges_.begin(), result.ranges_.end());
  std::vector<std::pair<std::int64_t, std::int64_t>> merged;
  for (const auto& range : result.ranges_) {
    if (!merged.empty() && range.first - 1 <= merged.back().second)
      merged.back().second = std::max(merged.back().second, range.second);
    else
      merged.push_back(range);
  }
  result.ranges_ = std::move(merged);
  return result;
}

bool FrameRanges::contains(std::int64_t number) const {
  const auto after = std::upper_bound(
      ranges_.begin(), ranges_.end(), number,
      [](std::int64_t n, const std::pair<std::int64_t, std::int64_t>& r) { return n < r.first; });
  return after != ranges_.begin() && number <= std::prev(after)->second;
}

std::string FrameRanges::text() const {
  std::string text;
  for (const auto& [first, last] : ranges_) {
    if (!text.empty()) text += ',';
    text += std::to_string(first);
    if (last > first) text += '-' + std::to_string(last);
  }
  return text;
}

Split split_frames(std::span<const std::int64_t> numbers, const SplitOptions& options,
                   const std::string& scene) {
  if (options.hold_out_every < 0 || options.hold_out_every == 1)
    fail(ErrorKind::kUsage, "every ", options.hold_out_every,
         "-th frame cannot be held out; give 2 or more");
  if (!options.held_out.empty() && options.hold_out_every > 0)
    fail(ErrorKind::kUsage,
         "frames to hold out are given both as a list and as every N-th; give one of them");
  Split split;
  for (std::size_t i = 0; i < numbers.size(); ++i) {
    const auto position = static_cast<std::int64_t>(i);
    const bool held_out = options.hold_out_every > 0
                              ? position % options.hold_out_every == options.hold_out_every - 1
                              : options.held_out.contains(numbers[i]);
    const bool listed = options.train.contains(numbers[i]);
    // A list of frames to train on says so; every N-th is a rule that takes frames out of it.
    if (held_out && listed && options.hold_out_every == 0)
      fail(ErrorKind::kUsage, "frame ", numbers[i],
           " would be both trained on and held out; the lists of frames overlap");
    if (held_out)
      split.held_out.push_back(position);
    else if (options.train.empty() || listed)
      split.train.push_back(position);
  }
  const auto known = [&] {
    return numbers.empty() ? std::string(" and has none at all")
                           : concat(", it has ", numbers.size(), " from ", numbers.front(), " to ",
                                    numbers.back());
  };
  if (split.train.empty())
    fail(ErrorKind::kUsage, scene, ": has no frame to train on", known(),
         options.train.empty() ? "" : "; asked for are " + options.train.text());
  if (split.held_out.empty() && !options.held_out.empty())
    fail(ErrorKind::kUsage, scene, ": has none of the frames to hold out, ",
         options.held_out.text(), known());
  return split;
}

}  // namespace lvggt
