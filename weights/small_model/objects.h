// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "weights/small_model/scene.h"

// Puts things made of solids into a scene. A group's own frame stands upright: y down.
namespace small_model {

class Objects {
 public:
  Objects(Scene& scene, Random& random) : scene_(scene), random_(random) {}

  // Materials; each call makes a new one and returns its number.
  int any_material();   // of things
  int wall_material();  // mostly light and plain
  int floor_material();
  int skin_material();
  int cloth_material();
  int add(const Material& material);

  // A new group; the add_* below put solids into it.
  int add_group(Label label, const Rigid& world_from_group);
  int add_solid(int group, Shape shape, Vec3 half, Rigid group_from_local, int material,
                float taper = 1);
  // A limb: a tapered tube with round ends.
  void add_limb(int group, Vec3 from, Vec3 to, float radius_from, float radius_to, int material);

  // Upright things around the group's origin, their lowest point at y = 0 unless said.
  float add_bottle(int group, float size);             // centre at the origin; its radius
  void add_small_thing(int group, float size);         // what stands on tables
  void add_furniture(int group, Vec3 half);            // in a box of these half extents
  void add_person(int group, float height, int pose);  // 0: standing, 1: bust only
  // A hand that holds something of this radius at the origin, its arm towards +x.
  void add_hand(int group, float radius, float arm_slope_y, float arm_slope_z);

  Vec3 color(float low_value, float high_value, float saturation);

 private:
  void add_fingers(int group, float radius, int skin);
  void add_table(int group, Vec3 half, int material);
  void add_shelf(int group, Vec3 half, int material);
  void add_seat(int group, Vec3 half, int material);
  void add_plant(int group, Vec3 half);
  void add_arm(int group, float side, float unit, int cloth, int skin);
  void add_head(int group, Vec3 center, float unit, int skin);

  Scene& scene_;
  Random& random_;
};

}  // namespace small_model
