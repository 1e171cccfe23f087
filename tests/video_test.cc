// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/video.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <array>
#include <cmath>

#include "tests/support/picture_bytes.h"
#include "tests/support/temp_dir.h"

namespace lvggt {
namespace {

using test::big_endian;
using test::golden;
using test::read_file;
using test::TempDir;
using test::write_file;

std::string video(const std::string& name) { return golden("video/" + name); }

// Everything a source delivers, and what it says then.
struct Run {
  std::vector<InputFrame> frames;
  InputReport report;
  std::string warnings;  // all in one
};

Run run(const std::string& path, const FrameSourceOptions& options = {}) {
  const auto source = open_frames(path, options, open_video);
  Run result;
  while (auto frame = source->next()) result.frames.push_back(std::move(*frame));
  result.report = source->report();
  for (const std::string& warning : source->warnings()) result.warnings += warning + "\n";
  return result;
}

Run run_bytes(const std::string& bytes, const std::string& name = "a.mp4") {
  const TempDir folder;
  write_file(folder / name, bytes);
  return run(folder / name);
}

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

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

void check_times_rise(const Run& result) {
  for (std::size_t i = 1; i < result.frames.size(); ++i)
    CHECK(result.frames[i].timestamp > result.frames[i - 1].timestamp);
}

bool same_pixels(const Image& a, const Image& b) {
  return a.pixels.shape() == b.pixels.shape() &&
         std::equal(a.pixels.data(), a.pixels.data() + a.pixels.size(), b.pixels.data());
}

// two.mp4 with another display matrix [a b; c d], in its track header.
std::string with_display_matrix(int a, int b, int c, int d) {
  const auto fixed = [](int x) { return big_endian(static_cast<std::uint32_t>(x) << 16, 4); };
  const std::string zero = big_endian(0, 4), end = zero + zero + big_endian(1u << 30, 4);
  const std::string identity = fixed(1) + zero + zero + zero + fixed(1) + zero + end;
  std::string bytes = read_file(video("two.mp4"));
  bytes.replace(bytes.find(identity, bytes.find("tkhd")), identity.size(),
                fixed(a) + fixed(b) + zero + fixed(c) + fixed(d) + zero + end);
  return bytes;
}

}  // namespace

TEST_CASE("C19: a video without a picture stream is refused with what it has") {
  const auto message = [](const char* name) {
    return error_of([=] { run(video(name)); }, ErrorKind::kFormat);
  };
  CHECK(contains(message("audio.mp4"), "has no video stream; its streams: 1 audio"));
  CHECK(
      contains(message("cover.m4a"), "has no video stream; its streams: 1 audio, 1 cover picture"));
}

TEST_CASE("C20: videos of 1 and 2 frames work, one of 0 frames is refused") {
  CHECK(run(video("one.mp4")).frames.size() == 1);
  const Run two = run(video("two.mp4"));
  CHECK(two.frames.size() == 2);
  CHECK_FALSE(two.report.partial);
  CHECK(two.warnings.empty());
  // Headers without any of the frames they describe.
  const std::string mkv = read_file(video("bframes.mkv"));
  const std::string header = mkv.substr(0, mkv.find("\x1f\x43\xb6\x75"));
  CHECK(contains(error_of([&] { run_bytes(header, "a.mkv"); }, ErrorKind::kFormat),
                 "ends before its first frame"));
  const std::string mp4 = read_file(video("bframes.mp4")).substr(0, 1200);
  CHECK(contains(error_of([&] { run_bytes(mp4); }, ErrorKind::kFormat),
                 "no frame could be decoded; it lists 12 packets, but has "));
  CHECK(contains(error_of([&] { run_bytes(""); }, ErrorKind::kFormat), "is empty"));
}

TEST_CASE("C21: a video cut in the middle gives the frames before the cut and is partial") {
  const std::array<std::pair<const char*, std::size_t>, 3> cuts{
      {{"bframes.mp4", 2523}, {"bframes.mkv", 2210}, {"mpeg4.avi", 6800}}};
  for (const auto& cut : cuts) {
    const char* const name = cut.first;
    CAPTURE(name);
    const std::string whole = read_file(video(name));
    const Run all = run(video(name));
    CHECK(all.frames.size() == 12);
    CHECK_FALSE(all.report.partial);
    const Run part = run_bytes(whole.substr(0, cut.second), name);
    CHECK(part.report.partial);
    CHECK(contains(part.warnings, "ends early, after frame "));
    REQUIRE(part.frames.size() >= 4);
    REQUIRE(part.frames.size() < 12);
    for (std::size_t i = 0; i < 4; ++i)
      CHECK(same_pixels(part.frames[i].image, all.frames[i].image));
  }
}

TEST_CASE("C21: a video cut anywhere is an Error or partial, never a fault") {
  for (const char* name : {"bframes.mp4", "bframes.mkv", "mpeg4.avi"}) {
    const std::string whole = read_file(video(name));
    for (std::size_t i = 1; i < 32; ++i) {
      try {
        const Run part = run_bytes(whole.substr(0, whole.size() * i / 32), name);
        CHECK(part.frames.size() <= 12);
      } catch (const Error& error) {
        CHECK(contains(error.what(), name));
      }
    }
  }
}

TEST_CASE("C22: damaged packets in the middle are counted and said") {
  std::string bytes = read_file(video("mpeg4.avi"));
  // The fourth and fifth frame's data, behind their chunk headers.
  std::size_t at = bytes.find("movi");
  for (int i = 0; i < 4; ++i) at = bytes.find("00dc", at + 4);
  std::fill_n(bytes.begin() + static_cast<std::ptrdiff_t>(at) + 8, 60, '\xff');
  const Run result = run_bytes(bytes, "a.avi");
  CHECK(result.report.damaged_packets + result.report.damaged_frames > 0);
  CHECK(contains(result.warnings, "damaged packets were skipped") ==
        (result.report.damaged_packets > 0));
  CHECK(contains(result.warnings, "decoded with errors") == (result.report.damaged_frames > 0));
  CHECK(result.frames.size() >= 10);
  check_times_rise(result);
}

TEST_CASE("C22: changed bytes anywhere end in frames or an Error, never in a fault") {
  for (const char* name : {"bframes.mp4", "bframes.mkv", "mpeg4.avi", "bframes.h264"}) {
    const std::string whole = read_file(video(name));
    std::uint32_t state = 3;
    for (int round = 0; round < 25; ++round) {
      std::string changed = whole;
      for (int i = 0; i < 4; ++i) {
        state = state * 1664525u + 1013904223u;
        changed[(state >> 8) % changed.size()] = static_cast<char>(state >> 24);
      }
      try {
        const Run result = run_bytes(changed, name);
        check_times_rise(result);
      } catch (const Error& error) {
        CHECK(contains(error.what(), name));
      }
    }
  }
}

TEST_CASE("C23: the display matrix turns and mirrors frames") {
  const Run plain = run(video("two.mp4"));
  const Image& stored = plain.frames[0].image;
  // For each matrix, where the stored pixel (x, y) of a 64x48 frame is shown.
  struct Case {
    std::array<int, 4> matrix;
    std::int64_t (*shown_x)(std::int64_t x, std::int64_t y);
    std::int64_t (*shown_y)(std::int64_t x, std::int64_t y);
  };
  using I = std::int64_t;
  const std::array<Case, 5> cases{{
      {{1, 0, 0, 1}, [](I x, I) { return x; }, [](I, I y) { return y; }},
      {{0, 1, -1, 0}, [](I, I y) { return 47 - y; }, [](I x, I) { return x; }},        // 90
      {{-1, 0, 0, -1}, [](I x, I) { return 63 - x; }, [](I, I y) { return 47 - y; }},  // 180
      {{0, -1, 1, 0}, [](I, I y) { return y; }, [](I x, I) { return 63 - x; }},        // 270
      {{-1, 0, 0, 1}, [](I x, I) { return 63 - x; }, [](I, I y) { return y; }},        // mirrored
  }};
  for (const Case& c : cases) {
    CAPTURE(c.matrix[0]);
    CAPTURE(c.matrix[1]);
    const Run turned =
        run_bytes(with_display_matrix(c.matrix[0], c.matrix[1], c.matrix[2], c.matrix[3]));
    const Image& shown = turned.frames[0].image;
    CHECK(shown.width() == (c.matrix[0] == 0 ? 48 : 64));
    CHECK(shown.height() == (c.matrix[0] == 0 ? 64 : 48));
    std::int64_t num_wrong = 0;
    for (I y = 0; y < 48; ++y)
      for (I x = 0; x < 64; ++x)
        for (I channel = 0; channel < 3; ++channel)
          num_wrong += shown.pixels(c.shown_y(x, y), c.shown_x(x, y), channel) !=
                       stored.pixels(y, x, channel);
    CHECK(num_wrong == 0);
  }
}

TEST_CASE("C23: a matrix that is no quarter turn is left out with a warning") {
  const Run result = run_bytes(with_display_matrix(1, 1, -1, 1));
  CHECK(result.frames[0].image.width() == 64);
  CHECK(contains(result.warnings, "only quarter turns are applied"));
}

TEST_CASE("C23: pixels that are not square are stretched, with a warning") {
  const Run result = run(video("wide_pixels.mp4"));
  CHECK(result.frames[0].image.width() == 96);
  CHECK(result.frames[0].image.height() == 48);
  CHECK(contains(result.warnings, "64x48 is stretched to 96x48"));
}

TEST_CASE("C24: variable frame rate is kept in the timestamps") {
  const Run result = run(video("vfr.mkv"));
  REQUIRE(result.frames.size() == 6);
  const std::array<double, 6> expected{0, 0.15, 0.2, 0.35, 0.4, 0.55};
  for (std::size_t i = 0; i < 6; ++i)
    CHECK(result.frames[i].timestamp == doctest::Approx(expected[i]).epsilon(1e-9));
  CHECK(result.report.repaired_timestamps == 0);
}

TEST_CASE("C24: B-frames come in the order of display; missing timestamps are replaced") {
  const Run timed = run(video("bframes.mp4"));
  const Run untimed = run(video("bframes.h264"));
  REQUIRE(timed.frames.size() == 12);
  REQUIRE(untimed.frames.size() == 12);
  check_times_rise(timed);
  check_times_rise(untimed);
  for (std::size_t i = 0; i < 12; ++i)
    CHECK(same_pixels(timed.frames[i].image, untimed.frames[i].image));
  CHECK(timed.report.repaired_timestamps == 0);
  CHECK(untimed.report.repaired_timestamps == 12);
  CHECK(contains(untimed.warnings, "12 timestamps were missing"));
}

TEST_CASE("C25: another size in the middle names the frame and both sizes") {
  const std::string both = read_file(video("bframes.h264")) + read_file(video("narrow.h264"));
  CHECK(contains(error_of([&] { run_bytes(both, "a.h264"); }, ErrorKind::kMismatch),
                 "frame 12 has 32x48 pixels but the frames before it have 64x48"));
}

TEST_CASE("C26: matrix and range of the stream decide the colours") {
  for (const char* name :
       {"red_bt601_tv.mp4", "red_bt601_pc.mp4", "red_bt709_tv.mp4", "red_bt709_pc.mp4"}) {
    CAPTURE(name);
    const Run result = run(video(name));
    const std::array<int, 3> expected{0xc0, 0x40, 0x20};
    for (std::int64_t c = 0; c < 3; ++c)
      CHECK(std::abs(result.frames[0].image.pixels(16, 16, c) -
                     expected[static_cast<std::size_t>(c)]) <= 3);
  }
}

TEST_CASE("C26: interlaced and high dynamic range material is taken as it is, and that is said") {
  const Run result = run(video("hdr_interlaced.mp4"));
  CHECK(result.frames.size() == 2);
  CHECK(contains(result.warnings, "is interlaced; the fields are not separated"));
  CHECK(contains(result.warnings, "has high dynamic range (smpte2084)"));
}

TEST_CASE("C27: of two video streams the first is used, and that is said") {
  const Run result = run(video("two_streams.mkv"));
  CHECK(result.frames[0].image.width() == 64);
  CHECK(contains(result.warnings, "has 2 video streams, the first one (stream 0) is used"));
}

TEST_CASE("C28: a claim of 10^9 frames or 10^6 frames per second is not believed") {
  const std::string bytes = read_file(video("mpeg4.avi"));
  const std::size_t header = bytes.find("strh") + 8;  // scale, rate, start, length from byte 20 on
  std::string claims = bytes;
  claims.replace(header + 32, 4, "\x00\xca\x9a\x3b", 4);
  const auto path = [](const TempDir& folder, const std::string& content) {
    write_file(folder / "a.avi", content);
    return folder / "a.avi";
  };
  const TempDir folder;
  CHECK(open_video(path(folder, claims))->expected_frames() == -1);
  CHECK(run(path(folder, claims)).frames.size() == 12);
  std::string fast = bytes;
  fast.replace(header + 20, 8, "\x01\x00\x00\x00\x40\x42\x0f\x00", 8);
  const Run result = run(path(folder, fast));
  CHECK(result.frames.size() == 12);
  check_times_rise(result);
}

TEST_CASE("C28: limits on frames and pixels are kept") {
  FrameSourceOptions options;
  options.limits.video_frames = 5;
  CHECK(contains(error_of([&] { run(video("bframes.mp4"), options); }, ErrorKind::kLimit),
                 "more than the limit of 5 frames"));
  options.limits = {};
  options.limits.image_pixels = 64 * 48 - 1;
  CHECK(contains(error_of([&] { run(video("bframes.mp4"), options); }, ErrorKind::kLimit),
                 "64x48 pixels are more than the limit of 3071"));
}

TEST_CASE("C29: playlists are refused, whatever they are called") {
  const std::string target = video("one.mp4");
  for (const std::string& list :
       {"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n" + target + "\n#EXT-X-ENDLIST\n",
        "ffconcat version 1.0\nfile '" + target + "'\n", std::string("<?xml version='1.0'?><MPD/>"),
        std::string("v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n")}) {
    const TempDir folder;
    for (const char* name : {"a.avi", "a.mp4", "a.m3u8"}) {
      write_file(folder / name, list);
      CHECK(contains(error_of([&] { open_video(folder / name); }, ErrorKind::kUnsupported),
                     "names other files"));
      error_of([&] { run(folder / name); }, ErrorKind::kUnsupported);
    }
  }
}

TEST_CASE("C30: URLs, pipes and commands are only names of files") {
  for (const char* name : {"http://127.0.0.1:9/a.mp4", "pipe:0", "|true", "-i", "concat:a|b",
                           "data:video/mp4;base64,AAAA", "file:a.mp4"})
    error_of([=] { open_frames(name, {}, open_video); }, ErrorKind::kRead);
  const TempDir folder;
  for (const char* name : {"pipe:0", "|true", "-i", "concat:a|b", "a%03d.mp4", "a b\n'.mp4"}) {
    write_file(folder / name, read_file(video("one.mp4")));
    CHECK(run(folder / name).frames.size() == 1);
  }
}

TEST_CASE("open_video: start, stride and max_frames select frames of the whole video") {
  const Run all = run(video("bframes.mp4"));
  const Run some = run(video("bframes.mp4"), {.start = 2, .stride = 4, .max_frames = 2});
  REQUIRE(some.frames.size() == 2);
  CHECK(some.frames[1].source_index == 6);
  CHECK(some.frames[1].name == "frame 6");
  CHECK(some.frames[1].timestamp == all.frames[6].timestamp);
  CHECK(same_pixels(some.frames[1].image, all.frames[6].image));
  CHECK(open_video(video("bframes.mp4"), {.start = 2, .stride = 4})->expected_frames() == 3);
  CHECK(contains(error_of([] { run(video("bframes.mp4"), {.start = 12}); }, ErrorKind::kUsage),
                 "start: 12 is beyond the last of 12 frames"));
  CHECK(contains(error_of([] { open_video(video("one.mp4"), {.stride = 0}); }, ErrorKind::kUsage),
                 "stride"));
}

TEST_CASE("open_video: what is not a video is refused with what it looks like") {
  CHECK(contains(error_of([] { run_bytes("<!doctype html><html>404"); }, ErrorKind::kFormat),
                 "it looks like an HTML page"));
  error_of([] { open_video(video("")); }, ErrorKind::kRead);
}

}  // namespace lvggt
