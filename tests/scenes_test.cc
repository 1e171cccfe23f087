// SPDX-License-Identifier: Apache-2.0
// The scene generator of the small model: what it says of depth and cameras has to be true.
#include <doctest/doctest.h>

#include <cmath>
#include <set>

#include "weights/small_model/scene.h"
#include "weights/small_model/solids.h"

using namespace small_model;

namespace {

constexpr int kHeight = 56, kWidth = 84;

// Whether a point lies in the unit solid.
bool inside(Shape shape, float taper, Vec3 p) {
  if (shape == Shape::kEllipsoid) return dot(p, p) <= 1;
  if (shape == Shape::kBox) return std::abs(p.x) <= 1 && std::abs(p.y) <= 1 && std::abs(p.z) <= 1;
  const float radius = 1 + 0.5f * (taper - 1) * (p.y + 1);
  return std::abs(p.y) <= 1 && p.x * p.x + p.z * p.z <= radius * radius;
}

float focal(const Scene& scene) {
  return 0.5f * static_cast<float>(kWidth) / std::tan(0.5f * scene.fov_w);
}

// Of the pixels of `from` that `to` should see too, the part whose depth it agrees with.
double agreement(const Scene& scene, const Rigid& from_pose, const Picture& from,
                 const Rigid& to_pose, const Picture& to) {
  const Rigid to_from = to_pose * inverse(from_pose);
  const float f = focal(scene);
  int seen = 0, agreed = 0;
  for (int y = 0; y < kHeight; ++y) {
    for (int x = 0; x < kWidth; ++x) {
      const float z = from.depth[static_cast<std::size_t>(y * kWidth + x)];
      const Vec3 ray{(static_cast<float>(x) + 0.5f - 0.5f * kWidth) / f,
                     (static_cast<float>(y) + 0.5f - 0.5f * kHeight) / f, 1};
      const Vec3 p = to_from(ray * z);
      const int u = static_cast<int>(std::floor(p.x / p.z * f + 0.5f * kWidth));
      const int v = static_cast<int>(std::floor(p.y / p.z * f + 0.5f * kHeight));
      if (p.z <= 0 || u < 0 || v < 0 || u >= kWidth || v >= kHeight) continue;
      ++seen;
      const float there = to.depth[static_cast<std::size_t>(v * kWidth + u)];
      agreed += std::abs(there / p.z - 1) < 0.04f ? 1 : 0;
    }
  }
  return static_cast<double>(agreed) / std::max(seen, 1);
}

}  // namespace

TEST_CASE("scenes: a ray meets each solid where it enters it, and nowhere before") {
  Random random(1);
  for (const Shape shape : {Shape::kEllipsoid, Shape::kBox, Shape::kFrustum}) {
    int hits = 0;
    for (int i = 0; i < 400; ++i) {
      const float taper = random.uniform(0.3f, 2);
      const Vec3 o = random.direction() * random.uniform(3, 6);
      const Vec3 d = (random.direction() * random.uniform(0, 1.2f) - o) * random.uniform(0.2f, 1);
      const float t = hit(shape, taper, o, d, 0.01f);
      const float end = t < kMiss ? t : 20.0f;
      for (int k = 0; k < 200; ++k)
        CHECK_FALSE(inside(shape, taper, o + d * (end * static_cast<float>(k) / 201)));
      if (t == kMiss) continue;
      ++hits;
      const Vec3 p = o + d * t, n = normalized(unit_normal(shape, taper, p));
      CHECK(inside(shape, taper, p - n * 2e-3f));
      CHECK_FALSE(inside(shape, taper, p + n * 2e-3f));
    }
    CHECK(hits > 100);
  }
}

TEST_CASE("scenes: depth and cameras of two views of one moment agree") {
  double sum = 0;
  constexpr int kScenes = 12;
  for (int i = 0; i < kScenes; ++i) {
    const Scene scene = make_scene(static_cast<std::uint64_t>(100 + i));
    const Rigid from = scene.camera.at(0);
    // Beside the scene's own camera and turned a little.
    const Rigid to = Rigid{rotation({0, 1, 0}, 0.05f), {0.02f, -0.01f, 0.01f}} * from;
    const Picture a = render(scene, from, 0, kHeight, kWidth, 1);
    const Picture b = render(scene, to, 0, kHeight, kWidth, 2);
    const double part = agreement(scene, from, a, to, b);
    CAPTURE(i);
    CHECK(part > 0.75);  // the rest is hidden there, or lies at an edge
    sum += part;
  }
  CHECK(sum / kScenes > 0.9);
}

TEST_CASE("scenes: everything follows from the seed, and every value is one of 8 bits") {
  const Scene scene = make_scene(5), again = make_scene(5), other = make_scene(6);
  const Picture a = render(scene, scene.camera.at(0.3f), 0.3f, kHeight, kWidth, 9);
  const Picture b = render(again, again.camera.at(0.3f), 0.3f, kHeight, kWidth, 9);
  const Picture c = render(other, other.camera.at(0.3f), 0.3f, kHeight, kWidth, 9);
  CHECK(a.rgb == b.rgb);
  CHECK(a.depth == b.depth);
  CHECK(a.object == b.object);
  CHECK(a.depth != c.depth);
  for (const float value : a.rgb) CHECK(std::abs(value * 255 - std::round(value * 255)) < 1e-3f);
  for (const float z : a.depth) CHECK((z > 0 && std::isfinite(z)));
}

TEST_CASE("scenes: people, held things and cameras that stay and that move all occur") {
  std::set<Label> labels;
  int still = 0, moving = 0;
  for (std::uint64_t seed = 0; seed < 60; ++seed) {
    const Scene scene = make_scene(seed);
    for (const Group& group : scene.groups) labels.insert(group.label);
    const Vec3 moved = inverse(scene.camera.at(0.5f)).t - inverse(scene.camera.at(0)).t;
    (length(moved) < 1e-6f ? still : moving) += 1;
  }
  CHECK(labels.size() == 3);  // the room is not a group
  CHECK(still > 5);
  CHECK(moving > 30);
}
