// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/frame_source.h"

#include <algorithm>
#include <array>
#include <cctype>
#include <cmath>
#include <filesystem>
#include <system_error>
#include <utility>

#include "kernels/io/frame_selection.h"
#include "kernels/io/printable.h"
#include "lvggt/io/input_file.h"

namespace lvggt {

namespace {

bool is_digit(char c) { return c >= '0' && c <= '9'; }

// The extension in lower case, without the dot.
std::string extension_of(std::string_view name) {
  const std::size_t dot = name.rfind('.');
  std::string extension(dot == std::string_view::npos ? "" : name.substr(dot + 1));
  for (char& c : extension) c = static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return extension;
}

}  // namespace

bool has_image_extension(std::string_view name) {
  const std::string extension = extension_of(name);
  return extension == "png" || extension == "jpg" || extension == "jpeg";
}

namespace {

// Names of the images in a folder, in natural order, and how many entries are something else.
struct Listing {
  std::vector<std::string> images;
  std::int64_t num_skipped = 0;
  std::string first_skipped;
};

Listing list_images(const std::string& folder) {
  Listing listing;
  std::error_code error;
  std::filesystem::directory_iterator entry(folder, error);
  for (; !error && entry != std::filesystem::directory_iterator(); entry.increment(error)) {
    const std::string name = entry->path().filename().string();
    std::error_code ignored;
    if (name.starts_with('.') || !has_image_extension(name) || entry->is_directory(ignored)) {
      if (listing.num_skipped++ == 0 || name < listing.first_skipped) listing.first_skipped = name;
    } else {
      listing.images.push_back(name);
    }
  }
  if (error) fail(ErrorKind::kRead, "cannot list the folder ", folder, ": ", error.message());
  std::sort(listing.images.begin(), listing.images.end(),
            [](const std::string& a, const std::string& b) { return natural_less(a, b); });
  return listing;
}

class ImageSource : public FrameSource {
 public:
  // `folder` ends in a slash, or is empty.
  ImageSource(std::string folder, std::vector<std::string> names, const FrameSourceOptions& options)
      : folder_(std::move(folder)), names_(std::move(names)), options_(options) {
    const auto num_images = static_cast<std::int64_t>(names_.size());
    detail::check_start(options, num_images, "images");
    num_frames_ = detail::num_selected(options, num_images);
  }

  std::optional<InputFrame> next() override {
    if (position_ == num_frames_) return std::nullopt;
    InputFrame frame;
    frame.source_index = options_.start + position_ * options_.stride;
    frame.timestamp = static_cast<double>(frame.source_index) / options_.images_per_second;
    frame.name = names_[static_cast<std::size_t>(frame.source_index)];
    frame.image = load_image(folder_ + frame.name, options_.limits);
    check_size(frame);
    for (const std::string& note : frame.image.notes) add_note(note);
    ++position_;
    return frame;
  }

  std::int64_t expected_frames() const override { return num_frames_; }

  void skipped(const Listing& listing, const std::string& path) {
    report_.skipped_files = listing.num_skipped;
    if (listing.num_skipped > 0)
      warnings_.push_back(concat(
          path, ": ", listing.num_skipped, listing.num_skipped == 1 ? " entry is" : " entries are",
          " not a PNG or JPEG file and skipped, such as ", in_quotes(listing.first_skipped)));
  }

 private:
  void check_size(const InputFrame& frame) {
    if (first_name_.empty()) {
      first_name_ = frame.name;
      width_ = frame.image.width();
      height_ = frame.image.height();
    }
    LVGGT_CHECK(frame.image.width() == width_ && frame.image.height() == height_, folder_,
                frame.name, ": has ", frame.image.width(), "x", frame.image.height(),
                " pixels but ", folder_, first_name_, " has ", width_, "x", height_,
                "; all frames must have one size");
  }

  // The notes of a thousand frames would say the same thing a thousand times.
  void add_note(const std::string& note) {
    constexpr std::size_t kMaxNotes = 3;
    if (++num_notes_ <= kMaxNotes) warnings_.push_back(note);
    if (num_notes_ == kMaxNotes + 1)
      warnings_.push_back(concat(folder_, ": more notes of this kind are left out"));
  }

