// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <cstdint>

// The little geometry and chance that the scene generator needs.
namespace small_model {

struct Vec3 {
  float x = 0, y = 0, z = 0;

  friend Vec3 operator+(Vec3 a, Vec3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
  friend Vec3 operator-(Vec3 a, Vec3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
  friend Vec3 operator*(Vec3 a, float s) { return {a.x * s, a.y * s, a.z * s}; }
  friend Vec3 operator*(Vec3 a, Vec3 b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
  float& operator[](int i) { return i == 0 ? x : i == 1 ? y : z; }
  float operator[](int i) const { return i == 0 ? x : i == 1 ? y : z; }
};

inline float dot(Vec3 a, Vec3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(Vec3 a, Vec3 b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
inline float length(Vec3 a) { return std::sqrt(dot(a, a)); }
inline Vec3 normalized(Vec3 a) { return a * (1 / std::fmax(length(a), 1e-12f)); }
inline Vec3 mix(Vec3 a, Vec3 b, float s) { return a + (b - a) * s; }

struct Mat3 {
  Vec3 row[3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};

  friend Vec3 operator*(const Mat3& m, Vec3 v) {
    return {dot(m.row[0], v), dot(m.row[1], v), dot(m.row[2], v)};
  }
  friend Mat3 operator*(const Mat3& a, const Mat3& b) {
    Mat3 product;
    for (Vec3& row : product.row) {
      const Vec3 left = a.row[&row - product.row];
      row = b.row[0] * left.x + b.row[1] * left.y + b.row[2] * left.z;
    }
    return product;
  }
};

inline Mat3 transposed(const Mat3& m) {
  Mat3 t;
  for (int i = 0; i < 3; ++i) t.row[i] = {m.row[0][i], m.row[1][i], m.row[2][i]};
  return t;
}

// Rotation by `angle` radians around the unit vector `axis`.
inline Mat3 rotation(Vec3 axis, float angle) {
  const float c = std::cos(angle), s = std::sin(angle);
  const Vec3 a = axis * (1 - c);
  return {{{c + a.x * axis.x, a.x * axis.y - s * axis.z, a.x * axis.z + s * axis.y},
           {a.x * axis.y + s * axis.z, c + a.y * axis.y, a.y * axis.z - s * axis.x},
           {a.x * axis.z - s * axis.y, a.y * axis.z + s * axis.x, c + a.z * axis.z}}};
}

// The rotation that takes the y axis to the unit vector `to`.
inline Mat3 rotation_of_y(Vec3 to) {
  const Vec3 axis = cross({0, 1, 0}, to);
  const float sine = length(axis);
  if (sine < 1e-6f) return rotation({1, 0, 0}, to.y > 0 ? 0 : 3.14159265f);
  return rotation(axis * (1 / sine), std::atan2(sine, to.y));
}

struct Rigid {
  Mat3 R;
  Vec3 t;

  Vec3 operator()(Vec3 p) const { return R * p + t; }
  friend Rigid operator*(const Rigid& a, const Rigid& b) { return {a.R * b.R, a(b.t)}; }
};

inline Rigid inverse(const Rigid& a) {
  const Mat3 back = transposed(a.R);
  return {back, back * a.t * -1.0f};
}

inline std::uint64_t mix_bits(std::uint64_t z) {
  z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
  z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
  return z ^ (z >> 31);
}

class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(mix_bits(seed + 0x9E3779B97F4A7C15u)) {}

  std::uint64_t bits() { return mix_bits(state_ += 0x9E3779B97F4A7C15u); }
  float uniform() { return static_cast<float>(bits() >> 40) * 0x1p-24f; }  // [0, 1)
  float uniform(float low, float high) { return low + (high - low) * uniform(); }
  float log_uniform(float low, float high) {
    return low * std::exp(std::log(high / low) * uniform());
  }
  float normal() {
    const float r = std::sqrt(-2 * std::log(1 - uniform()));
    return r * std::cos(6.2831853f * uniform());
  }
  int below(int n) { return static_cast<int>(bits() % static_cast<std::uint64_t>(n)); }
  bool chance(float p) { return uniform() < p; }
  float sign() { return chance(0.5f) ? 1.0f : -1.0f; }
  Vec3 direction() { return normalized({normal(), normal(), normal()}); }

 private:
  std::uint64_t state_;
};

}  // namespace small_model
