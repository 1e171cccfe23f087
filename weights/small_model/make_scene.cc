// SPDX-License-Identifier: Apache-2.0
// Four kinds of scenes from one seed: something held up before a wall, a table with things on it,
// a furnished room, a person near the camera.
#include <algorithm>

#include "weights/small_model/objects.h"

namespace small_model {
namespace {

constexpr float kPi = 3.14159265f;

// The camera from the world of one at `eye` that looks at `target`, rolled by `roll`.
Mat3 look_at(Vec3 eye, Vec3 target, float roll) {
  const Vec3 forward = normalized(target - eye);
  const Vec3 right = normalized(cross({0, 1, 0}, forward));
  const Mat3 level{{right, cross(forward, right), forward}};
  return rotation({0, 0, 1}, roll) * level;
}

class Maker {
 public:
  explicit Maker(std::uint64_t seed) : random_(seed), objects_(scene_, random_) {}

  Scene make() {
    scene_.fov_w = random_.uniform(0.8f, 1.3f);
    const float kind = random_.uniform();
    if (kind < 0.36f)
      make_held();
    else if (kind < 0.6f)
      make_table();
    else if (kind < 0.84f)
      make_room();
    else
      make_person();
    add_lights();
    choose_look();
    return std::move(scene_);
  }

 private:
  Rigid upright(Vec3 t, float turn) const { return {rotation({0, 1, 0}, turn), t}; }

  void set_room(Vec3 low, Vec3 high) {
    scene_.room_low = low;
    scene_.room_high = high;
    const int wall = objects_.wall_material();
    for (int face = 0; face < 6; ++face)
      scene_.room_materials[face] = face == 3               ? objects_.floor_material()
                                    : random_.chance(0.75f) ? wall
                                                            : objects_.wall_material();
  }

  // Pictures, windows, doors, sockets: flat boxes on a wall. `face` 0: x low, 1: x high, 5: z high.
  void decorate(int face, int count) {
    const int axis = face / 2, along = axis == 0 ? 2 : 0;
    const int group = objects_.add_group(Label::kThing, Rigid{});
    for (; count > 0; --count) {
      Vec3 center, half;
      const float size = random_.log_uniform(0.04f, 0.6f);
      half[axis] = random_.uniform(0.004f, 0.03f);
      half[along] = size * random_.uniform(0.4f, 1);
      half.y = size * random_.uniform(0.4f, 1);
      center[axis] =
          face % 2 == 0 ? scene_.room_low[axis] + half[axis] : scene_.room_high[axis] - half[axis];
      center[along] = random_.uniform(scene_.room_low[along], scene_.room_high[along]);
      center.y = random_.uniform(scene_.room_low.y + half.y, scene_.room_high.y - half.y);
      if (random_.chance(0.15f)) {  // a door
        half[along] = 0.4f;
        half.y = std::min(1.0f, 0.45f * (scene_.room_high.y - scene_.room_low.y));
        center.y = scene_.room_high.y - half.y;
      }
      const int material =
          random_.chance(0.2f) ? objects_.wall_material() : objects_.any_material();
      Material& m = scene_.materials[static_cast<std::size_t>(material)];
      if (random_.chance(0.5f)) m.pattern = Pattern::kCollage;
      if (random_.chance(0.1f)) m.emissive = true;
      objects_.add_solid(group, Shape::kBox, half, {Mat3{}, center}, material);
    }
  }

  void let_move(int group, float reach, float turn) {
    Group& g = scene_.groups[static_cast<std::size_t>(group)];
    g.swing = random_.direction() * (reach * random_.uniform(0.2f, 1));
    g.axis = random_.chance(0.5f) ? Vec3{0, 0, 1} : random_.direction();
    g.angle = turn * random_.uniform(0.1f, 1);
    g.rate = random_.uniform(0.7f, 4);
    g.phase = random_.uniform(0, 2 * kPi);
  }

