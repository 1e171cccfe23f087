// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstdint>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/field/color_map.h"
#include "lvggt/field/label.h"

namespace lvggt {

// A line through points (x, y); points that are not finite, or not positive on a logarithmic axis,
// are left out.
struct Curve {
  std::string name;  // for the legend; without one it is not listed
  Rgb8 color{};
  std::vector<std::array<double, 2>> points;
  bool faint = false;  // drawn thin and pale, as the raw values behind a smoothed line
};

struct PlotPanel {
  std::string title, x_label;
  std::vector<Curve> curves;
  bool logarithmic = false;                    // the y axis
  std::vector<std::array<double, 2>> bands{};  // ranges of x that are shaded
  Rgb8 band_color{214, 234, 214};
};

// Round numbers inside [low, high], about `count` of them: 1, 2 or 5 times a power of ten apart.
inline std::vector<double> axis_ticks(double low, double high, int count) {
  if (!(high > low) || count < 1) return {low};
  const double rough = (high - low) / count;
  const double power = std::pow(10.0, std::floor(std::log10(rough)));
  double step = 10 * power;
  for (const double factor : {1.0, 2.0, 5.0})
    if (factor * power >= rough * (1 - 1e-9)) {
      step = factor * power;
      break;
    }
  std::vector<double> ticks;
  // Whole multiples of the step: adding it up would drift away from round numbers.
  for (double i = std::ceil(low / step - 1e-9); i * step <= high + 1e-9 * step; ++i)
    ticks.push_back(i == 0 ? 0 : i * step);
  return ticks;
}

// Ticks of a logarithmic axis: the powers of ten in [low, high], with their doubles and fivefolds
// when there are few.
inline std::vector<double> log_axis_ticks(double low, double high) {
  std::vector<double> ticks;
  const bool few = high / low < 1000;
  for (double power = std::floor(std::log10(low)); power <= std::ceil(std::log10(high)); ++power)
    for (const double factor : {1.0, 2.0, 5.0}) {
      const double tick = factor * std::pow(10.0, power);
      if ((few || factor == 1.0) && tick >= low * (1 - 1e-9) && tick <= high * (1 + 1e-9))
        ticks.push_back(tick);
    }
  return ticks;
}

// A tick's number with up to four digits: "0.02", "1500", "4e-05".
inline std::string tick_text(double value) {
  char text[32];
  return {text, std::to_chars(text, text + sizeof text, value, std::chars_format::general, 4).ptr};
}

// The mean over the last points up to `window` of them, for a line through noisy values.
inline std::vector<std::array<double, 2>> moving_average(
    const std::vector<std::array<double, 2>>& points, std::size_t window) {
  std::vector<std::array<double, 2>> smooth;
  for (std::size_t i = 0; i < points.size(); ++i) {
    const std::size_t first = i + 1 > window ? i + 1 - window : 0;
    double sum = 0;
    for (std::size_t j = first; j <= i; ++j) sum += points[j][1];
    smooth.push_back({points[i][0], sum / static_cast<double>(i + 1 - first)});
  }
  return smooth;
}

// Draws panels below each other, each with axes, ticks, grid, title and legend, dark on white. They
// share one range of x, so that what happens at the same x stands below each other.
class LinePlot {
 public:
  LinePlot(std::int64_t width, std::int64_t panel_height)
      : width_(width), panel_height_(panel_height) {
    LVGGT_CHECK(width >= 320 && panel_height >= 160, "plot: ", width, " x ", panel_height,
                " pixels are too few for axes and labels");
  }

  //   -> [H, W, 3]
  Tensor<std::uint8_t, 3> draw(const std::vector<PlotPanel>& panels) const {
    LVGGT_CHECK(!panels.empty(), "plot: there are no panels");
    Tensor<std::uint8_t, 3> picture(
        Shape{panel_height_ * static_cast<std::int64_t>(panels.size()), width_, std::int64_t{3}});
    std::fill_n(picture.data(), picture.size(), std::uint8_t{255});
    std::vector<Axes> axes;
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    double x_low = kInfinity, x_high = -kInfinity;
    for (const PlotPanel& panel : panels) {
      axes.push_back(axes_of(panel));
      if (axes.back().empty) continue;
      x_low = std::min(x_low, axes.back().x_low);
      x_high = std::max(x_high, axes.back().x_high);
    }
    for (std::size_t i = 0; i < panels.size(); ++i) {
      const std::int64_t top = static_cast<std::int64_t>(i) * panel_height_;
      if (x_low < x_high) {
        axes[i].x_low = x_low;
        axes[i].x_high = x_high;
      }
      draw_panel(picture.view().narrow(0, top, top + panel_height_), panels[i], axes[i]);
    }
    return picture;
  }

