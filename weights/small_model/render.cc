// SPDX-License-Identifier: Apache-2.0
// Ray casting with soft shadows, four samples a pixel, and what a camera does to light.
#include <array>

#include "weights/small_model/picture_effects.h"
#include "weights/small_model/scene.h"
#include "weights/small_model/solids.h"

namespace small_model {
namespace {

constexpr float kNear = 0.03f;  // metres; nothing nearer is seen
constexpr int kSide = 2;        // samples a pixel along each axis

// A primitive as one frame's rays need it; camera coordinates.
struct Placed {
  const Primitive* primitive = nullptr;
  Rigid cam_from_local;
  Mat3 local_from_cam;  // into the unit solid
  Vec3 origin;          // the camera there
  Vec3 center;
  float radius = 0;
};

// A sphere around the neighbours placed_[first..last] of one group, so that rays may pass them all.
struct Bunch {
  int first = 0, last = 0;
  Vec3 center;
  float radius = 0;
};

// What a sample's ray met.
struct Hit {
  float z = kMiss;
  int solid = -1;  // -1: the room
};

class Frame {
 public:
  Frame(const Scene& scene, const Rigid& cam_from_world, float time, int height, int width)
      : scene_(scene),
        cam_from_world_(cam_from_world),
        world_from_cam_(inverse(cam_from_world)),
        height_(height * kSide),
        width_(width * kSide),
        focal_(0.5f * static_cast<float>(width_) / std::tan(0.5f * scene.fov_w)),
        hits_(static_cast<std::size_t>(height_) * static_cast<std::size_t>(width_)) {
    for (const Primitive& primitive : scene.primitives) place(primitive, time);
    bunch();
    for (std::size_t i = 0; i < placed_.size(); ++i) trace(static_cast<int>(i));
  }

  Picture picture() {
    Picture out;
    out.height = height_ / kSide;
    out.width = width_ / kSide;
    const auto pixels = static_cast<std::size_t>(out.height * out.width);
    out.rgb.resize(3 * pixels);
    out.depth.resize(pixels);
    out.object.resize(pixels);
    for (int y = 0; y < out.height; ++y)
      for (int x = 0; x < out.width; ++x) resolve(out, y, x);
    return out;
  }

 private:
  // Through the middle of a sample; z = 1, so that a ray's parameter is depth.
  Vec3 ray(int y, int x) const {
    return {(static_cast<float>(x) + 0.5f - 0.5f * static_cast<float>(width_)) / focal_,
            (static_cast<float>(y) + 0.5f - 0.5f * static_cast<float>(height_)) / focal_, 1};
  }
  Hit& at(int y, int x) {
    return hits_[static_cast<std::size_t>(y) * static_cast<std::size_t>(width_) +
                 static_cast<std::size_t>(x)];
  }

  void place(const Primitive& primitive, float time) {
    Placed p;
    p.primitive = &primitive;
    const Group& group = scene_.groups[static_cast<std::size_t>(primitive.group)];
    p.cam_from_local = cam_from_world_ * group.at(time) * primitive.group_from_local;
    const Rigid back = inverse(p.cam_from_local);
    for (int k = 0; k < 3; ++k) p.local_from_cam.row[k] = back.R.row[k] * (1 / primitive.half[k]);
    for (int k = 0; k < 3; ++k) p.origin[k] = back.t[k] / primitive.half[k];
    p.center = p.cam_from_local.t;
    p.radius = bounding_radius(primitive);
    placed_.push_back(p);
  }

  void bunch() {
    for (int i = 0, n = static_cast<int>(placed_.size()); i < n;) {
      Bunch b;
      b.first = i;
      const int group = placed(i).primitive->group;
      for (; i < n && placed(i).primitive->group == group; ++i)
        b.center = b.center + placed(i).center;
      b.last = i - 1;
      b.center = b.center * (1 / static_cast<float>(i - b.first));
      for (int k = b.first; k <= b.last; ++k)
        b.radius = std::max(b.radius, length(placed(k).center - b.center) + placed(k).radius);
      bunches_.push_back(b);
    }
  }
  const Placed& placed(int i) const { return placed_[static_cast<std::size_t>(i)]; }

