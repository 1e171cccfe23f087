// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <charconv>
#include <filesystem>
#include <map>

#include "examples/evaluate/codes_source.h"
#include "lvggt/io/npy.h"

namespace evaluate {
namespace {

using namespace lvggt;

// The .npy files of one folder by the frame they are of.
class RenderFolder {
 public:
  RenderFolder(const std::string& folder, const std::vector<std::int64_t>& annotated)
      : folder_(folder) {
    std::error_code error;
    std::map<std::int64_t, std::string> by_number;
    for (const auto& entry : std::filesystem::directory_iterator(folder, error)) {
      const std::string name = entry.path().stem().string();
      if (entry.path().extension() != ".npy") continue;
      std::int64_t number = -1;
      const char* end = name.data() + name.size();
      const auto [rest, bad] = std::from_chars(name.data(), end, number);
      if (bad != std::errc() || rest != end || number < 0)
        fail(ErrorKind::kFormat, entry.path().string(), ": its name is not the number of a frame");
      if (!by_number.emplace(number, entry.path().string()).second)
        fail(ErrorKind::kFormat, entry.path().string(), ": there are two files of that number");
    }
    if (error) fail(ErrorKind::kRead, folder, ": ", error.message());
    if (by_number.empty()) fail(ErrorKind::kRead, folder, ": holds no .npy files");
    assign(by_number, annotated);
  }

  void read(View<float, 3> y, std::int64_t frame) const {
    const NpyFile file(files_.at(frame));
    const Tensor<float, 3> map = file.read<3>();
    LVGGT_CHECK(map.extent(2) == dim(), file.path(), ": has features of ", map.extent(2),
                " numbers, but others of the folder have ", dim());
    resample_to_picture(y, map, stretch(map.extent(0), map.extent(1), y.extent(0), y.extent(1)));
  }

  // Numbers a pixel.
  std::int64_t dim() const { return dim_; }

 private:
  // Files are numbered by the index of their frame, or, when only the annotated frames were
  // rendered, one after the other from 0 or 1.
  void assign(const std::map<std::int64_t, std::string>& by_number,
              const std::vector<std::int64_t>& annotated) {
    const bool by_index = std::ranges::all_of(
        annotated, [&](std::int64_t frame) { return by_number.contains(frame); });
    const std::int64_t first_number = by_number.begin()->first;
    const bool in_a_row = first_number <= 1 && by_number.size() == annotated.size() &&
                          by_number.rbegin()->first - first_number + 1 == std::ssize(annotated);
    LVGGT_CHECK(by_index || in_a_row, folder_, ": holds ", by_number.size(),
                " maps, which are neither numbered by the annotated frames nor one after the other "
                "as many as these, ",
                annotated.size());
    auto next = by_number.begin();
    for (const std::int64_t frame : annotated)
      files_[frame] = by_index ? by_number.at(frame) : (next++)->second;
    const NpyFile first(files_.begin()->second);
    LVGGT_CHECK(first.shape().size() == 3, first.path(), ": is no map of features [H, W, d]");
    dim_ = first.shape()[2];
  }

  std::string folder_;
  std::map<std::int64_t, std::string> files_;
  std::int64_t dim_ = 0;
};

class RenderSource : public CodesSource {
 public:
  RenderSource(const std::vector<std::string>& levels, const std::string& states,
               const std::vector<std::int64_t>& annotated) {
    for (const std::string& folder : levels) levels_.emplace_back(folder, annotated);
    for (std::size_t i = 1; i < levels.size(); ++i)
      LVGGT_CHECK(levels_[i].dim() == levels_[0].dim(), levels[i], ": has features of ",
                  levels_[i].dim(), " numbers, but ", levels[0], " of ", levels_[0].dim());
    if (!states.empty()) states_.emplace_back(states, annotated);
  }

  bool has_states() const override { return !states_.empty(); }

  void read(FrameCodes& codes, std::int64_t frame, std::int64_t H, std::int64_t W) override {
    const Shape maps{std::ssize(levels_), H, W, levels_[0].dim()};
    if (codes.language.shape() != maps) codes.language = Tensor<float, 4>(maps);
    for (std::size_t i = 0; i < levels_.size(); ++i)
      levels_[i].read(codes.language[static_cast<std::int64_t>(i)], frame);
    if (states_.empty()) return;
    const Shape map{H, W, states_[0].dim()};
    if (codes.states.shape() != map) codes.states = Tensor<float, 3>(map);
    states_[0].read(codes.states, frame);
  }

 private:
  std::vector<RenderFolder> levels_, states_;
};

}  // namespace

std::unique_ptr<CodesSource> open_renders(const std::vector<std::string>& levels,
                                          const std::string& states,
                                          const std::vector<std::int64_t>& annotated) {
  return std::make_unique<RenderSource>(levels, states, annotated);
}

}  // namespace evaluate
