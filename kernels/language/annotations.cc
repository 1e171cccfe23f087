// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/annotations.h"

#include <algorithm>
#include <charconv>
#include <filesystem>
#include <limits>
#include <set>

#include "lvggt/io/checked.h"
#include "lvggt/io/json.h"
#include "lvggt/language/polygon.h"

namespace lvggt {
namespace {

const Json& member(const Json& object, const char* key, const std::string& place) {
  const Json* found = object.find(key);
  if (found == nullptr) fail(ErrorKind::kFormat, place, ": there is no \"", key, "\"");
  return *found;
}

std::int64_t int_member(const Json& object, const char* key, const std::string& place) {
  return member(object, key, place).as_int64(concat(place, ": ", key));
}

std::int64_t extent_member(const Json& object, const char* key, const std::string& place) {
  const std::int64_t extent = int_member(object, key, place);
  if (extent < 1) fail(ErrorKind::kFormat, place, ": the ", key, " is ", extent);
  return extent;
}

// A polygon's points; it must have some, and touch its picture.
Polygon read_polygon(const Json& json, const AnnotatedImage& image, const std::string& place) {
  const Json::Array& numbers = json.as_array(place);
  if (numbers.empty() || numbers.size() % 2 != 0)
    fail(ErrorKind::kFormat, place, ": a polygon has ", numbers.size(),
         " coordinates, not two for each of its points");
  Polygon points;
  constexpr double kFar = std::numeric_limits<double>::infinity();
  double low_x = kFar, low_y = kFar, high_x = -kFar, high_y = -kFar;
  for (std::size_t i = 0; i < numbers.size(); i += 2) {
    const double x = numbers[i].as_double(place), y = numbers[i + 1].as_double(place);
    if (std::max(std::abs(x), std::abs(y)) > kMaxPolygonCoordinate)
      fail(ErrorKind::kFormat, place, ": the point (", x, ", ", y, ") lies far outside of the ",
           image.width, " x ", image.height, " picture ", image.file_name);
    points.push_back({x, y});
    low_x = std::min(low_x, x), high_x = std::max(high_x, x);
    low_y = std::min(low_y, y), high_y = std::max(high_y, y);
  }
  if (high_x < 0 || high_y < 0 || low_x > static_cast<double>(image.width) ||
      low_y > static_cast<double>(image.height))
    fail(ErrorKind::kFormat, place, ": a polygon from (", low_x, ", ", low_y, ") to (", high_x,
         ", ", high_y, ") lies outside of the ", image.width, " x ", image.height, " picture ",
         image.file_name);
  return points;
}

RunLengths read_runs(const Json& json, const AnnotatedImage& image, const std::string& place) {
  const Json::Array& size = member(json, "size", place).as_array(place + ": size");
  if (size.size() != 2)
    fail(ErrorKind::kFormat, place, ": size has ", size.size(), " entries, not 2");
  RunLengths code{size[0].as_int64(place + ": size"), size[1].as_int64(place + ": size"), {}};
  if (code.height != image.height || code.width != image.width)
    fail(ErrorKind::kMismatch, place, ": the mask is ", code.width, " x ", code.height,
         " but the picture ", image.file_name, " is ", image.width, " x ", image.height);
  const Json& counts = member(json, "counts", place);
  if (counts.is_string()) {
    code.runs = parse_run_lengths(counts.as_string(place), place);
  } else {
    for (const Json& run : counts.as_array(place + ": counts"))
      code.runs.push_back(run.as_int64(place + ": counts"));
  }
  std::int64_t sum = 0;
  for (const std::int64_t run : code.runs) {
    const auto next = checked_add(sum, run);
    if (run < 0 || !next) fail(ErrorKind::kFormat, place, ": a run of ", run, " pixels");
    sum = *next;
  }
  if (sum != size_product(code.height, code.width))
    fail(ErrorKind::kFormat, place, ": the runs add up to ", sum, " pixels, not ", code.width,
         " x ", code.height);
  return code;
}

ObjectMask read_object(const Json& json, const AnnotatedImage& image, const std::string& place) {
  ObjectMask object;
  if (json.is_object()) {
    object.runs.push_back(read_runs(json, image, place));
    return object;
  }
  for (const Json& polygon : json.as_array(place))
    object.polygons.push_back(read_polygon(polygon, image, place));
  if (object.polygons.empty()) fail(ErrorKind::kFormat, place, ": there is no polygon");
  return object;
}

std::map<std::int64_t, std::string> read_categories(const Json& root, const std::string& path) {
  std::map<std::int64_t, std::string> categories;
  std::set<std::string> names;
  const Json::Array& list = member(root, "categories", path).as_array(path + ": categories");
  for (std::size_t i = 0; i < list.size(); ++i) {
    const std::string place = concat(path, ": categories[", i, "]");
    const std::int64_t id = int_member(list[i], "id", place);
    const std::string& name = member(list[i], "name", place).as_string(place + ": name");
    if (!categories.emplace(id, name).second)
      fail(ErrorKind::kFormat, place, ": the id ", id, " is there twice");
    if (!names.insert(name).second)
      fail(ErrorKind::kFormat, place, ": the category \"", name, "\" is there twice");
  }
  return categories;
}

std::map<std::int64_t, AnnotatedImage> read_images(const Json& root, const std::string& path,
                                                   const AnnotationOptions& options) {
  const std::filesystem::path folder = std::filesystem::path(path).parent_path();
  std::map<std::int64_t, AnnotatedImage> images;
  std::map<std::int64_t, std::string> frames;
  const Json::Array& list = member(root, "images", path).as_array(path + ": images");
  for (std::size_t i = 0; i < list.size(); ++i) {
    const std::string place = concat(path, ": images[", i, "]");
    AnnotatedImage image;
    image.file_name = member(list[i], "file_name", place).as_string(place + ": file_name");
    image.height = extent_member(list[i], "height", place);
    image.width = extent_member(list[i], "width", place);
    image.frame = annotated_frame(image.file_name, options.layout);
    std::error_code error;
    if (options.check_images && !std::filesystem::exists(folder / image.file_name, error))
      fail(ErrorKind::kRead, (folder / image.file_name).string(),
           ": there is no such picture, but ", place, " names it");
    const auto [same, added] = frames.emplace(image.frame, image.file_name);
    if (!added)
      fail(ErrorKind::kFormat, place, ": ", image.file_name, " and ", same->second,
           " are pictures of one frame");
    const std::int64_t id = int_member(list[i], "id", place);
    if (!images.emplace(id, std::move(image)).second)
      fail(ErrorKind::kFormat, place, ": the id ", id, " is there twice");
  }
  return images;
}

void add_object(AnnotatedImage& image, const std::string& label, ObjectMask object) {
  const auto found = std::find_if(image.labels.begin(), image.labels.end(),
                                  [&](const auto& entry) { return entry.first == label; });
  if (found != image.labels.end()) {
    found->second.push_back(std::move(object));
  } else {
    image.labels.emplace_back(label, std::vector<ObjectMask>());
    image.labels.back().second.push_back(std::move(object));
  }
}

}  // namespace

std::vector<std::int64_t> parse_run_lengths(const std::string& text, const std::string& place) {
  std::vector<std::int64_t> runs;
  for (std::size_t i = 0; i < text.size();) {
    std::int64_t value = 0;
    int bits = 0;
    for (bool more = true; more; ++i) {
      const int digit = i < text.size() ? text[i] - '0' : -1;
      if (digit < 0 || digit > 63 || bits > 55)
        fail(ErrorKind::kFormat, place, ": the run-length text breaks off or is not one, at byte ",
             i, " of ", text.size());
      value |= static_cast<std::int64_t>(digit & 31) << bits;
      bits += 5;
      more = (digit & 32) != 0;
      // The last digit's fifth bit is the sign.
      if (!more && (digit & 16) != 0) value -= std::int64_t{1} << bits;
    }
    runs.push_back(runs.size() > 2 ? value + runs[runs.size() - 2] : value);
  }
  return runs;
}

void paint_runs(View<std::uint8_t, 2> mask, const RunLengths& code) {
  const auto [H, W] = mask.shape();
  LVGGT_CHECK(H == code.height && W == code.width, "run lengths: the mask is ", W, " x ", H,
              ", not ", code.width, " x ", code.height);
  std::int64_t pixel = 0;
  for (std::size_t i = 0; i < code.runs.size(); ++i) {
    LVGGT_CHECK(code.runs[i] >= 0 && code.runs[i] <= H * W - pixel, "run lengths: run ", i, " of ",
                code.runs[i], " pixels does not fit the mask of ", W, " x ", H);
    for (std::int64_t n = 0; n < code.runs[i]; ++n, ++pixel)
      if (i % 2 == 1) mask(pixel % H, pixel / H) = 1;
  }
}

const std::vector<ObjectMask>* AnnotatedImage::find(const std::string& label) const {
  for (const auto& [name, objects] : labels)
    if (name == label) return &objects;
  return nullptr;
}

void paint_label(View<std::uint8_t, 2> mask, const std::vector<ObjectMask>& objects,
                 PolygonRule rule) {
  for (std::int64_t y = 0; y < mask.extent(0); ++y)
    std::fill_n(mask[y].data(), mask.extent(1), std::uint8_t{0});
  for (const ObjectMask& object : objects) {
    for (const RunLengths& code : object.runs) paint_runs(mask, code);
    const std::size_t count = rule == PolygonRule::kFirst
                                  ? std::min<std::size_t>(1, object.polygons.size())
                                  : object.polygons.size();
    for (std::size_t i = 0; i < count; ++i) fill_polygon(mask, object.polygons[i]);
  }
}

std::int64_t annotated_frame(const std::string& file_name, SceneLayout layout) {
  std::int64_t number = -1;
  const char* end = file_name.data() + file_name.size();
  const auto [rest, error] = std::from_chars(file_name.data(), end, number);
  if (error != std::errc() || rest == file_name.data() || number < 0 ||
      (rest != end && *rest != '_' && *rest != '.'))
    fail(ErrorKind::kFormat, "annotations: the picture's name \"", file_name,
         "\" does not start with a frame number");
  if (layout == SceneLayout::kNeu3d) return number;
  if (number == 0)
    fail(ErrorKind::kFormat, "annotations: \"", file_name,
         "\" is frame 0, but this layout counts from 1");
  return number - 1;
}

std::vector<AnnotatedImage> read_coco_annotations(const std::string& path,
                                                  const AnnotationOptions& options) {
  const Json root = Json::read(path);
  const std::map<std::int64_t, std::string> categories = read_categories(root, path);
  std::map<std::int64_t, AnnotatedImage> images = read_images(root, path, options);
  const Json::Array& list = member(root, "annotations", path).as_array(path + ": annotations");
  for (std::size_t i = 0; i < list.size(); ++i) {
    const std::string place = concat(path, ": annotations[", i, "]");
    const std::int64_t image_id = int_member(list[i], "image_id", place);
    const auto image = images.find(image_id);
    if (image == images.end())
      fail(ErrorKind::kMismatch, place, ": the image_id ", image_id, " is no picture of the list");
    const std::int64_t category_id = int_member(list[i], "category_id", place);
    const auto category = categories.find(category_id);
    if (category == categories.end())
      fail(ErrorKind::kMismatch, place, ": the category_id ", category_id,
           " is no category of the list");
    add_object(image->second, category->second,
               read_object(member(list[i], "segmentation", place), image->second,
                           place + ": segmentation"));
  }
  std::vector<AnnotatedImage> sorted;
  for (auto& [id, image] : images) sorted.push_back(std::move(image));
  std::sort(sorted.begin(), sorted.end(),
            [](const auto& a, const auto& b) { return a.frame < b.frame; });
  return sorted;
}

}  // namespace lvggt
