// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/polygon.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <utility>
#include <vector>

namespace lvggt {
namespace {

struct Point {
  std::int64_t x = 0, y = 0;
};

// Which sides of the range [0, last] a coordinate lies beyond: 1 below, 2 above.
int beyond(std::int64_t v, std::int64_t last) { return v < 0 ? 1 : v > last ? 2 : 0; }

// Moves `p` along the line to `q` until its row (or column, `along` and `across` exchanged) is
// inside; the other coordinate is truncated as C++ converts a double.
void move_inside(std::int64_t Point::*along, std::int64_t Point::*across, Point& p, const Point& q,
                 std::int64_t last) {
  const int side = beyond(p.*along, last);
  if (side == 0) return;
  const std::int64_t border = side == 1 ? 0 : last;
  const double moved = static_cast<double>(border - p.*along) *
                       static_cast<double>(q.*across - p.*across) /
                       static_cast<double>(q.*along - p.*along);
  p.*across += static_cast<std::int64_t>(moved);
  p.*along = border;
}

// Clips a segment to the image; false when nothing is left. Rows first, then columns, the first
// point before the second: the rounding depends on the order.
bool clip(Point& a, Point& b, std::int64_t H, std::int64_t W) {
  const auto shares_side = [&] {
    return (beyond(a.x, W - 1) & beyond(b.x, W - 1)) != 0 ||
           (beyond(a.y, H - 1) & beyond(b.y, H - 1)) != 0;
  };
  if (shares_side()) return false;
  move_inside(&Point::y, &Point::x, a, b, H - 1);
  move_inside(&Point::y, &Point::x, b, a, H - 1);
  if (shares_side()) return false;
  move_inside(&Point::x, &Point::y, a, b, W - 1);
  move_inside(&Point::x, &Point::y, b, a, W - 1);
  return true;
}

// Bresenham's line from the left end to the right one.
void draw_line(View<std::uint8_t, 2> mask, Point a, Point b) {
  if (!clip(a, b, mask.extent(0), mask.extent(1))) return;
  if (b.x < a.x) std::swap(a, b);
  const std::int64_t dx = b.x - a.x, dy = std::abs(b.y - a.y), down = b.y < a.y ? -1 : 1;
  const std::int64_t major = std::max(dx, dy), minor = std::min(dx, dy);
  std::int64_t error = major - 2 * minor;
  Point p = a;
  for (std::int64_t i = 0; i <= major; ++i) {
    mask(p.y, p.x) = 1;
    const bool both = error < 0;
    if (dx >= dy || both) ++p.x;
    if (dy > dx || both) p.y += down;
    error += (both ? 2 * major : 0) - 2 * minor;
  }
}

// An edge that is not horizontal, from its upper end.
struct Edge {
  std::int64_t top = 0, bottom = 0;  // rows top <= y < bottom
  std::int64_t x = 0, slope = 0;     // at the top and a row, in 1/65536 pixels
};

constexpr std::int64_t kOne = 65536;

Edge edge_of(Point a, Point b) {
  if (a.y > b.y) std::swap(a, b);
  return {a.y, b.y, a.x * kOne, (b.x - a.x) * kOne / (b.y - a.y)};
}

void fill_interior(View<std::uint8_t, 2> mask, const std::vector<Edge>& edges) {
  const auto [H, W] = mask.shape();
  std::vector<std::int64_t> crossings;
  for (std::int64_t y = 0; y < H; ++y) {
    crossings.clear();
    for (const Edge& edge : edges)
      if (edge.top <= y && y < edge.bottom)
        crossings.push_back(edge.x + (y - edge.top) * edge.slope);
    std::sort(crossings.begin(), crossings.end());
    for (std::size_t i = 0; i + 1 < crossings.size(); i += 2) {
      // Shifts of negative numbers round down.
      const std::int64_t first = std::max<std::int64_t>((crossings[i] + kOne - 1) >> 16, 0);
      const std::int64_t last = std::min(crossings[i + 1] >> 16, W - 1);
      for (std::int64_t x = first; x <= last; ++x) mask(y, x) = 1;
    }
  }
}

}  // namespace

void fill_polygon(View<std::uint8_t, 2> mask, std::span<const std::array<double, 2>> points) {
  std::vector<Point> corners;
  for (const auto& [x, y] : points) {
    if (!(std::abs(x) <= kMaxPolygonCoordinate) || !(std::abs(y) <= kMaxPolygonCoordinate))
      fail(ErrorKind::kFormat, "polygon: the point (", x, ", ", y, ") is not within ",
           kMaxPolygonCoordinate, " pixels of the picture");
    corners.push_back({static_cast<std::int64_t>(x), static_cast<std::int64_t>(y)});
  }
  if (mask.size() == 0) return;
  std::vector<Edge> edges;
  for (std::size_t i = 0; i < corners.size(); ++i) {
    const Point& a = corners[(i + corners.size() - 1) % corners.size()];
    const Point& b = corners[i];
    draw_line(mask, a, b);
    if (a.y != b.y) edges.push_back(edge_of(a, b));
  }
  fill_interior(mask, edges);
}

}  // namespace lvggt
