// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/colmap.h"

#include <doctest/doctest.h>

#include <filesystem>
#include <sstream>
#include <vector>

#include "lvggt/geometry/unproject.h"
#include "lvggt/io/cameras_json.h"
#include "lvggt/io/json.h"
#include "tests/support/files.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;

namespace {

constexpr std::int64_t kHeight = 14, kWidth = 28;

Camera some_camera() {
  const std::array<float, 9> encoding{0.3f, -0.2f, 0.9f, 0.1f, -0.4f, 0.2f, 0.8f, 0.9f, 1.2f};
  return decode_pose_encoding({encoding.data(), Shape{std::int64_t{9}}}, kHeight, kWidth);
}

// The world points of all pixels at some depth, with the pixel in the original picture.
std::vector<ColmapPoint> some_points(const ImageTransform& transform) {
  Context ctx(1);
  Tensor<float, 2> depth(Shape{kHeight, kWidth});
  for (std::int64_t i = 0; i < depth.size(); ++i)
    depth.data()[i] = 2 + 0.01f * static_cast<float>(i % 37);
  Tensor<float, 3> world(Shape{kHeight, kWidth, std::int64_t{3}});
  unproject(world, depth, some_camera(), ctx);
  std::vector<ColmapPoint> points;
  for (std::int64_t v = 0; v < kHeight; ++v) {
    for (std::int64_t u = 0; u < kWidth; ++u) {
      const Eigen::Vector2d pixel =
          pixel_in_original(transform, static_cast<double>(u), static_cast<double>(v));
      points.push_back(
          {{world(v, u, 0), world(v, u, 1), world(v, u, 2)}, {1, 2, 3}, pixel[0], pixel[1]});
    }
  }
  return points;
}

std::vector<std::string> data_lines(const std::string& path) {
  std::istringstream file(test::read_bytes(path));
  std::vector<std::string> lines;
  for (std::string line; std::getline(file, line);)
    if (!line.starts_with('#')) lines.push_back(line);
  return lines;
}

// Reads the model as COLMAP does, world to camera, and returns the largest distance between an
// observation and the projection of its point.
double worst_reprojection(const std::string& folder) {
  std::string skip;
  double width, height, fx, fy, cx, cy;
  std::istringstream(data_lines(folder + "/cameras.txt")[0]) >> skip >> skip >> width >> height >>
      fx >> fy >> cx >> cy;
  const auto images = data_lines(folder + "/images.txt");
  double qw, qx, qy, qz, tx, ty, tz;
  std::istringstream(images[0]) >> skip >> qw >> qx >> qy >> qz >> tx >> ty >> tz;
  const Eigen::Matrix3d R = Eigen::Quaterniond(qw, qx, qy, qz).toRotationMatrix();
  std::vector<Eigen::Vector3d> points(1);  // ids start at 1
  for (const std::string& line : data_lines(folder + "/points3D.txt")) {
    Eigen::Vector3d X;
    std::istringstream(line) >> skip >> X[0] >> X[1] >> X[2];
    points.push_back(X);
  }
  std::istringstream observations(images[1]);
  double x, y, worst = 0;
  std::size_t id;
  while (observations >> x >> y >> id) {
    const Eigen::Vector3d p = R * points.at(id) + Eigen::Vector3d(tx, ty, tz);
    worst = std::max(worst, std::hypot(fx * p[0] / p[2] + cx - x, fy * p[1] / p[2] + cy - y));
  }
  return worst;
}

}  // namespace

TEST_CASE(
    "E03 and E05: points of the model and of the original picture reproject within 1e-3 pixel") {
  const ImageTransform identity{kWidth, kHeight, 0, kWidth, kHeight, 1, 1, 0, 0};
  const ImageTransform crop{56, 40, 0, kWidth, kHeight, 0.5, 0.5, 0, -3};
  // 14 x 28 pictures turned to 28 x 14, enlarged twice before: unequal scales show a swapped axis.
  const ImageTransform turned{30, 60, 1, kWidth, kHeight, 0.5, 0.4, -1, 1};
  for (const ImageTransform& transform : {identity, crop, turned}) {
    const test::TempDir folder;
    ColmapWriter writer(folder.path());
    const auto points = some_points(transform);
    writer.add_image("a.png", in_original_pixels(some_camera(), transform),
                     transform.original_width, transform.original_height, points);
    writer.finish();
    CHECK(worst_reprojection(folder.path()) < 1e-3);
    // The centre of the first pixel of the model is (0.5, 0.5) for COLMAP.
    if (transform == identity)
      CHECK(data_lines(folder / "images.txt")[1].starts_with("0.5 0.5 1 1.5 0.5 2 "));
  }
}

