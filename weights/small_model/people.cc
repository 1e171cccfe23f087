// SPDX-License-Identifier: Apache-2.0
// Hands and people.
#include "weights/small_model/objects.h"

namespace small_model {
namespace {

Rigid moved(Vec3 t) { return {Mat3{}, t}; }

}  // namespace

void Objects::add_fingers(int group, float radius, int skin) {
  const float thick = random_.uniform(0.007f, 0.0095f), away = radius + thick;
  const float side =
      random_.chance(0.85f) ? 1.0f : -1.0f;  // fingers behind what is held, or before
  const auto on_circle = [&](float angle, float y) {
    return Vec3{away * std::cos(angle), y, side * away * std::sin(angle)};
  };
  for (int i = 0; i < 4; ++i) {
    const float y = (static_cast<float>(i) - 1.5f) * 2.1f * thick;
    const float bend = random_.uniform(0.7f, 1.1f);
    add_limb(group, on_circle(0.35f, y), on_circle(0.35f + bend, y), thick, thick, skin);
    add_limb(group, on_circle(0.35f + bend, y), on_circle(0.35f + 2 * bend, y), thick, thick * 0.9f,
             skin);
  }
  const float y = -random_.uniform(0.01f, 0.04f);
  add_limb(group, on_circle(-0.2f, -0.005f), on_circle(-0.9f, y), thick * 1.3f, thick * 1.2f, skin);
  add_limb(group, on_circle(-0.9f, y), on_circle(-1.5f, y - 0.01f), thick * 1.2f, thick, skin);
}

void Objects::add_hand(int group, float radius, float arm_slope_y, float arm_slope_z) {
  const int skin = skin_material();
  add_fingers(group, radius, skin);
  add_solid(group, Shape::kEllipsoid, {0.042f, 0.042f, 0.022f},
            {rotation({0, 1, 0}, random_.uniform(-0.4f, 0.4f)), {radius + 0.036f, 0, 0.004f}},
            skin);
  const Vec3 along = normalized({1, arm_slope_y, arm_slope_z});
  const Vec3 wrist{radius + 0.07f, 0.005f, 0.006f};
  const Vec3 middle = wrist + along * random_.uniform(0.09f, 0.13f),
             elbow = wrist + along * random_.uniform(0.24f, 0.3f);
  // A forearm is up to two thirds wider where its muscles are: else widening would always say that
  // the arm comes nearer.
  const float thin = random_.uniform(0.024f, 0.03f), muscle = random_.uniform(1.25f, 1.65f);
  add_limb(group, wrist, middle, thin, thin * muscle, skin);
  const bool sleeve = random_.chance(0.4f);
  const int upper = sleeve ? cloth_material() : skin;
  const float wide = muscle * (sleeve ? random_.uniform(1.15f, 1.5f) : random_.uniform(1, 1.15f));
  add_limb(group, middle, elbow, thin * muscle * (sleeve ? 1.15f : 1.0f), thin * wide, upper);
  const Vec3 on = normalized(
      {1, arm_slope_y + random_.uniform(-0.5f, 0.5f), arm_slope_z * random_.uniform(0.3f, 2)});
  add_limb(group, elbow, elbow + on * 0.35f, thin * wide, thin * wide * 1.3f, upper);
}

void Objects::add_head(int group, Vec3 center, float unit, int skin) {
  const Vec3 half{0.075f * unit, 0.11f * unit, 0.095f * unit};
  add_solid(group, Shape::kEllipsoid, half, moved(center), skin);
  Material hair;
  hair.color[0] = color(0.01f, 0.3f, 0.5f);
  hair.grain = 0.5f;
  hair.grain_scale = 0.02f;
  const int dark = add(hair);
  if (random_.chance(0.85f))
    add_solid(group, Shape::kEllipsoid, half * random_.uniform(1.05f, 1.2f),
              moved(center + Vec3{0, -0.025f * unit, 0.03f * unit}), dark);
  for (const float side : {-1.0f, 1.0f})
    add_solid(group, Shape::kEllipsoid, Vec3{0.013f, 0.007f, 0.01f} * unit,
              moved(center + Vec3{side * 0.032f * unit, -0.01f * unit, -0.085f * unit}), dark);
  add_solid(group, Shape::kEllipsoid, Vec3{0.013f, 0.02f, 0.02f} * unit,
            moved(center + Vec3{0, 0.02f * unit, -0.09f * unit}), skin);
  add_solid(group, Shape::kEllipsoid, Vec3{0.025f, 0.006f, 0.012f} * unit,
            moved(center + Vec3{0, 0.055f * unit, -0.075f * unit}), dark);
}

void Objects::add_arm(int group, float side, float unit, int cloth, int skin) {
  const Vec3 shoulder{side * 0.19f * unit, -1.38f * unit, 0};
  const float lift = random_.uniform(-0.2f, 1.6f), out = random_.uniform(0, 0.7f);
  const Vec3 upper = normalized({side * out, std::cos(lift), -std::sin(lift)});
  const Vec3 elbow = shoulder + upper * (0.28f * unit);
  const float bend = lift + random_.uniform(0, 1.6f);
  const Vec3 fore =
      normalized({side * random_.uniform(-0.6f, 0.4f), std::cos(bend), -std::sin(bend)});
  const Vec3 wrist = elbow + fore * (0.25f * unit);
  add_limb(group, shoulder, elbow, 0.055f * unit, 0.043f * unit, cloth);
  add_limb(group, elbow, wrist, 0.042f * unit, 0.028f * unit, random_.chance(0.5f) ? cloth : skin);
  add_solid(group, Shape::kEllipsoid, Vec3{0.04f, 0.05f, 0.03f} * unit,
            moved(wrist + fore * (0.05f * unit)), skin);
}

void Objects::add_person(int group, float height, int pose) {
  const float unit = height / 1.72f;
  const int skin = skin_material(), shirt = cloth_material(), trousers = cloth_material();
  add_head(group, {random_.uniform(-0.03f, 0.03f), -1.6f * unit, random_.uniform(-0.05f, 0.02f)},
           unit, skin);
  add_limb(group, {0, -1.5f * unit, 0.01f}, {0, -1.4f * unit, 0.01f}, 0.055f * unit, 0.06f * unit,
           skin);
  // Chest and belly: an ellipsoid of shoulders over a flat frustum.
  add_solid(group, Shape::kEllipsoid, Vec3{0.23f, 0.14f, 0.12f} * unit,
            moved({0, -1.33f * unit, 0}), shirt);
  add_solid(group, Shape::kFrustum, Vec3{0.2f, 0.25f, 0.12f} * unit, moved({0, -1.1f * unit, 0}),
            shirt, random_.uniform(0.75f, 1.1f));
  for (const float side : {-1.0f, 1.0f}) {
    add_arm(group, side, unit, shirt, skin);
    if (pose == 1) continue;
    const float step = random_.uniform(-0.15f, 0.15f);
    const Vec3 hip{side * 0.09f * unit, -0.9f * unit, 0},
        knee{side * 0.1f * unit, -0.48f * unit, step};
    const Vec3 foot{side * 0.11f * unit, -0.06f * unit, 1.6f * step};
    add_limb(group, hip, knee, 0.09f * unit, 0.06f * unit, trousers);
    add_limb(group, knee, foot, 0.058f * unit, 0.042f * unit, trousers);
    add_solid(group, Shape::kBox, Vec3{0.045f, 0.035f, 0.12f} * unit,
              moved(foot + Vec3{0, 0.025f * unit, -0.06f * unit}), any_material());
  }
}

}  // namespace small_model