 private:
  static constexpr std::int64_t kLeft = 76, kRight = 20, kTop = 34, kBottom = 40;
  static constexpr Rgb8 kInk{40, 40, 40}, kGrid{225, 225, 225};

  // Where numbers are on the picture.
  struct Axes {
    double x_low = 0, x_high = 1, y_low = 0, y_high = 1;
    bool logarithmic = false, empty = true;
    double left = 0, right = 0, top = 0, bottom = 0;

    double x(double value) const {
      return left + (right - left) * (value - x_low) / (x_high - x_low);
    }
    double y(double value) const {
      const double v = logarithmic ? std::log10(value) : value;
      return bottom - (bottom - top) * (v - y_low) / (y_high - y_low);
    }
    bool shows(const std::array<double, 2>& point) const {
      return std::isfinite(point[0]) && std::isfinite(point[1]) && (!logarithmic || point[1] > 0);
    }
  };

  Axes axes_of(const PlotPanel& panel) const {
    constexpr double kInfinity = std::numeric_limits<double>::infinity();
    Axes axes;
    axes.logarithmic = panel.logarithmic;
    axes.left = kLeft;
    axes.right = static_cast<double>(width_ - kRight);
    axes.top = kTop;
    axes.bottom = static_cast<double>(panel_height_ - kBottom);
    double x_low = kInfinity, x_high = -kInfinity, y_low = kInfinity, y_high = -kInfinity;
    for (const Curve& curve : panel.curves)
      for (const auto& point : curve.points) {
        if (!axes.shows(point)) continue;
        const double y = panel.logarithmic ? std::log10(point[1]) : point[1];
        x_low = std::min(x_low, point[0]);
        x_high = std::max(x_high, point[0]);
        y_low = std::min(y_low, y);
        y_high = std::max(y_high, y);
      }
    if (!(x_low <= x_high)) return axes;  // nothing to show
    const double y_room = y_high > y_low ? 0.05 * (y_high - y_low) : 0.5 * std::abs(y_low) + 0.1;
    axes.empty = false;
    axes.x_low = x_low;
    axes.x_high = x_high > x_low ? x_high : x_low + 1;
    axes.y_low = y_low - y_room;
    axes.y_high = y_high + y_room;
    return axes;
  }

  void draw_panel(View<std::uint8_t, 3> picture, const PlotPanel& panel, const Axes& axes) const {
    for (const auto& band : panel.bands) draw_band(picture, axes, band, panel.band_color);
    draw_axes(picture, axes);
    draw_label(picture, kLeft, 8, panel.title, 1, kInk);
    draw_label(picture, (kLeft + width_ - kRight - label_width(panel.x_label, 1)) / 2,
               panel_height_ - kLabelHeight - 4, panel.x_label, 1, kInk);
    for (const Curve& curve : panel.curves) draw_curve(picture, axes, curve);
    draw_legend(picture, panel);
  }

  void draw_axes(View<std::uint8_t, 3> picture, const Axes& axes) const {
    const std::vector<double> rows =
        axes.logarithmic ? log_axis_ticks(std::pow(10, axes.y_low), std::pow(10, axes.y_high))
                         : axis_ticks(axes.y_low, axes.y_high, 5);
    for (const double tick : rows) {
      const double y = axes.y(tick);
      draw_segment(picture, axes.left, y, axes.right, y, 0.5, kGrid, 1);
      const std::string text = tick_text(tick);
      draw_label(picture, kLeft - 6 - label_width(text, 1),
                 static_cast<std::int64_t>(y) - kLabelHeight / 2, text, 1, kInk);
    }
    for (const double tick : axis_ticks(axes.x_low, axes.x_high, 8)) {
      const double x = axes.x(tick);
      draw_segment(picture, x, axes.bottom, x, axes.bottom + 4, 0.5, kInk, 1);
      const std::string text = tick_text(tick);
      draw_label(picture, static_cast<std::int64_t>(x) - label_width(text, 1) / 2,
                 static_cast<std::int64_t>(axes.bottom) + 6, text, 1, kInk);
    }
    draw_segment(picture, axes.left, axes.top, axes.left, axes.bottom, 0.5, kInk, 1);
    draw_segment(picture, axes.left, axes.bottom, axes.right, axes.bottom, 0.5, kInk, 1);
  }