  // Something in a hand around `place`, the arm from a side of the picture; `size` of the thing.
  // World axes are nearly the camera's here.
  void hold(Vec3 place, float size, float view_turn) {
    const int group = objects_.add_group(Label::kHeld, Rigid{});
    const std::size_t first = scene_.primitives.size();
    float radius = 0.03f;
    Vec3 shift;
    if (random_.chance(0.65f)) {
      radius = objects_.add_bottle(group, size);
      shift.y = size * random_.uniform(-0.5f, 0.5f);  // where it is gripped
    } else {
      objects_.add_small_thing(group, size);
      shift.y = 0.5f * size;
      radius = 0.5f * size;
    }
    const Rigid in_hand = Rigid{rotation({0, 0, 1}, 0.3f * random_.normal()) *
                                    rotation({1, 0, 0}, 0.25f * random_.normal()) *
                                    rotation({0, 1, 0}, random_.uniform(0, 2 * kPi)),
                                {0, 0, 0}} *
                          Rigid{Mat3{}, shift};
    for (std::size_t i = first; i < scene_.primitives.size(); ++i)
      scene_.primitives[i].group_from_local = in_hand * scene_.primitives[i].group_from_local;
    const std::size_t hand = scene_.primitives.size();
    const bool has_hand = random_.chance(0.9f);
    // From the right as made; mirrored to the left, or from below.
    const float side = random_.chance(0.25f)  ? kPi / 2 + 0.4f * random_.normal()
                       : random_.chance(0.5f) ? 0.25f * random_.normal()
                                              : kPi + 0.25f * random_.normal();
    Mat3 turn = rotation({0, 0, 1}, side);
    const bool from_left = std::abs(side) > 2;
    if (from_left) turn = turn * rotation({1, 0, 0}, kPi);  // keeps the thing's up
    // Somebody who stands beside or behind the thing holds it out, so that it can be seen.
    const float away = random_.uniform(0.3f, 1.2f);
    if (has_hand)
      objects_.add_hand(group, radius, 0.35f * random_.normal(), from_left ? -away : away);
    Group& held = scene_.groups[static_cast<std::size_t>(group)];
    held.world_from_group = {rotation({0, 1, 0}, view_turn) * turn, place};
    held.pivot = place;
    if (random_.chance(0.85f)) let_move(group, 0.12f, 0.6f);
    if (!has_hand) return;
    Group arm = held;  // a group of its own that moves alike
    arm.label = Label::kPerson;
    scene_.groups.push_back(arm);
    for (std::size_t i = hand; i < scene_.primitives.size(); ++i)
      scene_.primitives[i].group = static_cast<int>(scene_.groups.size()) - 1;
  }

  void aim(Vec3 eye, Vec3 target, float distance) {
    CameraPath& path = scene_.camera;
    path.position = eye;
    path.target = target;
    path.cam_from_world =
        look_at(eye, target, (random_.chance(0.85f) ? 0.05f : 0.15f) * random_.normal());
    for (int k = 0; k < 3; ++k) {
      path.rate[k] = random_.uniform(1, 8);
      path.phase[k] = random_.uniform(0, 2 * kPi);
    }
    scene_.seconds_per_frame = random_.log_uniform(0.04f, 0.5f);
    const float kind = random_.uniform();
    if (kind < 0.2f) return;  // on a tripod
    const float shake = random_.log_uniform(0.003f, 0.03f);
    path.shake = random_.direction() * (shake * distance);
    path.shake_turn = random_.direction() * (shake * random_.uniform(0.3f, 1.5f));
    if (kind < 0.35f) return;  // held, but meant to stay
    // So much between two frames, however far apart they are.
    const float frames_per_second = 1 / scene_.seconds_per_frame;
    path.velocity =
        random_.direction() * (distance * random_.log_uniform(0.04f, 0.2f) * frames_per_second);
    path.velocity.y *= 0.5f;
    path.turn = random_.direction() * (random_.log_uniform(0.006f, 0.08f) * frames_per_second);
    path.keep_target = random_.chance(0.5f) ? random_.uniform(0.3f, 1) : 0;
  }

  void make_held() {
    const float wall = random_.log_uniform(0.6f, 2);
    const float floor = random_.uniform(0.7f, 1.6f);
    set_room({-random_.uniform(1, 4), -random_.uniform(0.9f, 1.8f), -random_.uniform(1.5f, 4)},
             {random_.uniform(1, 4), floor, wall});
    if (random_.chance(0.45f)) decorate(5, 1 + random_.below(5));
    const float yaw = (random_.chance(0.75f) ? 0.2f : 0.5f) * random_.normal();
    const float pitch = 0.13f * random_.normal();
    const Vec3 view = normalized({std::sin(yaw), std::sin(pitch), std::cos(yaw)});
    const float reach = std::min(wall * random_.uniform(0.4f, 0.8f), 0.9f);
    const float size = reach * random_.log_uniform(0.12f, 0.32f);  // half height
    if (random_.chance(0.92f)) {
      const Vec3 off{0.25f * reach * random_.normal(), 0.16f * reach * random_.normal(), 0};
      hold(view * reach + off, std::clamp(size, 0.04f, 0.2f), yaw);
    }
    if (random_.chance(0.25f)) {  // the edge of a table below
      const float y = random_.uniform(0.15f, 0.5f);
      const int table = objects_.add_group(Label::kThing, Rigid{});
      objects_.add_solid(table, Shape::kBox, {2, 0.03f, 0.5f},
                         {Mat3{}, {0, y, wall - random_.uniform(-0.2f, 0.5f)}},
                         objects_.floor_material());
      clutter({0, y - 0.03f, wall - 0.2f}, {0.8f, 0, 0.2f}, random_.below(5));
    }
    if (random_.chance(0.12f))
      person_at({random_.normal() * 0.6f, floor, wall * random_.uniform(0.7f, 1)}, 0);
    aim({0, 0, 0}, view * wall, reach);
  }

