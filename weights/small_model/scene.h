// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "weights/small_model/vec.h"

// A rendered clip's world: metres, x right, y down, z forward, as OpenCV's camera axes.
namespace small_model {

enum class Pattern {
  kPlain,
  kClouds,
  kStripes,
  kChecker,
  kBricks,
  kWood,
  kSpeckles,
  kCollage,
  kBand
};
inline constexpr int kNumPatterns = 9;

struct Material {
  Pattern pattern = Pattern::kPlain;
  Vec3 color[3];       // linear albedo
  float scale = 0.1f;  // metres of the pattern's period
  float grain = 0;     // amplitude of the cloudy unevenness over everything
  float grain_scale = 0.1f;
  float specular = 0, gloss = 20;
  Vec3 axis{0, 1, 0};  // of stripes, wood and bands
  std::uint32_t seed = 0;
  bool emissive = false;
};

// The albedo at `p`, metres in the object's own frame, where the surface has normal `n`.
Vec3 albedo(const Material& material, Vec3 p, Vec3 n);

// Unit solids, scaled by half extents. The frustum's radius is 1 at y = -1 and `taper` at y = 1.
enum class Shape { kEllipsoid, kBox, kFrustum };

struct Primitive {
  Shape shape = Shape::kBox;
  Vec3 half{1, 1, 1};
  float taper = 1;
  Rigid group_from_local;
  int group = 0;
  int material = 0;
};

enum class Label : std::uint8_t { kRoom, kThing, kHeld, kPerson };

// What moves as one. At time t (seconds): turned around `pivot` by `angle` times a sine, and moved
// by `velocity` * t plus `swing` times another sine.
struct Group {
  Label label = Label::kThing;
  Rigid world_from_group;  // at rest
  Vec3 pivot, velocity, swing, axis{0, 1, 0};
  float angle = 0, rate = 1, phase = 0;

  Rigid at(float t) const {
    const Mat3 turn = rotation(axis, angle * std::sin(rate * 1.3f * t + phase));
    const Vec3 moved = velocity * t + swing * std::sin(rate * t + phase);
    return Rigid{turn, pivot - turn * pivot + moved} * world_from_group;
  }
};

struct Light {
  Vec3 position;
  Vec3 color;
  float radius = 0.1f;  // of its soft shadows
  bool shadows = false;
};

// The camera's path: a linear move and a hand's unsteadiness, in position and in angles.
struct CameraPath {
  Vec3 position;           // at time 0
  Mat3 cam_from_world;     // at time 0
  Vec3 velocity;           // metres a second
  Vec3 turn;               // radians a second around the camera's axes
  Vec3 shake, shake_turn;  // amplitudes
  Vec3 rate{3, 4, 5}, phase;
  float keep_target = 0;  // 0..1: how far the camera turns to keep `target` in place
  Vec3 target{0, 0, 1};

  Rigid at(float t) const;  // camera from world
};

struct Look {  // of the picture, after light has reached the camera
  float brightness = 0.4f, gamma = 2.2f, contrast = 1, vignette = 0;
  float blur = 0;   // sigma in pixels of a picture 84 wide
  float noise = 0;  // sigma, of values 0..1
  Vec3 tint{1, 1, 1};
};

struct Scene {
  Vec3 room_low, room_high;  // corners of the box that everything is in
  int room_materials[6] = {0, 0, 0,
                           0, 0, 0};  // low x, high x, low y (ceiling), high y, low z, high z
  Vec3 ambient;
  std::vector<Material> materials;
  std::vector<Primitive> primitives;
  std::vector<Group> groups;
  std::vector<Light> lights;
  CameraPath camera;
  Look look;
  float fov_w = 1;  // radians
  float seconds_per_frame = 0.2f;
};

// Kinds of scenes: something held before a wall, a table, a room, a person. Everything follows from
// the seed.
Scene make_scene(std::uint64_t seed);

struct Picture {
  int height = 0, width = 0;
  std::vector<float> rgb;            // [H, W, 3], 0..1, every value k / 255
  std::vector<float> depth;          // [H, W], z in the camera, metres
  std::vector<std::uint8_t> object;  // [H, W], 0: the room, else 1 + group
};

// One frame; `noise_seed` makes its sensor noise. `aspect` of the frame: square pixels.
Picture render(const Scene& scene, const Rigid& cam_from_world, float time, int height, int width,
               std::uint64_t noise_seed);

}  // namespace small_model