TEST_CASE("in_original_pixels: a ray keeps its direction when the picture was turned") {
  const ImageTransform turned{30, 60, 1, 56, 28, 0.9, 0.8, 1, 2};
  const Camera camera = some_camera();
  const Camera original = in_original_pixels(camera, turned);
  // A world point in front of both.
  const Eigen::Vector3d point =
      camera.cam_from_world.leftCols<3>().cast<double>().transpose() *
      (Eigen::Vector3d(0.2, -0.3, 3) - camera.cam_from_world.col(3).cast<double>());
  const Eigen::Vector3d in_model = project(camera, point);
  const Eigen::Vector3d in_original = project(original, point);
  const Eigen::Vector2d expected = pixel_in_original(turned, in_model[0], in_model[1]);
  CHECK(in_original[0] == doctest::Approx(expected[0]).epsilon(1e-5));
  CHECK(in_original[1] == doctest::Approx(expected[1]).epsilon(1e-5));
  CHECK(in_original[2] == doctest::Approx(in_model[2]));
  CHECK(original.cam_from_world.leftCols<3>().determinant() == doctest::Approx(1));
}

TEST_CASE("ColmapWriter: ids count up over images, empty images keep their second line") {
  const test::TempDir folder;
  ColmapWriter writer(folder.path());
  const ColmapPoint point{{0, 0, 1}, {9, 8, 7}, 2, 3};
  const Camera camera{Eigen::Matrix<float, 3, 4>::Identity(), 10, 10, 2, 3};
  writer.add_image("a.png", camera, 4, 6, {});
  writer.add_image("b.png", camera, 4, 6, std::vector{point, point});
  writer.finish();
  CHECK(data_lines(folder / "cameras.txt") ==
        std::vector<std::string>{"1 PINHOLE 4 6 10 10 2.5 3.5", "2 PINHOLE 4 6 10 10 2.5 3.5"});
  CHECK(data_lines(folder / "images.txt") == std::vector<std::string>{"1 1 0 0 0 0 0 0 1 a.png", "",
                                                                      "2 1 0 0 0 0 0 0 2 b.png",
                                                                      "2.5 3.5 1 2.5 3.5 2"});
  CHECK(data_lines(folder / "points3D.txt") ==
        std::vector<std::string>{"1 0 0 1 9 8 7 0 2 0", "2 0 0 1 9 8 7 0 2 1"});
}

TEST_CASE("ColmapWriter: without finish nothing is left") {
  const test::TempDir folder;
  { ColmapWriter writer(folder.path()); }
  CHECK(std::filesystem::is_empty(folder.path()));
}

TEST_CASE("E08: image names from data cannot leave their folder or break a line") {
  CHECK(colmap_image_name("../../etc/passwd") == "passwd");
  CHECK(colmap_image_name("a\nb\tc.png") == "a_b_c.png");
  CHECK(colmap_image_name("..") == "_");
  CHECK(colmap_image_name("dir/") == "_");
  CHECK(colmap_image_name("frame 12.png") == "frame 12.png");
}

TEST_CASE("CamerasJson: model and original cameras, transform and conventions read back") {
  const test::TempDir folder;
  const ImageTransform crop{56, 40, 0, kWidth, kHeight, 0.5, 0.5, 0, -3};
  CamerasJson writer(folder / "cameras.json", crop);
  writer.add({0, 10, "frame \"10\"", 0.4, some_camera()});
  writer.add({1, 12, "b", 0.48, some_camera()});
  writer.finish();
  const Json json = Json::read(folder / "cameras.json");
  CHECK(json.find("format_version")->as_int64("v") == 1);
  CHECK(json.find("conventions")->find("axes") != nullptr);
  CHECK(json.find("transform")->find("offset")->as_array("offset")[1].as_double("y") == -3);
  const auto& frames = json.find("frames")->as_array("frames");
  REQUIRE(frames.size() == 2);
  CHECK(frames[0].find("name")->as_string("name") == "frame \"10\"");
  CHECK(frames[1].find("timestamp")->as_double("t") == 0.48);
  const Camera camera = some_camera();
  CHECK(static_cast<float>(frames[0].find("model")->find("fx")->as_double("fx")) == camera.fx);
  CHECK(frames[0].find("original")->find("fx")->as_double("fx") == doctest::Approx(2 * camera.fx));
  // Edges: (7 + 0.5 + 3) / 0.5 - 0.5.
  CHECK(frames[0].find("original")->find("cy")->as_double("cy") == doctest::Approx(20.5));
  const auto& row =
      frames[0].find("model")->find("cam_from_world")->as_array("E")[2].as_array("row");
  CHECK(static_cast<float>(row[3].as_double("tz")) == camera.cam_from_world(2, 3));
}