  void clutter(Vec3 center, Vec3 spread, int count) {
    for (; count > 0; --count) {
      const Vec3 at = center + Vec3{random_.uniform(-1, 1), 0, random_.uniform(-1, 1)} * spread;
      const int group = objects_.add_group(Label::kThing, upright(at, random_.uniform(0, 2 * kPi)));
      objects_.add_small_thing(group, random_.log_uniform(0.03f, 0.16f));
      if (random_.chance(0.08f)) let_move(group, 0.1f, 0.5f);
    }
  }

  void person_at(Vec3 feet, float turn) {
    const int group = objects_.add_group(Label::kPerson, upright(feet, turn));
    objects_.add_person(group, random_.uniform(1.5f, 1.9f), 0);
    if (random_.chance(0.5f)) let_move(group, 0.15f, 0.15f);
  }

  void make_table() {
    const float floor = random_.uniform(0.5f, 1.1f), back = random_.uniform(0.4f, 3);
    set_room({-random_.uniform(1, 4), -random_.uniform(1.2f, 2), -random_.uniform(2, 4)},
             {random_.uniform(1, 4), floor, back});
    if (random_.chance(0.6f)) decorate(5, 1 + random_.below(6));
    const Vec3 half{random_.uniform(0.4f, 1.2f), 0.02f,
                    std::min(random_.uniform(0.3f, 0.8f), back)};
    const int table = objects_.add_group(Label::kThing, Rigid{});
    objects_.add_solid(table, Shape::kBox, half, {Mat3{}, {0, 0.02f, 0}},
                       objects_.floor_material());
    clutter({0, 0, 0}, {half.x * 0.8f, 0, half.z * 0.8f}, 2 + random_.below(11));
    if (random_.chance(0.4f)) furnish(random_.below(4));
    const float away = random_.log_uniform(0.35f, 1.6f), around = 0.6f * random_.normal();
    const float above = away * random_.uniform(0.15f, 1.3f);
    Vec3 eye{away * std::sin(around), -above, -away * std::abs(std::cos(around))};
    eye.y = std::max(eye.y, scene_.room_low.y + 0.1f);
    eye.x = std::clamp(eye.x, scene_.room_low.x + 0.1f, scene_.room_high.x - 0.1f);
    const Vec3 target{0.15f * random_.normal(), random_.uniform(-0.15f, 0.05f),
                      random_.uniform(-0.1f, 0.3f)};
    if (random_.chance(0.2f)) {
      const Vec3 place =
          mix(eye, target, random_.uniform(0.5f, 0.9f)) + Vec3{0.1f * random_.normal(), -0.1f, 0};
      hold(place, random_.uniform(0.04f, 0.12f), -around);
    }
    aim(eye, target, length(eye - target));
  }

  // Furniture on the floor, mostly near the walls.
  void furnish(int count) {
    const Vec3 low = scene_.room_low, high = scene_.room_high;
    for (; count > 0 && scene_.primitives.size() < 120; --count) {
      const Vec3 half{random_.uniform(0.15f, 0.8f), random_.uniform(0.2f, 0.9f),
                      random_.uniform(0.15f, 0.5f)};
      Vec3 at{random_.uniform(low.x + 0.3f, high.x - 0.3f), high.y, random_.uniform(0.5f, high.z)};
      if (random_.chance(0.6f)) {
        const int wall = random_.below(3);
        if (wall == 0)
          at.z = high.z - half.z;
        else
          at.x = wall == 1 ? low.x + half.x : high.x - half.x;
      }
      // Nobody stands in a cupboard to film.
      if (at.z - half.z < 0.8f && std::abs(at.x) - half.x < 0.8f) at.z = 0.8f + 2 * half.z;
      const float turn = random_.chance(0.6f) ? 0.5f * kPi * static_cast<float>(random_.below(4))
                                              : random_.uniform(0, 2 * kPi);
      const int group = objects_.add_group(Label::kThing, upright(at, turn));
      objects_.add_furniture(group, half);
    }
  }

