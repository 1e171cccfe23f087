// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <limits>

#include "weights/small_model/scene.h"

// Rays against unit solids.
namespace small_model {

inline constexpr float kMiss = std::numeric_limits<float>::infinity();

inline float hit_ellipsoid(Vec3 o, Vec3 d, float nearest) {
  const float a = dot(d, d), b = dot(o, d), c = dot(o, o) - 1;
  const float root = b * b - a * c;
  if (root < 0) return kMiss;
  const float t = (-b - std::sqrt(root)) / a;
  return t > nearest ? t : kMiss;
}

inline float hit_box(Vec3 o, Vec3 d, float nearest) {
  float enter = -kMiss, leave = kMiss;
  for (int k = 0; k < 3; ++k) {
    const float inverse = 1 / (std::abs(d[k]) < 1e-12f ? 1e-12f : d[k]);
    const float a = (-1 - o[k]) * inverse, b = (1 - o[k]) * inverse;
    enter = std::max(enter, std::min(a, b));
    leave = std::min(leave, std::max(a, b));
  }
  return enter <= leave && enter > nearest ? enter : kMiss;
}

inline float hit_frustum(Vec3 o, Vec3 d, float taper, float nearest) {
  const float mid = 0.5f * (1 + taper), slope = 0.5f * (taper - 1);
  float best = kMiss;
  const auto offer = [&](float t) {
    if (t > nearest && t < best) best = t;
  };
  const float r0 = mid + slope * o.y, rd = slope * d.y;
  const float a = d.x * d.x + d.z * d.z - rd * rd, b = o.x * d.x + o.z * d.z - r0 * rd;
  const float c = o.x * o.x + o.z * o.z - r0 * r0;
  const float root = b * b - a * c;
  if (root >= 0 && std::abs(a) > 1e-12f) {
    const float s = std::sqrt(root);
    for (const float t : {(-b - s) / a, (-b + s) / a})
      if (std::abs(o.y + t * d.y) <= 1 && r0 + t * rd > 0) offer(t);
  }
  if (std::abs(d.y) > 1e-12f) {
    for (const float side : {-1.0f, 1.0f}) {
      const float t = (side - o.y) / d.y, radius = mid + slope * side;
      const float x = o.x + t * d.x, z = o.z + t * d.z;
      if (x * x + z * z <= radius * radius) offer(t);
    }
  }
  return best;
}

// The first t > nearest at which o + t * d enters the solid, or kMiss.
inline float hit(Shape shape, float taper, Vec3 o, Vec3 d, float nearest) {
  if (shape == Shape::kEllipsoid) return hit_ellipsoid(o, d, nearest);
  if (shape == Shape::kBox) return hit_box(o, d, nearest);
  return hit_frustum(o, d, taper, nearest);
}

// The outward normal at `p` on the unit solid, of any length.
inline Vec3 unit_normal(Shape shape, float taper, Vec3 p) {
  if (shape == Shape::kEllipsoid) return p;
  if (shape == Shape::kBox) {
    const float x = std::abs(p.x), y = std::abs(p.y), z = std::abs(p.z);
    if (x >= y && x >= z) return {p.x, 0, 0};
    return y >= z ? Vec3{0, p.y, 0} : Vec3{0, 0, p.z};
  }
  const float slope = 0.5f * (taper - 1), radius = 0.5f * (1 + taper) + slope * p.y;
  const float inside = radius * radius - (p.x * p.x + p.z * p.z);
  if (std::abs(p.y) > 0.9999f && inside > -1e-3f) return {0, p.y, 0};
  return {p.x, -slope * radius, p.z};
}

// Radius of the sphere around the origin that holds the scaled solid.
inline float bounding_radius(const Primitive& solid) {
  const Vec3 h = solid.half;
  if (solid.shape == Shape::kEllipsoid) return std::max({h.x, h.y, h.z});
  if (solid.shape == Shape::kBox) return length(h);
  const float across = std::max(h.x, h.z) * std::max(1.0f, solid.taper);
  return std::sqrt(across * across + h.y * h.y);
}

}  // namespace small_model
