// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/lifted_field.h"

#include <doctest/doctest.h>

#include <filesystem>

#include "lvggt/field/frame_files.h"
#include "lvggt/io/image.h"
#include "lvggt/io/read_depth_png.h"
#include "tests/support/files.h"
#include "tests/support/temp_dir.h"
#include "tests/support/tiny_field.h"

using namespace lvggt;
using test::TinyField;
namespace fs = std::filesystem;

namespace {

// The message of the Error that body() throws; empty if it throws none.
template <class F>
std::string error_of(F&& body, ErrorKind kind) {
  try {
    body();
  } catch (const Error& error) {
    CHECK(error.kind() == kind);
    return error.what();
  }
  return {};
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

struct Written {
  test::TempDir dir;
  std::string folder = dir / "field";
  explicit Written(void (*change)(TinyField&) = nullptr) {
    TinyField field(folder);
    if (change != nullptr) change(field);
    field.write();
  }
  std::string operator/(const std::string& name) const { return folder + "/" + name; }
};

}  // namespace

TEST_CASE("LiftedField: reads back what RunWriter wrote") {
  const Written written;
  const LiftedField field = LiftedField::open(written.folder);
  REQUIRE(field.num_frames() == 6);
  CHECK(field.height() == TinyField::kHeight);
  CHECK(field.width() == TinyField::kWidth);
  CHECK(field.has_points());
  CHECK(field.codes(CodesKind::kLanguage).levels ==
        std::vector<std::string>{"small", "middle", "large"});
  CHECK(field.codes(CodesKind::kLanguage).decoder_sha256 == "cup");
  CHECK(field.codes(CodesKind::kState).dim == 2);
  const CameraRecord& frame = field.frames()[4];
  CHECK(frame.index == 4);
  CHECK(frame.source_index == 8);
  CHECK(frame.name == "frame 8");
  CHECK(frame.timestamp == 2.0);
  CHECK(frame.camera.fx == 30);
  CHECK(frame.camera.cam_from_world(0, 3) == 0.4F);

  Tensor<float, 2> depth(Shape{field.height(), field.width()});
  field.read_depth(depth, 4);
  CHECK(depth(3, 5) == doctest::Approx(TinyField::depth_at(3, 5)).epsilon(1e-4));
  field.read_confidence(depth, 0);
  CHECK(depth(3, 5) == doctest::Approx(TinyField::confidence_at(5)).epsilon(1e-4));
  const Tensor<std::uint8_t, 3> picture = field.read_picture(2);
  CHECK(picture(7, 9, 1) == 34);
  Tensor<float, 4> codes(field.codes(CodesKind::kState).shape());
  field.read_codes(codes, CodesKind::kState, 2);
  CHECK(codes(0, 0, 0, TinyField::kUpright) == 1);
  field.read_codes(codes, CodesKind::kState, 3);
  CHECK(codes(0, 0, 0, TinyField::kUpright) == 0);
}

TEST_CASE("LiftedField: with every n-th frame written, those are its frames") {
  const Written written([](TinyField& field) { field.outputs.every = 2; });
  const LiftedField field = LiftedField::open(written.folder);
  REQUIRE(field.num_frames() == 3);
  CHECK(field.frames()[2].index == 4);
  Tensor<float, 4> codes(field.codes(CodesKind::kLanguage).shape());
  field.read_codes(codes, CodesKind::kLanguage, 2);
  CHECK(codes(2, 0, 0, TinyField::kCup) == 1);
}

TEST_CASE("LiftedField: what was not written is said, with the option that writes it") {
  const Written written([](TinyField& field) {
    field.language = field.states = false;
    field.outputs.frames = field.outputs.depth = false;
  });
  const LiftedField field = LiftedField::open(written.folder);
  CHECK_FALSE(field.has_codes(CodesKind::kLanguage));
  CHECK_FALSE(field.has_points());
  const std::string text =
      error_of([&] { field.codes(CodesKind::kLanguage); }, ErrorKind::kMismatch);
  CHECK(contains(text, written.folder));
  CHECK(contains(text, "without semantics"));
  CHECK(contains(text, "--decoder"));
  CHECK(contains(error_of([&] { field.codes(CodesKind::kState); }, ErrorKind::kMismatch),
                 "--state-decoder"));
  CHECK(contains(error_of([&] { field.read_picture(0); }, ErrorKind::kMismatch), "--no-frames"));
  Tensor<float, 2> depth(Shape{field.height(), field.width()});
  CHECK(
      contains(error_of([&] { field.read_depth(depth, 0); }, ErrorKind::kMismatch), "--no-depth"));
}

TEST_CASE("LiftedField: a folder that is none is refused with the reason") {
  const test::TempDir dir;
  const auto open = [&] { LiftedField::open(dir / "x"); };
  CHECK(contains(error_of(open, ErrorKind::kRead), "no such folder"));
  fs::create_directory(dir / "x");
  CHECK(contains(error_of(open, ErrorKind::kFormat), "not a folder that lift_video wrote"));
  test::write_bytes(dir / "x/run.json", R"({"tool": "make_tokens", "status": "complete"})");
  CHECK(contains(error_of(open, ErrorKind::kFormat), "written by make_tokens"));
  test::write_bytes(dir / "x/run.json", R"({"tool": "lift_video", "status": "failed"})");
  CHECK(contains(error_of(open, ErrorKind::kFormat), "the run is \"failed\""));
  test::write_bytes(dir / "x/field.json", R"({"format_version": 2})");
  CHECK(contains(error_of(open, ErrorKind::kUnsupported), "another version"));
  test::write_bytes(dir / "x/field.json", R"({"format_version": 1, "kind": "lifted field"})");
  CHECK(contains(error_of(open, ErrorKind::kFormat), "has no \"frames\""));
}

TEST_CASE("LiftedField: a frame's codes that are missing, cut short or another's are named") {
  const Written written;
  const std::string name = written / "codes/000003.safetensors";
  const std::string bytes = test::read_bytes(name);
  const LiftedField field = LiftedField::open(written.folder);
  Tensor<float, 4> codes(field.codes(CodesKind::kLanguage).shape());
  const auto read = [&] { field.read_codes(codes, CodesKind::kLanguage, 3); };

  test::write_bytes(name, bytes.substr(0, bytes.size() / 2));
  CHECK(contains(error_of(read, ErrorKind::kFormat), "000003.safetensors"));
  test::write_bytes(name, "");
  CHECK(contains(error_of(read, ErrorKind::kFormat), "000003.safetensors"));
  test::write_bytes(name, test::read_bytes(written / "codes/000002.safetensors"));
  CHECK(contains(error_of(read, ErrorKind::kMismatch), "its frame is \"2\""));
  test::write_bytes(name, test::read_bytes(written / "state_codes/000003.safetensors"));
  CHECK(contains(error_of(read, ErrorKind::kMismatch), "its "));
  fs::remove(name);
  CHECK(contains(error_of(read, ErrorKind::kRead), "000003.safetensors"));
  CHECK(contains(error_of([&] { LiftedField::open(written.folder); }, ErrorKind::kRead),
                 "frame 3 has codes"));
}

TEST_CASE("LiftedField: cameras of another number of frames, and damaged ones, are refused") {
  const Written written;
  const std::string name = written / "cameras.json";
  const std::string text = test::read_bytes(name);
  const auto open = [&] { LiftedField::open(written.folder); };
  const std::size_t last = text.rfind("    {\n      \"index\"");
  REQUIRE(last != std::string::npos);
  test::write_bytes(name, text.substr(0, text.rfind(',', last)) + "]}");
  CHECK(contains(error_of(open, ErrorKind::kMismatch), "has 5 frames"));
  test::write_bytes(name, text.substr(0, text.size() / 2));
  CHECK(contains(error_of(open, ErrorKind::kFormat), "cameras.json"));
  fs::remove(name);
  CHECK(contains(error_of(open, ErrorKind::kRead), "cameras.json"));
}

TEST_CASE("write_codes: what half precision cannot hold is an error and leaves no file") {
  const test::TempDir dir;
  const CodesFormat format{{"small"}, 2, 2, 1, "x"};
  Tensor<float, 4> codes(format.shape());
  codes.data()[3] = 70000;
  CHECK(contains(error_of([&] { write_codes(dir / "c", codes, format, 0); }, ErrorKind::kNumeric),
                 "70000"));
  CHECK_FALSE(fs::exists(dir / "c"));
  codes.data()[3] = 0.1F;
  write_codes(dir / "c", codes, format, 7);
  Tensor<float, 4> read(format.shape());
  read_codes(read, dir / "c", format, 7);
  CHECK(read.data()[3] == doctest::Approx(0.1).epsilon(5e-4));
}

TEST_CASE("load_grey16: other pictures are refused") {
  const test::TempDir dir;
  write_png(dir / "rgb.png", Tensor<std::uint8_t, 3>(Shape{4, 4, 3}));
  CHECK(contains(error_of([&] { load_grey16(dir / "rgb.png"); }, ErrorKind::kFormat),
                 "16 bits a pixel"));
  Tensor<std::uint16_t, 2> values(Shape{2, 3});
  values(1, 2) = 40000;
  write_png(dir / "grey.png", values);
  const Tensor<std::uint16_t, 2> read = load_grey16(dir / "grey.png");
  CHECK(read.shape() == values.shape());
  CHECK(read(1, 2) == 40000);
}