  std::string folder_;
  std::vector<std::string> names_;
  FrameSourceOptions options_;
  std::int64_t num_frames_ = 0;
  std::int64_t position_ = 0;
  std::string first_name_;  // of the frame that sets the size
  std::int64_t width_ = 0, height_ = 0;
  std::size_t num_notes_ = 0;
};

bool is_folder(const std::string& path) {
  std::error_code ignored;
  return std::filesystem::is_directory(path, ignored);
}

FileGuess guess_path(const std::string& path) {
  const InputFile file(path);
  std::array<std::byte, 64> head;
  const auto length = static_cast<std::size_t>(
      std::min<std::int64_t>(file.size(), static_cast<std::int64_t>(head.size())));
  file.read_at(0, head.data(), length);
  return guess_file(std::span(head).first(length));
}

std::unique_ptr<FrameSource> open_folder(const std::string& path,
                                         const FrameSourceOptions& options) {
  Listing listing = list_images(path);
  if (listing.images.empty())
    fail(ErrorKind::kUnsupported, path, ": the folder has no PNG or JPEG image",
         listing.num_skipped == 0 ? concat(" and is empty")
                                  : concat(" among its ", listing.num_skipped, " entries, such as ",
                                           in_quotes(listing.first_skipped)));
  auto source = std::make_unique<ImageSource>(path.ends_with('/') ? path : path + '/',
                                              std::move(listing.images), options);
  source->skipped(listing, path);
  return source;
}

}  // namespace

namespace detail {

void check_options(const FrameSourceOptions& options) {
  if (options.start < 0) fail(ErrorKind::kUsage, "start: ", options.start, " is negative");
  if (options.stride < 1) fail(ErrorKind::kUsage, "stride: ", options.stride, " is not at least 1");
  if (options.max_frames < 1)
    fail(ErrorKind::kUsage, "max frames: ", options.max_frames, " is not at least 1");
  if (!(options.images_per_second > 0) || !std::isfinite(options.images_per_second))
    fail(ErrorKind::kUsage, "images per second: ", options.images_per_second,
         " is not a positive number");
}

void check_start(const FrameSourceOptions& options, std::int64_t num_frames, const char* what) {
  if (options.start >= num_frames)
    fail(ErrorKind::kUsage, "start: ", options.start, " is beyond the last of ", num_frames, " ",
         what, ", counted from 0");
}

std::int64_t num_selected(const FrameSourceOptions& options, std::int64_t num_frames) {
  if (num_frames <= options.start) return 0;
  return std::min((num_frames - options.start - 1) / options.stride + 1, options.max_frames);
}

bool is_selected(const FrameSourceOptions& options, std::int64_t index) {
  return index >= options.start && (index - options.start) % options.stride == 0;
}

}  // namespace detail

bool natural_less(std::string_view a, std::string_view b) {
  std::size_t i = 0, j = 0;
  while (i < a.size() && j < b.size()) {
    if (!is_digit(a[i]) || !is_digit(b[j])) {
      if (a[i] != b[j]) return static_cast<unsigned char>(a[i]) < static_cast<unsigned char>(b[j]);
      ++i;
      ++j;
      continue;
    }
    // Two numbers of any length: without leading zeros, the longer one is larger.
    while (i < a.size() && a[i] == '0') ++i;
    while (j < b.size() && b[j] == '0') ++j;
    const std::size_t a_begin = i, b_begin = j;
    while (i < a.size() && is_digit(a[i])) ++i;
    while (j < b.size() && is_digit(b[j])) ++j;
    const std::string_view x = a.substr(a_begin, i - a_begin), y = b.substr(b_begin, j - b_begin);
    if (x.size() != y.size()) return x.size() < y.size();
    if (x != y) return x < y;
  }
  if ((i < a.size()) != (j < b.size())) return j < b.size();
  return a < b;  // they differ in leading zeros only, if at all
}

std::unique_ptr<FrameSource> open_images(const std::string& path,
                                         const FrameSourceOptions& options) {
  detail::check_options(options);
  if (is_folder(path)) return open_folder(path, options);
  InputFile{path};  // a missing file is an error now, not at the first frame
  return std::make_unique<ImageSource>("", std::vector<std::string>{path}, options);
}

std::unique_ptr<FrameSource> open_frames(const std::string& path, const FrameSourceOptions& options,
                                         VideoOpener video) {
  detail::check_options(options);
  if (is_folder(path)) return open_folder(path, options);
  const FileGuess guess = guess_path(path);
  if (guess.kind == FileKind::kPng || guess.kind == FileKind::kJpeg)
    return open_images(path, options);
  if (guess.kind == FileKind::kUnsupportedImage)
    fail(ErrorKind::kUnsupported, path, ": ", guess.name,
         " images are not supported, convert it to PNG, JPEG or a video");
  if (guess.kind == FileKind::kPlaylist)
    fail(ErrorKind::kUnsupported, path, ": is ", guess.name,
         ", which names other files; give the video file itself");
  if (!video)
    fail(ErrorKind::kUnsupported, path,
         ": is not a PNG or JPEG image, and this program was built without video input");
  return video(path, options);
}

}  // namespace lvggt
