// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/frame_source.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <filesystem>

#include "tests/support/picture_bytes.h"
#include "tests/support/temp_dir.h"

namespace lvggt {
namespace {

using test::golden;
using test::read_file;
using test::TempDir;
using test::write_file;

template <class Action>
std::string error_of(Action&& action, ErrorKind kind) {
  try {
    action();
  } catch (const Error& error) {
    CHECK(error.kind() == kind);
    return error.what();
  }
  FAIL("no error");
  return {};
}

std::vector<std::string> names_of(FrameSource& source) {
  std::vector<std::string> names;
  while (const auto frame = source.next()) names.push_back(frame->name);
  return names;
}

// A folder with `count` pictures, frame1.png and so on.
void fill(const TempDir& folder, int count) {
  const std::string picture = read_file(golden("image/rgb.png"));
  for (int i = 1; i <= count; ++i) write_file(folder / concat("frame", i, ".png"), picture);
}

}  // namespace

TEST_CASE("natural_less: numbers in names are ordered by value") {
  std::vector<std::string> names{"b1",
                                 "a10.png",
                                 "a2.png",
                                 "a02.png",
                                 "a1.png",
                                 "a",
                                 "a1b2",
                                 "a1b10",
                                 "a99999999999999999999999.png",
                                 "a100000000000000000000000.png"};
  std::sort(names.begin(), names.end(), natural_less);
  const std::vector<std::string> expected{"a",
                                          "a1.png",
                                          "a1b2",
                                          "a1b10",
                                          "a02.png",
                                          "a2.png",
                                          "a10.png",
                                          "a99999999999999999999999.png",
                                          "a100000000000000000000000.png",
                                          "b1"};
  CHECK(names == expected);
  CHECK_FALSE(natural_less("a1", "a1"));
}

TEST_CASE("open_images: a folder gives its pictures in natural order with rising times") {
  const TempDir folder;
  fill(folder, 11);
  const auto source = open_images(folder.path());
  CHECK(source->expected_frames() == 11);
  double last_time = -1;
  for (int i = 0; i < 11; ++i) {
    const auto frame = source->next();
    REQUIRE(frame);
    CHECK(frame->name == concat("frame", i + 1, ".png"));
    CHECK(frame->source_index == i);
    CHECK(frame->timestamp > last_time);
    CHECK(frame->image.width() == 8);
    last_time = frame->timestamp;
  }
  CHECK_FALSE(source->next());
  CHECK_FALSE(source->next());
  CHECK(source->warnings().empty());
}

TEST_CASE("open_images: start, stride and max_frames select frames") {
  const TempDir folder;
  fill(folder, 11);
  const auto every_third = open_images(folder.path(), {.start = 1, .stride = 3});
  CHECK(every_third->expected_frames() == 4);
  CHECK(names_of(*every_third) ==
        std::vector<std::string>{"frame2.png", "frame5.png", "frame8.png", "frame11.png"});
  const auto two = open_images(folder.path(), {.start = 9, .stride = 1, .max_frames = 5});
  CHECK(two->expected_frames() == 2);
  CHECK(names_of(*two) == std::vector<std::string>{"frame10.png", "frame11.png"});
  const auto one = open_images(folder.path(), {.max_frames = 1});
  CHECK(names_of(*one) == std::vector<std::string>{"frame1.png"});
}

TEST_CASE("D01: selections that make no sense are usage errors that name the option") {
  const TempDir folder;
  fill(folder, 2);
  const auto refuse = [&](const FrameSourceOptions& options, const std::string& message) {
    CHECK(error_of([&] { open_frames(folder.path(), options); }, ErrorKind::kUsage) == message);
  };
  refuse({.start = -1}, "start: -1 is negative");
  refuse({.stride = 0}, "stride: 0 is not at least 1");
  refuse({.max_frames = 0}, "max frames: 0 is not at least 1");
  refuse({.images_per_second = 0}, "images per second: 0 is not a positive number");
  refuse({.start = 2}, "start: 2 is beyond the last of 2 images, counted from 0");
}

TEST_CASE("B27: hidden files, folders and other files are skipped and counted, any case is read") {
  const TempDir folder;
  fill(folder, 1);
  write_file(folder / "frame2.PNG", read_file(golden("image/rgb.png")));
  write_file(folder / ".DS_Store", "x");
  write_file(folder / ".hidden.png", "x");
  write_file(folder / "notes.txt", "x");
  std::filesystem::create_directory(folder / "folder.png");
  const auto source = open_images(folder.path() + "/");
  CHECK(names_of(*source) == std::vector<std::string>{"frame1.png", "frame2.PNG"});
  CHECK(source->report().skipped_files == 4);
  REQUIRE(source->warnings().size() == 1);
  CHECK(source->warnings()[0] ==
        folder.path() + "/: 4 entries are not a PNG or JPEG file and skipped, such as '.DS_Store'");
}

TEST_CASE("C01: an empty picture in a folder is an error that names it") {
  const TempDir folder;
  fill(folder, 1);
  write_file(folder / "frame2.png", "");
  const auto source = open_images(folder.path());
  CHECK(source->next());
  CHECK(error_of([&] { source->next(); }, ErrorKind::kFormat) ==
        folder / "frame2.png" + ": is empty, expected a PNG or JPEG image");
}

TEST_CASE("C17: another size inside a sequence names both files and sizes") {
  const TempDir folder;
  fill(folder, 2);
  write_file(folder / "frame3.png", read_file(golden("image/rgba.png")));
  const auto source = open_images(folder.path());
  CHECK(source->next());
  CHECK(source->next());
  CHECK(error_of([&] { source->next(); }, ErrorKind::kMismatch) ==
        folder / "frame3.png" + ": has 16x12 pixels but " + folder / "frame1.png" +
            " has 8x6; all frames must have one size");
}

TEST_CASE("C17: sizes are compared after the EXIF orientation") {
  const TempDir folder;
  const std::string jpeg = read_file(golden("image/rgb.jpg"));
  write_file(folder / "1.jpg", jpeg);
  write_file(folder / "2.jpg", test::with_jpeg_segment(jpeg, 0xe1, test::exif_with_orientation(3)));
  write_file(folder / "3.jpg", test::with_jpeg_segment(jpeg, 0xe1, test::exif_with_orientation(6)));
  const auto source = open_images(folder.path());
  CHECK(source->next());
  CHECK(source->next());
  CHECK(error_of([&] { source->next(); }, ErrorKind::kMismatch).find("has 48x32 pixels") !=
        std::string::npos);
}

TEST_CASE("C18: the same picture 500 times is 500 frames") {
  const TempDir folder;
  fill(folder, 1);
  for (int i = 2; i <= 500; ++i)
    std::filesystem::create_hard_link(folder / "frame1.png", folder / concat("frame", i, ".png"));
  const auto source = open_images(folder.path());
  CHECK(names_of(*source).size() == 500);
}

TEST_CASE("open_frames: a single picture is a sequence of one") {
  const auto source = open_frames(golden("image/rgb.jpg"));
  CHECK(source->expected_frames() == 1);
  CHECK(names_of(*source).size() == 1);
}

TEST_CASE("open_frames: folders without pictures and missing paths are errors") {
  const TempDir folder;
  CHECK(
      error_of([&] { open_frames(folder.path()); }, ErrorKind::kUnsupported).find("and is empty") !=
      std::string::npos);
  write_file(folder / "a.heic", "x");
  CHECK(error_of([&] { open_frames(folder.path()); }, ErrorKind::kUnsupported)
            .find("such as 'a.heic'") != std::string::npos);
  error_of([&] { open_frames(folder / "none"); }, ErrorKind::kRead);
  error_of([&] { open_images(folder / "none.png"); }, ErrorKind::kRead);
}

TEST_CASE("open_frames: without video input a video is refused with that reason") {
  CHECK(error_of([] { open_frames(golden("video/one.mp4")); }, ErrorKind::kUnsupported)
            .find("built without video input") != std::string::npos);
}

}  // namespace lvggt