  static void draw_band(View<std::uint8_t, 3> picture, const Axes& axes,
                        const std::array<double, 2>& band, const Rgb8& color) {
    const auto pixel = [&](double value) {
      return static_cast<std::int64_t>(
          std::lround(std::clamp(axes.x(value), axes.left, axes.right)));
    };
    for (auto row = static_cast<std::int64_t>(axes.top);
         row < static_cast<std::int64_t>(axes.bottom); ++row)
      for (std::int64_t column = pixel(band[0]); column <= pixel(band[1]); ++column)
        std::copy(color.begin(), color.end(), &picture(row, column, 0));
  }

  static void draw_curve(View<std::uint8_t, 3> picture, const Axes& axes, const Curve& curve) {
    const double half_width = curve.faint ? 0.5 : 1, opacity = curve.faint ? 0.35 : 1;
    const std::array<double, 2>* before = nullptr;
    for (const auto& point : curve.points) {
      if (!axes.shows(point)) continue;
      const double x = axes.x(point[0]), y = axes.y(point[1]);
      // A point alone is shown as a dot.
      if (before == nullptr && curve.points.size() < 3)
        draw_segment(picture, x, y, x, y, 2, curve.color, opacity);
      if (before != nullptr)
        draw_segment(picture, axes.x((*before)[0]), axes.y((*before)[1]), x, y, half_width,
                     curve.color, opacity);
      before = &point;
    }
  }

  void draw_legend(View<std::uint8_t, 3> picture, const PlotPanel& panel) const {
    constexpr std::int64_t kSample = 18, kGap = 6;
    std::int64_t x = width_ - kRight;
    for (auto curve = panel.curves.rbegin(); curve != panel.curves.rend(); ++curve) {
      if (curve->name.empty()) continue;
      x -= label_width(curve->name, 1);
      draw_label(picture, x, 8, curve->name, 1, kInk);
      x -= kSample + kGap;
      const double y = 8 + kLabelHeight / 2.0;
      draw_segment(picture, static_cast<double>(x), y, static_cast<double>(x + kSample), y, 1.5,
                   curve->color, 1);
      x -= 2 * kGap;
    }
  }

  // Paints the pixels within half_width of the segment; those on its edge by the share covered.
  static void draw_segment(View<std::uint8_t, 3> picture, double x0, double y0, double x1,
                           double y1, double half_width, const Rgb8& color, double opacity) {
    const double reach = half_width + 1;
    const auto clamp = [](double value, std::int64_t extent) {
      return static_cast<std::int64_t>(std::clamp(value, 0.0, static_cast<double>(extent)));
    };
    const std::int64_t left = clamp(std::floor(std::min(x0, x1) - reach), picture.extent(1));
    const std::int64_t right = clamp(std::ceil(std::max(x0, x1) + reach), picture.extent(1));
    const std::int64_t top = clamp(std::floor(std::min(y0, y1) - reach), picture.extent(0));
    const std::int64_t bottom = clamp(std::ceil(std::max(y0, y1) + reach), picture.extent(0));
    const double dx = x1 - x0, dy = y1 - y0, length2 = dx * dx + dy * dy;
    for (std::int64_t row = top; row < bottom; ++row)
      for (std::int64_t column = left; column < right; ++column) {
        const double px = static_cast<double>(column) + 0.5 - x0;
        const double py = static_cast<double>(row) + 0.5 - y0;
        const double t = length2 > 0 ? std::clamp((px * dx + py * dy) / length2, 0.0, 1.0) : 0;
        const double distance = std::hypot(px - t * dx, py - t * dy);
        const double cover = opacity * std::clamp(half_width + 0.5 - distance, 0.0, 1.0);
        if (cover <= 0) continue;
        for (std::int64_t c = 0; c < 3; ++c) {
          std::uint8_t& pixel = picture(row, column, c);
          const double paint = color[static_cast<std::size_t>(c)];
          pixel = static_cast<std::uint8_t>(std::lround(pixel + cover * (paint - pixel)));
        }
      }
  }

  std::int64_t width_, panel_height_;
};

}  // namespace lvggt
