// SPDX-License-Identifier: Apache-2.0
// Solid textures: colour as a function of the place in the object.
#include <algorithm>

#include "weights/small_model/scene.h"

namespace small_model {
namespace {

float hash(int x, int y, int z, std::uint32_t seed) {
  std::uint32_t h = static_cast<std::uint32_t>(x) * 0x8DA6B343u ^
                    static_cast<std::uint32_t>(y) * 0xD8163841u ^
                    static_cast<std::uint32_t>(z) * 0xCB1AB31Fu ^ seed * 0x9E3779B9u;
  h = (h ^ (h >> 15)) * 0x2C1B3C6Du;
  h = (h ^ (h >> 12)) * 0x297A2D39u;
  return static_cast<float>((h ^ (h >> 15)) >> 8) * 0x1p-24f;
}

int floor_int(float v) { return static_cast<int>(std::floor(v)); }

float value_noise(Vec3 p, std::uint32_t seed) {
  const int x = floor_int(p.x), y = floor_int(p.y), z = floor_int(p.z);
  const auto ease = [](float f) { return f * f * (3 - 2 * f); };
  const float fx = ease(p.x - static_cast<float>(x)), fy = ease(p.y - static_cast<float>(y)),
              fz = ease(p.z - static_cast<float>(z));
  float plane[2];
  for (int k = 0; k < 2; ++k) {
    const float a = hash(x, y, z + k, seed), b = hash(x + 1, y, z + k, seed);
    const float c = hash(x, y + 1, z + k, seed), d = hash(x + 1, y + 1, z + k, seed);
    const float top = a + (b - a) * fx, bottom = c + (d - c) * fx;
    plane[k] = top + (bottom - top) * fy;
  }
  return plane[0] + (plane[1] - plane[0]) * fz;
}

// Three octaves, about 0..1.
float clouds(Vec3 p, std::uint32_t seed) {
  return (4 * value_noise(p, seed) + 2 * value_noise(p * 2.03f, seed + 1) +
          value_noise(p * 4.1f, seed + 2)) /
         7;
}

// Coordinates on the face of a box that the normal belongs to.
void face_coordinates(Vec3 p, Vec3 n, float& u, float& v) {
  const float ax = std::abs(n.x), ay = std::abs(n.y), az = std::abs(n.z);
  u = ax > az && ax > ay ? p.z : p.x;
  v = ay >= ax && ay >= az ? p.z : p.y;
}

Vec3 bricks(const Material& m, Vec3 p, Vec3 n) {
  float u = 0, v = 0;
  face_coordinates(p, n, u, v);
  v /= m.scale * 0.45f;
  const int row = floor_int(v);
  u = u / m.scale + (row % 2 != 0 ? 0.5f : 0.0f);
  const int column = floor_int(u);
  const float joint = 0.06f;
  const bool in_joint =
      u - static_cast<float>(column) < joint || v - static_cast<float>(row) < 2 * joint;
  if (in_joint) return m.color[1];
  return mix(m.color[0], m.color[2], hash(column, row, 7, m.seed));
}

// Rectangles of several sizes over each other, as posters, books and screens show.
Vec3 collage(const Material& m, Vec3 p, Vec3 n) {
  float u = 0, v = 0;
  face_coordinates(p, n, u, v);
  Vec3 color = m.color[0];
  for (int level = 0; level < 4; ++level) {
    const float size = m.scale / static_cast<float>(1 << level);
    const float shift = hash(level, 3, 5, m.seed);
    const int x = floor_int(u / size + shift), y = floor_int(v / (0.6f * size) + shift);
    if (hash(x, y, level, m.seed) > 0.45f) continue;
    const std::uint32_t s = m.seed + 17;
    const Vec3 own{hash(x, y, 10 + level, s), hash(x, y, 20 + level, s), hash(x, y, 30 + level, s)};
    color = mix(mix(m.color[1], m.color[2], own.x), own, 0.45f);
  }
  return color;
}

Vec3 speckles(const Material& m, Vec3 p) {
  const Vec3 q = p * (1 / m.scale);
  const int x = floor_int(q.x), y = floor_int(q.y), z = floor_int(q.z);
  const Vec3 center{static_cast<float>(x) + 0.3f + 0.4f * hash(x, y, z, m.seed),
                    static_cast<float>(y) + 0.3f + 0.4f * hash(y, z, x, m.seed),
                    static_cast<float>(z) + 0.3f + 0.4f * hash(z, x, y, m.seed)};
  const float radius = 0.15f + 0.3f * hash(x, z, y, m.seed);
  return length(q - center) < radius ? m.color[1] : m.color[0];
}

Vec3 pattern(const Material& m, Vec3 p, Vec3 n) {
  const float along = dot(p, m.axis) / m.scale;
  switch (m.pattern) {
    case Pattern::kPlain:
      return m.color[0];
    case Pattern::kClouds:
      return mix(m.color[0], m.color[1], clouds(p * (1 / m.scale), m.seed));
    case Pattern::kStripes:
      return along - std::floor(along) < 0.5f ? m.color[0] : m.color[1];
    case Pattern::kChecker: {
      const int cell = floor_int(p.x / m.scale + 0.013f) + floor_int(p.y / m.scale + 0.017f) +
                       floor_int(p.z / m.scale + 0.019f);
      return cell % 2 == 0 ? m.color[0] : m.color[1];
    }
    case Pattern::kBricks:
      return bricks(m, p, n);
    case Pattern::kWood: {
      const Vec3 across = p - m.axis * (dot(p, m.axis) * 0.93f);
      const float rings = clouds(across * (1 / m.scale), m.seed) * 5;
      return mix(m.color[0], m.color[1], 0.5f + 0.5f * std::sin(rings * 6.28f));
    }
    case Pattern::kSpeckles:
      return speckles(m, p);
    case Pattern::kCollage:
      return collage(m, p, n);
    case Pattern::kBand: {
      if (std::abs(along) > 0.5f) return m.color[0];
      const bool writing = value_noise(p * (9 / m.scale), m.seed) > 0.68f;
      return writing ? m.color[2] : m.color[1];
    }
  }
  return m.color[0];
}

}  // namespace

Vec3 albedo(const Material& m, Vec3 p, Vec3 n) {
  Vec3 color = pattern(m, p, n);
  if (m.grain > 0)
    color = color * (1 + m.grain * (2 * clouds(p * (1 / m.grain_scale), m.seed + 5) - 1));
  return {std::clamp(color.x, 0.0f, 1.0f), std::clamp(color.y, 0.0f, 1.0f),
          std::clamp(color.z, 0.0f, 1.0f)};
}

}  // namespace small_model