  // First and last sample that the sphere can cover, along one axis.
  void cover(float c, float z, float radius, int size, int& first, int& last) const {
    first = 0;
    last = size - 1;
    if (z - radius <= kNear) return;
    const float low = c - radius, high = c + radius;
    const float a = std::min(low / (z - radius), low / (z + radius));
    const float b = std::max(high / (z - radius), high / (z + radius));
    const float middle = 0.5f * static_cast<float>(size), end = static_cast<float>(size);
    first = static_cast<int>(std::clamp(std::floor(middle + a * focal_), 0.0f, end));
    last = static_cast<int>(std::clamp(std::ceil(middle + b * focal_), -1.0f, end - 1));
  }

  void trace(int number) {
    const Placed& p = placed(number);
    if (p.center.z + p.radius <= kNear) return;
    int top = 0, bottom = 0, left = 0, right = 0;
    cover(p.center.y, p.center.z, p.radius, height_, top, bottom);
    cover(p.center.x, p.center.z, p.radius, width_, left, right);
    for (int y = top; y <= bottom; ++y) {
      for (int x = left; x <= right; ++x) {
        const float z = hit(p.primitive->shape, p.primitive->taper, p.origin,
                            p.local_from_cam * ray(y, x), kNear);
        Hit& best = at(y, x);
        if (z < best.z) best = {z, number};
      }
    }
  }

  // Where the ray leaves the room; `face` as in room_materials.
  float leave_room(Vec3 direction, int& face) const {
    float z = kMiss;
    for (int k = 0; k < 3; ++k) {
      if (std::abs(direction[k]) < 1e-9f) continue;
      const bool high = direction[k] > 0;
      const float wall = high ? scene_.room_high[k] : scene_.room_low[k];
      const float here = (wall - world_from_cam_.t[k]) / direction[k];
      if (here < z) {
        z = here;
        face = 2 * k + (high ? 1 : 0);
      }
    }
    return z;
  }

  bool in_shadow(Vec3 p, Vec3 to_light, int self) const {
    const float squared = dot(to_light, to_light);
    const auto passes = [&](Vec3 center, float radius) {
      const Vec3 c = center - p;
      const Vec3 off = c - to_light * std::clamp(dot(c, to_light) / squared, 0.0f, 1.0f);
      return dot(off, off) > radius * radius;
    };
    for (const Bunch& b : bunches_) {
      if (passes(b.center, b.radius)) continue;
      for (int i = b.first; i <= b.last; ++i) {
        const Placed& s = placed(i);
        if ((i == self && s.primitive->shape != Shape::kBox) || passes(s.center, s.radius))
          continue;
        const Vec3 o = s.origin + s.local_from_cam * p;
        if (hit(s.primitive->shape, s.primitive->taper, o, s.local_from_cam * to_light, 2e-3f) < 1)
          return true;
      }
    }
    return false;
  }

  // Light leaving `p` towards the camera; all in camera coordinates, `n` of unit length.
  Vec3 shade(Vec3 p, Vec3 n, const Material& m, Vec3 color, int solid, Random& random) const {
    if (m.emissive) return color * 1.6f;
    const Vec3 down = {cam_from_world_.R.row[0].y, cam_from_world_.R.row[1].y,
                       cam_from_world_.R.row[2].y};
    const Vec3 eye = normalized(p * -1.0f);
    Vec3 sum = scene_.ambient * (0.8f - 0.2f * dot(n, down)) * color;
    for (const Light& light : scene_.lights) {
      const Vec3 off{random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1)};
      const Vec3 at = cam_from_world_(light.position) + off * light.radius;
      const Vec3 to = at - p;
      const float squared = dot(to, to);
      const Vec3 l = to * (1 / std::sqrt(squared));
      const float facing = dot(n, l);
      if (facing <= 0 || (light.shadows && in_shadow(p, to, solid))) continue;
      const float reach = 1 / (0.4f + 0.25f * squared);
      sum = sum + color * light.color * (facing * reach);
      if (m.specular > 0) {
        const float shine = std::max(0.0f, dot(n, normalized(l + eye)));
        sum = sum + light.color * (m.specular * reach * std::pow(shine, m.gloss));
      }
    }
    return sum;
  }

  // The room's corners are darker.
  float corner_shade(Vec3 world, int face) const {
    float light = 1;
    for (int k = 0; k < 3; ++k) {
      if (k == face / 2) continue;
      const float gap = std::min(world[k] - scene_.room_low[k], scene_.room_high[k] - world[k]);
      light *= 1 - 0.3f * std::exp(-gap * 4);
    }
    return light;
  }