  void make_room() {
    const float width = random_.uniform(2.4f, 6), deep = random_.uniform(2.5f, 6);
    const float high = random_.uniform(2.3f, 3.3f), eye = random_.uniform(0.9f, 1.75f);
    set_room({-width * random_.uniform(0.3f, 0.7f), eye - high, -1.5f}, {0, eye, deep});
    scene_.room_high.x = scene_.room_low.x + width;
    for (const int face : {0, 1, 5})
      if (random_.chance(0.6f)) decorate(face, 1 + random_.below(4));
    furnish(3 + random_.below(8));
    for (int i = random_.chance(0.5f) ? 1 + random_.below(2) : 0; i > 0; --i)
      person_at({random_.uniform(-0.35f, 0.35f) * width, eye, random_.uniform(0.3f, 0.9f) * deep},
                random_.chance(0.6f) ? 0.5f * random_.normal() : random_.uniform(0, 2 * kPi));
    const float yaw = 0.5f * random_.normal(), pitch = 0.08f + 0.18f * random_.normal();
    const Vec3 view = normalized({std::sin(yaw), std::tan(pitch), std::cos(yaw)});
    if (random_.chance(0.08f))
      hold(view * random_.uniform(0.45f, 0.9f) + Vec3{0, 0.05f, 0}, 0.09f, yaw);
    aim({0, 0, 0}, view * (0.6f * deep), 0.6f * deep);
  }

  void make_person() {
    const float wall = random_.log_uniform(1.2f, 5), eye = random_.uniform(1.1f, 1.7f);
    set_room({-random_.uniform(1, 4), eye - random_.uniform(2.3f, 3), -2},
             {random_.uniform(1, 4), eye, wall});
    for (const int face : {0, 1, 5})
      if (random_.chance(0.5f)) decorate(face, 1 + random_.below(4));
    furnish(random_.below(5));
    const float distance = std::min(random_.log_uniform(0.75f, 2.4f), wall - 0.15f);
    person_at({0.15f * distance * random_.normal(), eye, distance}, 0.35f * random_.normal());
    if (random_.chance(0.3f))
      hold({0.2f * random_.normal(), 0.1f, distance * random_.uniform(0.5f, 0.8f)}, 0.09f, 0);
    // At the shoulders or the face: people are filmed with their heads.
    const Vec3 target{0.1f * random_.normal(), eye - 1.45f + 0.12f * random_.normal(), distance};
    aim({0, 0, 0}, target, distance);
  }

  void add_lights() {
    const Vec3 low = scene_.room_low, high = scene_.room_high;
    scene_.ambient = mix({1, 1, 1}, objects_.color(0.6f, 1, 0.3f), random_.uniform()) *
                     random_.log_uniform(0.15f, 0.9f);
    for (int i = 1 + random_.below(3); i > 0; --i) {
      Light light;
      for (int k = 0; k < 3; ++k) {
        const float inset = 0.05f * (high[k] - low[k]);
        light.position[k] = random_.uniform(low[k] + inset, high[k] - inset);
      }
      light.position.y = mix_to(low.y, 0, random_.uniform(0.02f, 0.8f));
      if (light.position.z > 0.6f * high.z) light.position.z *= 0.5f;
      light.color =
          mix({1, 1, 1}, random_.chance(0.5f) ? Vec3{1, 0.75f, 0.5f} : Vec3{0.75f, 0.87f, 1},
              random_.uniform()) *
          random_.log_uniform(0.3f, 2);
      light.radius = random_.log_uniform(0.02f, 0.5f);
      light.shadows = i == 1 || random_.chance(0.4f);
      scene_.lights.push_back(light);
    }
  }

  static float mix_to(float a, float b, float s) { return a + (b - a) * s; }

  void choose_look() {
    Look& look = scene_.look;
    look.brightness = random_.uniform(0.3f, 0.68f);
    look.gamma = random_.uniform(1.7f, 2.4f);
    look.contrast = random_.uniform(0.8f, 1.2f);
    look.vignette = random_.chance(0.5f) ? random_.uniform(0, 0.5f) : 0;
    look.blur = random_.chance(0.6f) ? random_.uniform(0, 0.5f) : 0;
    look.noise = random_.chance(0.7f) ? random_.log_uniform(0.002f, 0.02f) : 0;
    for (int k = 0; k < 3; ++k) look.tint[k] = random_.uniform(0.85f, 1.15f);
  }

  Random random_;
  Scene scene_;
  Objects objects_;
};

}  // namespace

Scene make_scene(std::uint64_t seed) { return Maker(seed).make(); }

}  // namespace small_model
