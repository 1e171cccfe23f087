// SPDX-License-Identifier: Apache-2.0
#include "examples/evaluate/pictures.h"

#include <algorithm>
#include <array>

#include "lvggt/field/line_plot.h"
#include "lvggt/field/time_line.h"
#include "lvggt/io/image.h"
#include "lvggt/io/png.h"

namespace evaluate {

using namespace lvggt;

namespace {

constexpr Rgb8 kRight{60, 190, 80}, kWrong{225, 60, 50}, kMissed{60, 110, 230};

// The picture in grey, tinted where the mask or the truth is.
Tensor<std::uint8_t, 3> tinted(View<const std::uint8_t, 3> picture,
                               View<const std::uint8_t, 2> mask,
                               View<const std::uint8_t, 2> truth) {
  Tensor<std::uint8_t, 3> result(picture.shape());
  for (std::int64_t y = 0; y < picture.extent(0); ++y)
    for (std::int64_t x = 0; x < picture.extent(1); ++x) {
      const int grey = (picture(y, x, 0) + picture(y, x, 1) + picture(y, x, 2)) / 3;
      const bool in_mask = mask(y, x) != 0, in_truth = truth(y, x) != 0;
      const Rgb8 tint = in_mask && in_truth ? kRight : in_mask ? kWrong : kMissed;
      for (std::int64_t c = 0; c < 3; ++c)
        result(y, x, c) = static_cast<std::uint8_t>(
            in_mask || in_truth ? (grey + 2 * tint[static_cast<std::size_t>(c)]) / 3 : grey);
    }
  return result;
}

}  // namespace

MaskSheet::MaskSheet(const std::string& picture_folder, const std::string& title)
    : folder_(picture_folder), title_(title) {}

void MaskSheet::add(const FrameView& view) {
  if (!sheet_) {
    std::vector<std::string> rows{"picture"};
    rows.insert(rows.end(), view.labels.begin(), view.labels.end());
    ContactSheet::Options options;
    options.title = title_;
    options.footer = "green: found rightly, red: found wrongly, blue: missed";
    sheet_ = std::make_unique<ContactSheet>(rows, options);
  }
  if (!sheet_->wants_next()) return sheet_->skip();
  const Image image = load_image(folder_ + "/" + view.image.file_name);
  std::vector<Tensor<std::uint8_t, 3>> pictures;
  pictures.push_back(image.pixels.clone());
  for (std::int64_t i = 0; i < std::ssize(view.labels); ++i) {
    if (image.height() != view.image.height || image.width() != view.image.width) break;
    pictures.push_back(tinted(image.pixels, view.masks[i], view.truth[i]));
  }
  pictures.resize(view.labels.size() + 1);
  std::vector<View<const std::uint8_t, 3>> views;
  for (const auto& picture : pictures)
    views.push_back(picture.empty() ? View<const std::uint8_t, 3>() : picture.view());
  sheet_->add(std::to_string(view.image.frame), views);
}

void MaskSheet::write(const std::string& path) const {
  if (sheet_ && !sheet_->empty()) write_png(path, sheet_->render());
}

void write_time_lines(const std::string& path, const SceneResult& scene) {
  constexpr Rgb8 kBlue{31, 119, 180}, kRed{200, 60, 40}, kShade{214, 234, 214};
  std::vector<PlotPanel> panels;
  for (const StateResult& state : scene.states) {
    if (state.frames.empty()) continue;
    std::vector<double> frames(state.frames.begin(), state.frames.end());
    std::vector<std::array<double, 2>> smoothed;
    for (std::size_t i = 0; i < frames.size(); ++i)
      smoothed.push_back({frames[i], state.answer.smoothed[i]});
    const double mean = state.answer.threshold;
    PlotPanel panel{"\"" + state.wording + "\": similarity", "frame", {}, false};
    panel.bands = positive_bands(frames, state.truth);
    panel.band_color = kShade;
    panel.curves.push_back({"annotated: it holds", kShade, {}, false});
    panel.curves.push_back({"smoothed", kBlue, smoothed, false});
    panel.curves.push_back(
        {"threshold", kRed, {{frames.front(), mean}, {frames.back(), mean}}, false});
    panels.push_back(std::move(panel));
  }
  if (panels.empty()) return;
  constexpr std::int64_t kWidth = 840, kPanelHeight = 230;
  write_png(path, LinePlot(kWidth, kPanelHeight).draw(panels));
}

}  // namespace evaluate
