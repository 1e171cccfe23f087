// SPDX-License-Identifier: Apache-2.0
#include "weights/small_model/objects.h"

#include <algorithm>

namespace small_model {
namespace {

constexpr float kPi = 3.14159265f;

Rigid moved(Vec3 t) { return {Mat3{}, t}; }

}  // namespace

Vec3 Objects::color(float low_value, float high_value, float saturation) {
  const float value = random_.uniform(low_value, high_value);
  const float hue = random_.uniform(0, 6), s = saturation * random_.uniform();
  Vec3 rgb;
  for (int k = 0; k < 3; ++k) {
    const float d = std::abs(std::fmod(hue + static_cast<float>(2 * k), 6.0f) - 3) - 1;
    rgb[k] = value * (1 - s * (1 - std::clamp(d, 0.0f, 1.0f)));
  }
  return rgb;
}

int Objects::add(const Material& material) {
  scene_.materials.push_back(material);
  scene_.materials.back().seed = static_cast<std::uint32_t>(random_.bits());
  return static_cast<int>(scene_.materials.size()) - 1;
}

int Objects::any_material() {
  Material m;
  m.pattern =
      random_.chance(0.45f) ? Pattern::kPlain : static_cast<Pattern>(random_.below(kNumPatterns));
  const float kind = random_.uniform();  // black, white, wood-like, coloured
  for (Vec3& c : m.color)
    c = kind < 0.15f   ? color(0.01f, 0.06f, 0.5f)
        : kind < 0.3f  ? color(0.5f, 0.9f, 0.2f)
        : kind < 0.45f ? Vec3{0.45f, 0.27f, 0.13f} * random_.uniform(0.2f, 1.2f)
                       : color(0.03f, 0.8f, 1);
  if (random_.chance(0.3f)) m.color[random_.below(3)] = color(0.02f, 0.9f, 1);
  m.scale = random_.log_uniform(0.02f, 0.3f);
  m.axis = random_.chance(0.5f) ? Vec3{0, 1, 0} : random_.direction();
  m.grain = random_.chance(0.5f) ? random_.uniform(0, 0.5f) : 0;
  m.grain_scale = random_.log_uniform(0.01f, 0.3f);
  m.specular = random_.chance(0.4f) ? random_.uniform(0, 0.8f) : 0;
  m.gloss = random_.log_uniform(5, 100);
  m.emissive = random_.chance(0.03f);
  return add(m);
}

int Objects::wall_material() {
  Material m;
  const bool plain = random_.chance(0.6f);
  m.pattern = plain ? (random_.chance(0.5f) ? Pattern::kPlain : Pattern::kClouds)
                    : static_cast<Pattern>(random_.below(kNumPatterns - 1));
  const bool light = random_.chance(0.7f);
  m.color[0] = light ? color(0.4f, 0.9f, 0.25f) : color(0.05f, 0.7f, 0.8f);
  for (int k = 1; k < 3; ++k)
    m.color[k] = mix(m.color[0], color(0.05f, 0.9f, 0.7f),
                     plain ? random_.uniform(0, 0.25f) : random_.uniform(0.1f, 1));
  m.scale = random_.log_uniform(0.05f, 0.9f);
  m.axis = random_.chance(0.7f) ? Vec3{1, 0, 0} : random_.direction();
  m.grain = random_.uniform(0, plain ? 0.15f : 0.4f);
  m.grain_scale = random_.log_uniform(0.03f, 1);
  return add(m);
}

int Objects::floor_material() {
  if (random_.chance(0.3f)) return any_material();
  Material m;
  const Pattern choices[] = {Pattern::kWood,   Pattern::kChecker, Pattern::kPlain,
                             Pattern::kClouds, Pattern::kBricks,  Pattern::kStripes};
  m.pattern = choices[random_.below(6)];
  m.color[0] = random_.chance(0.5f) ? Vec3{0.4f, 0.24f, 0.12f} * random_.uniform(0.3f, 1.6f)
                                    : color(0.1f, 0.8f, 0.4f);
  m.color[1] = m.color[0] * random_.uniform(0.3f, 0.9f);
  m.color[2] = m.color[0] * random_.uniform(0.5f, 1);
  m.scale = random_.log_uniform(0.1f, 0.6f);
  m.axis = random_.chance(0.5f) ? Vec3{1, 0, 0} : Vec3{0, 0, 1};
  m.grain = random_.uniform(0, 0.5f);
  m.grain_scale = random_.log_uniform(0.02f, 0.5f);
  m.specular = random_.chance(0.3f) ? random_.uniform(0, 0.4f) : 0;
  return add(m);
}

int Objects::skin_material() {
  Material m;
  const float dark = random_.uniform();
  m.color[0] = mix({0.72f, 0.45f, 0.33f}, {0.16f, 0.085f, 0.05f}, dark * dark) *
               random_.uniform(0.8f, 1.15f);
  m.grain = random_.uniform(0.05f, 0.25f);
  m.grain_scale = random_.log_uniform(0.01f, 0.06f);
  m.specular = random_.uniform(0, 0.15f);
  m.gloss = 8;
  return add(m);
}

int Objects::cloth_material() {
  Material m;
  const Pattern choices[] = {Pattern::kPlain, Pattern::kPlain, Pattern::kStripes, Pattern::kClouds,
                             Pattern::kChecker};
  m.pattern = choices[random_.below(5)];
  m.color[0] = color(0.02f, 0.8f, 0.9f);
  m.color[1] = random_.chance(0.5f) ? m.color[0] * 0.5f : color(0.02f, 0.8f, 0.9f);
  m.scale = random_.log_uniform(0.02f, 0.12f);
  m.grain = random_.uniform(0.1f, 0.5f);
  m.grain_scale = random_.log_uniform(0.03f, 0.15f);
  return add(m);
}

int Objects::add_group(Label label, const Rigid& world_from_group) {
  Group group;
  group.label = label;
  group.world_from_group = world_from_group;
  group.pivot = world_from_group.t;
  scene_.groups.push_back(group);
  return static_cast<int>(scene_.groups.size()) - 1;
}

int Objects::add_solid(int group, Shape shape, Vec3 half, Rigid group_from_local, int material,
                       float taper) {
  scene_.primitives.push_back({shape, half, taper, group_from_local, group, material});
  return static_cast<int>(scene_.primitives.size()) - 1;
}

void Objects::add_limb(int group, Vec3 from, Vec3 to, float radius_from, float radius_to,
                       int material) {
  const Vec3 along = to - from;
  const float reach = length(along);
  add_solid(group, Shape::kFrustum, {radius_from, 0.5f * reach, radius_from},
            {rotation_of_y(along * (1 / reach)), mix(from, to, 0.5f)}, material,
            radius_to / radius_from);
  add_solid(group, Shape::kEllipsoid, {radius_from, radius_from, radius_from}, moved(from),
            material);
  add_solid(group, Shape::kEllipsoid, {radius_to, radius_to, radius_to}, moved(to), material);
}

float Objects::add_bottle(int group, float size) {
  const float r = size * random_.uniform(0.25f, 0.42f), h = size;  // radius, half height
  const int body = any_material();
  if (random_.chance(0.3f)) {
    Material& m = scene_.materials[static_cast<std::size_t>(body)];
    m.pattern = Pattern::kBand;
    m.axis = {0, 1, 0};
    m.scale = size * random_.uniform(0.5f, 1.3f);
  }
  const int cap = random_.chance(0.4f) ? body : any_material();
  if (random_.chance(0.55f)) {  // a tumbler: wide to the top, with a lid or without
    add_solid(group, Shape::kFrustum, {r, h, r}, Rigid{}, body, random_.uniform(0.75f, 1.02f));
    if (random_.chance(0.7f)) {
      const float lid = h * random_.uniform(0.06f, 0.15f);
      add_solid(group, Shape::kFrustum, {r * 1.06f, lid, r * 1.06f}, moved({0, -h, 0}), cap);
    }
    return r;
  }
  const float shoulder = h * random_.uniform(0.15f, 0.35f),
              neck = r * random_.uniform(0.25f, 0.55f);
  const float neck_h = h * random_.uniform(0.12f, 0.3f);
  const float body_h = h - shoulder * 0.5f - neck_h;
  add_solid(group, Shape::kFrustum, {r, body_h, r}, moved({0, h - body_h, 0}), body);
  const float top = h - 2 * body_h;
  add_solid(group, Shape::kFrustum, {neck, shoulder * 0.5f, neck},
            moved({0, top - shoulder * 0.5f, 0}), body, r / neck);
  add_solid(group, Shape::kFrustum, {neck, neck_h, neck},
            moved({0, top - shoulder - neck_h * 0.5f, 0}), body);
  add_solid(group, Shape::kFrustum, {neck * 1.15f, h * 0.07f, neck * 1.15f},
            moved({0, top - shoulder - neck_h * 1.4f, 0}), cap);
  return r;
}

void Objects::add_small_thing(int group, float size) {
  const int material = any_material();
  const float a = size * random_.uniform(0.3f, 1), b = size * random_.uniform(0.3f, 1),
              c = size * random_.uniform(0.3f, 1);
  switch (random_.below(7)) {
    case 0:
      add_solid(group, Shape::kEllipsoid, {a, b, c}, moved({0, -b, 0}), material);
      return;
    case 1:
      add_solid(group, Shape::kEllipsoid, {a, a, a}, moved({0, -a, 0}), material);
      return;
    case 2: {  // a stack of books
      float y = 0;
      for (int i = random_.below(4); i >= 0; --i) {
        const float h = size * random_.uniform(0.08f, 0.2f);
        add_solid(group, Shape::kBox,
                  {a * random_.uniform(0.8f, 1.1f), h, c * random_.uniform(0.8f, 1.1f)},
                  {rotation({0, 1, 0}, random_.uniform(-0.3f, 0.3f)), {0, y - h, 0}},
                  any_material());
        y -= 2 * h;
      }
      return;
    }
    case 3: {  // a mug
      const float r = 0.5f * a;
      add_solid(group, Shape::kFrustum, {r, 0.6f * b, r}, moved({0, -0.6f * b, 0}), material,
                random_.uniform(0.7f, 1.05f));
      add_limb(group, {r, -0.85f * b, 0}, {1.5f * r, -0.6f * b, 0}, 0.15f * r, 0.15f * r, material);
      add_limb(group, {1.5f * r, -0.6f * b, 0}, {r, -0.3f * b, 0}, 0.15f * r, 0.15f * r, material);
      return;
    }
    case 4: {
      const int before = static_cast<int>(scene_.primitives.size());
      add_bottle(group, size);
      for (std::size_t i = static_cast<std::size_t>(before); i < scene_.primitives.size(); ++i)
        scene_.primitives[i].group_from_local.t.y -= size;
      return;
    }
    case 5:
      add_solid(group, Shape::kFrustum, {a, b, a}, moved({0, -b, 0}), material,
                random_.uniform(0.3f, 1));
      return;
    default:
      add_solid(group, Shape::kBox, {a, b, c}, moved({0, -b, 0}), material);
  }
}

void Objects::add_table(int group, Vec3 half, int material) {
  const float thick = random_.uniform(0.012f, 0.04f), leg = random_.uniform(0.015f, 0.04f);
  add_solid(group, Shape::kBox, {half.x, thick, half.z}, moved({0, -2 * half.y + thick, 0}),
            material);
  const float leg_h = half.y - thick;
  for (const float sx : {-1.0f, 1.0f})
    for (const float sz : {-1.0f, 1.0f})
      add_solid(group, Shape::kBox, {leg, leg_h, leg},
                moved({sx * (half.x - 2 * leg), -leg_h, sz * (half.z - 2 * leg)}), material);
}

void Objects::add_shelf(int group, Vec3 half, int material) {
  const float thick = 0.015f;
  for (const float side : {-1.0f, 1.0f})
    add_solid(group, Shape::kBox, {thick, half.y, half.z}, moved({side * half.x, -half.y, 0}),
              material);
  const int boards = 2 + random_.below(4);
  for (int i = 0; i <= boards; ++i) {
    const float y = -2 * half.y * static_cast<float>(i) / static_cast<float>(boards);
    add_solid(group, Shape::kBox, {half.x, thick, half.z}, moved({0, y, 0}), material);
    if (i == boards) break;
    for (float x = -half.x + 0.05f; x < half.x - 0.1f;) {
      const float w = random_.uniform(0.015f, 0.09f),
                  h = random_.uniform(0.3f, 0.8f) * half.y / static_cast<float>(boards);
      if (random_.chance(0.6f) && scene_.primitives.size() < 110)
        add_solid(group, Shape::kBox, {w, h, half.z * random_.uniform(0.5f, 0.9f)},
                  moved({x + w, y - h - thick, 0}), any_material());
      x += 2.2f * w + random_.uniform(0, 0.1f);
    }
  }
}

void Objects::add_seat(int group, Vec3 half, int material) {
  const bool sofa = half.x > 0.5f;
  const float seat = sofa ? 0.42f : 0.45f, thick = sofa ? 0.12f : 0.03f;
  const float back = random_.uniform(0.35f, 0.55f);
  add_solid(group, Shape::kBox, {half.x, thick, half.z}, moved({0, -seat + thick, 0}), material);
  add_solid(group, Shape::kBox, {half.x, back * 0.5f, sofa ? 0.1f : 0.02f},
            moved({0, -seat - back * 0.5f, half.z - 0.05f}), material);
  if (sofa) {
    add_solid(group, Shape::kBox, {half.x, 0.1f, half.z}, moved({0, -0.1f, 0}), material);
    for (const float side : {-1.0f, 1.0f})
      add_solid(group, Shape::kBox, {0.09f, 0.3f, half.z}, moved({side * half.x, -0.3f, 0}),
                material);
    return;
  }
  for (const float sx : {-1.0f, 1.0f})
    for (const float sz : {-1.0f, 1.0f})
      add_solid(group, Shape::kFrustum, {0.018f, seat * 0.5f, 0.018f},
                moved({sx * (half.x - 0.03f), -seat * 0.5f, sz * (half.z - 0.03f)}), material);
}

void Objects::add_plant(int group, Vec3 half) {
  const float r = 0.35f * half.x + 0.08f, pot = 0.3f * half.y;
  add_solid(group, Shape::kFrustum, {r, pot, r}, moved({0, -pot, 0}), any_material(), 0.75f);
  Material leaves;
  leaves.pattern = Pattern::kClouds;
  leaves.color[0] = {0.03f, 0.12f, 0.02f};
  leaves.color[1] = Vec3{0.15f, 0.4f, 0.08f} * random_.uniform(0.5f, 1.3f);
  leaves.scale = 0.04f;
  const int green = add(leaves);
  for (int i = 4 + random_.below(5); i > 0; --i) {
    const Vec3 tip = {half.x * random_.normal() * 0.5f,
                      -2 * pot - half.y * random_.uniform(0.2f, 1.4f),
                      half.x * random_.normal() * 0.5f};
    add_solid(group, Shape::kEllipsoid,
              {half.x * 0.25f, half.y * random_.uniform(0.1f, 0.3f), half.x * 0.25f},
              {rotation(random_.direction(), random_.uniform(0, kPi)), tip}, green);
  }
}

void Objects::add_furniture(int group, Vec3 half) {
  const int material = any_material();
  switch (random_.below(7)) {
    case 0:
      return add_table(group, {half.x, random_.uniform(0.2f, 0.45f), half.z}, material);
    case 1:
      return add_shelf(group, {half.x, random_.uniform(0.4f, 1.0f), std::min(half.z, 0.2f)},
                       material);
    case 2:
      return add_seat(group, {random_.chance(0.5f) ? 0.24f : std::max(half.x, 0.6f), 1, 0.3f},
                      material);
    case 3:
      return add_plant(group, half);
    case 4:  // a lamp
      add_solid(group, Shape::kFrustum, {0.015f, half.y, 0.015f}, moved({0, -half.y, 0}), material);
      add_solid(group, Shape::kFrustum, {0.1f, 0.13f, 0.1f}, moved({0, -2 * half.y, 0}),
                any_material(), random_.uniform(1, 2));
      return;
    case 5:
      add_solid(group, Shape::kFrustum, {half.x, half.y, half.x}, moved({0, -half.y, 0}), material,
                random_.uniform(0.8f, 1.2f));
      return;
    default:
      add_solid(group, Shape::kBox, half, moved({0, -half.y, 0}), material);
  }
}

}  // namespace small_model