  Vec3 sample(int y, int x, Hit& met) {
    const Vec3 d = ray(y, x);
    int face = 0;
    const Vec3 in_world = world_from_cam_.R * d;
    const float wall = leave_room(in_world, face);
    met = at(y, x);
    Random random(static_cast<std::uint64_t>(y) << 32 | static_cast<std::uint64_t>(x));
    if (met.solid < 0 || wall < met.z) {
      met = {wall, -1};
      const Vec3 world = world_from_cam_.t + in_world * wall;
      Vec3 normal;
      normal[face / 2] = face % 2 == 0 ? 1.0f : -1.0f;
      const Material& m = scene_.materials[static_cast<std::size_t>(scene_.room_materials[face])];
      const Vec3 color = albedo(m, world, normal) * corner_shade(world, face);
      return shade(d * wall, cam_from_world_.R * normal, m, color, -1, random);
    }
    const Placed& p = placed_[static_cast<std::size_t>(met.solid)];
    const Primitive& primitive = *p.primitive;
    const Vec3 unit = p.origin + p.local_from_cam * d * met.z;
    Vec3 n = unit_normal(primitive.shape, primitive.taper, unit);
    for (int k = 0; k < 3; ++k) n[k] /= primitive.half[k];
    n = normalized(n);
    const Material& m = scene_.materials[static_cast<std::size_t>(primitive.material)];
    return shade(d * met.z, p.cam_from_local.R * n, m, albedo(m, unit * primitive.half, n),
                 met.solid, random);
  }

  // A pixel is its samples' mean colour; its depth is theirs if they see one object, else that of
  // the second nearest.
  void resolve(Picture& out, int y, int x) {
    Vec3 color;
    std::array<std::pair<float, int>, kSide * kSide> seen;
    std::size_t n = 0;
    for (int sy = 0; sy < kSide; ++sy) {
      for (int sx = 0; sx < kSide; ++sx) {
        Hit met;
        color = color + sample(y * kSide + sy, x * kSide + sx, met);
        const int group =
            met.solid < 0 ? -1 : placed_[static_cast<std::size_t>(met.solid)].primitive->group;
        seen[n++] = {met.z, group};
      }
    }
    std::sort(seen.begin(), seen.end());
    const auto pixel = static_cast<std::size_t>(y * out.width + x);
    const bool one = seen.front().second == seen.back().second;
    out.depth[pixel] = one ? 0.5f * (seen[1].first + seen[2].first) : seen[1].first;
    out.object[pixel] = static_cast<std::uint8_t>(std::min(seen[1].second + 1, 255));
    for (int c = 0; c < 3; ++c) out.rgb[3 * pixel + static_cast<std::size_t>(c)] = 0.25f * color[c];
  }

  const Scene& scene_;
  Rigid cam_from_world_, world_from_cam_;
  int height_, width_;
  float focal_;
  std::vector<Hit> hits_;
  std::vector<Placed> placed_;
  std::vector<Bunch> bunches_;
};

}  // namespace

Rigid CameraPath::at(float t) const {
  const auto wave = [&](int k, float offset) { return std::sin(rate[k] * t + phase[k] + offset); };
  const auto still = [&](int k, float offset) { return std::sin(phase[k] + offset); };
  Vec3 moved, turned;
  for (int k = 0; k < 3; ++k) {
    moved[k] = velocity[k] * t + shake[k] * (wave(k, 0) - still(k, 0));
    turned[k] = turn[k] * t + shake_turn[k] * (wave(k, 1) - still(k, 1));
  }
  Mat3 R = cam_from_world;
  const Vec3 place = position + moved;
  if (keep_target > 0) {  // turn by a part of the angle between the target's two directions
    const Vec3 before = normalized(R * (target - position));
    const Vec3 now = normalized(R * (target - place));
    const Vec3 axis = cross(now, before);
    const float sine = length(axis);
    if (sine > 1e-6f)
      R = rotation(axis * (1 / sine), keep_target * std::atan2(sine, dot(now, before))) * R;
  }
  const float angle = length(turned);
  if (angle > 0) R = rotation(turned * (1 / angle), angle) * R;
  return {R, R * place * -1.0f};
}

Picture render(const Scene& scene, const Rigid& cam_from_world, float time, int height, int width,
               std::uint64_t noise_seed) {
  Picture picture = Frame(scene, cam_from_world, time, height, width).picture();
  take_picture(picture, scene.look, noise_seed);
  return picture;
}

}  // namespace small_model
