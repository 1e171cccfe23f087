// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/lifted_field.h"

#include <filesystem>

#include "lvggt/field/frame_files.h"
#include "lvggt/io/image.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/read_depth_png.h"

namespace lvggt {
namespace {

namespace fs = std::filesystem;

constexpr std::int64_t kMostValues = std::int64_t{1} << 16;  // levels, values of a code

void write_codes_format(JsonWriter& json, const char* folder,
                        const std::optional<CodesFormat>& codes) {
  json.key(folder);
  if (!codes) {
    json.null();
    return;
  }
  json.begin_object();
  json.key("levels");
  json.begin_array();
  for (const std::string& level : codes->levels) json.value(level);
  json.end_array();
  json.field("dim", codes->dim);
  json.field("storage", "f16");
  json.field("layout", "one safetensors file a frame, tensor \"codes\" [level, H, W, dim]");
  json.field("decoder_sha256", codes->decoder_sha256);
  json.end_object();
}

// Reads members of a JSON object; what is missing or out of range is named with the file.
class Members {
 public:
  Members(const Json& object, std::string place) : object_(object), place_(std::move(place)) {}

  const Json& at(const std::string& key) const {
    const Json* member = object_.find(key);
    if (member == nullptr) fail(ErrorKind::kFormat, place_, " has no \"", key, "\"");
    return *member;
  }
  std::string name(const std::string& key) const { return place_ + ": " + key; }
  std::int64_t number(const std::string& key, std::int64_t low, std::int64_t high) const {
    const std::int64_t value = at(key).as_int64(name(key));
    if (value < low || value > high)
      fail(ErrorKind::kFormat, name(key), " is ", value, ", not from ", low, " to ", high);
    return value;
  }
  double real(const std::string& key) const { return at(key).as_double(name(key)); }
  const std::string& text(const std::string& key) const { return at(key).as_string(name(key)); }
  bool flag(const std::string& key) const { return at(key).as_bool(name(key)); }
  const Json::Array& list(const std::string& key) const { return at(key).as_array(name(key)); }
  Members object(const std::string& key) const {
    at(key).as_object(name(key));
    return {at(key), name(key)};
  }

 private:
  const Json& object_;
  std::string place_;
};

std::optional<CodesFormat> read_codes_format(const Members& field, CodesKind kind,
                                             const FieldFormat& format) {
  const std::string folder = codes_folder(kind);
  if (field.at(folder).is_null()) return std::nullopt;
  const Members members = field.object(folder);
  CodesFormat codes;
  for (const Json& level : members.list("levels"))
    codes.levels.push_back(level.as_string(members.name("levels")));
  if (codes.levels.empty() || codes.num_levels() > kMostValues)
    fail(ErrorKind::kFormat, members.name("levels"), " has ", codes.levels.size(), " entries");
  codes.dim = members.number("dim", 1, kMostValues);
  codes.decoder_sha256 = members.text("decoder_sha256");
  codes.height = format.height;
  codes.width = format.width;
  return codes;
}

Camera read_camera(const Members& members) {
  Camera camera;
  camera.fx = static_cast<float>(members.real("fx"));
  camera.fy = static_cast<float>(members.real("fy"));
  camera.cx = static_cast<float>(members.real("cx"));
  camera.cy = static_cast<float>(members.real("cy"));
  const std::string name = members.name("cam_from_world");
  const Json::Array& rows = members.list("cam_from_world");
  if (rows.size() != 3) fail(ErrorKind::kFormat, name, " has ", rows.size(), " rows, not 3");
  for (std::size_t row = 0; row < 3; ++row) {
    const Json::Array& values = rows[row].as_array(name);
    if (values.size() != 4)
      fail(ErrorKind::kFormat, name, " has a row of ", values.size(), " values");
    for (std::size_t column = 0; column < 4; ++column)
      camera.cam_from_world(static_cast<Eigen::Index>(row), static_cast<Eigen::Index>(column)) =
          static_cast<float>(values[column].as_double(name));
  }
  return camera;
}

// Why there is no field.json in the folder.
std::string why_no_field(const std::string& folder) {
  const std::string record = folder + "/run.json";
  std::error_code ignored;
  if (!fs::exists(record, ignored)) return "it is not a folder that lift_video wrote";
  const Json run = Json::read(record);
  const Json* tool = run.find("tool");
  const Json* status = run.find("status");
  if (tool == nullptr || !tool->is_string() || status == nullptr || !status->is_string())
    return "its run.json is not a record of lift_video";
  const std::string& name = tool->as_string("tool");
  if (name != "lift_video") return "it was written by " + name + ", not by lift_video";
  return "the run is \"" + status->as_string("status") +
         "\" or of an earlier version; lift_video --resume or --force completes it";
}

}  // namespace

std::string field_json(const FieldFormat& format) {
  JsonWriter json;
  json.begin_object();
  json.field("format_version", 1);
  json.field("kind", "lifted field");
  json.field("frames", format.num_frames);
  json.field("every", format.every);
  json.field("width", format.width);
  json.field("height", format.height);
  json.key("files");
  json.begin_object();
  json.field("frames", format.has_frames);
  json.field("depth", format.has_depth);
  json.field("confidence", format.has_confidence);
  json.end_object();
  write_codes_format(json, codes_folder(CodesKind::kLanguage), format.language);
  write_codes_format(json, codes_folder(CodesKind::kState), format.states);
  json.end_object();
  return json.take();
}

LiftedField LiftedField::open(const std::string& folder) {
  std::error_code error;
  if (!fs::is_directory(folder, error))
    fail(ErrorKind::kRead, folder,
         ": there is no such folder; a lifted field is what lift_video writes");
  LiftedField field;
  field.path_ = folder;
  if (!fs::exists(folder + "/" + kFieldFile, error))
    fail(ErrorKind::kFormat, folder, ": is no lifted field (there is no ", kFieldFile,
         "): ", why_no_field(folder));
  field.read_format();
  field.read_cameras();
  field.check_files();
  return field;
}

void LiftedField::read_format() {
  constexpr std::int64_t kMany = std::int64_t{1} << 40;
  constexpr std::int64_t kMostPixels = 16384;  // on a side, as of a stream
  const std::string name = path_ + "/" + kFieldFile;
  const Json json = Json::read(name);
  const Members field(json, name);
  if (field.number("format_version", 0, kMany) != 1)
    fail(ErrorKind::kUnsupported, name, ": was written by another version of lift_video");
  if (field.text("kind") != "lifted field")
    fail(ErrorKind::kFormat, name, ": its kind is \"", field.text("kind"),
         "\", not \"lifted field\"");
  format_.num_frames = field.number("frames", 1, kMany);
  format_.every = field.number("every", 1, kMany);
  format_.width = field.number("width", 1, kMostPixels);
  format_.height = field.number("height", 1, kMostPixels);
  const Members files = field.object("files");
  format_.has_frames = files.flag("frames");
  format_.has_depth = files.flag("depth");
  format_.has_confidence = files.flag("confidence");
  format_.language = read_codes_format(field, CodesKind::kLanguage, format_);
  format_.states = read_codes_format(field, CodesKind::kState, format_);
}

void LiftedField::read_cameras() {
  const std::string name = path_ + "/cameras.json";
  const Json json = Json::read(name);
  const Members cameras(json, name);
  const Json::Array& list = cameras.list("frames");
  LVGGT_CHECK(static_cast<std::int64_t>(list.size()) == format_.num_frames, name, ": has ",
              list.size(), " frames, but ", kFieldFile, " says ", format_.num_frames);
  for (std::size_t i = 0; i < list.size(); ++i) {
    const Members frame(list[i], concat(name, ": frame ", i));
    const auto index = static_cast<std::int64_t>(i);
    LVGGT_CHECK(frame.number("index", 0, format_.num_frames) == index, frame.name("index"), " is ",
                frame.number("index", 0, format_.num_frames));
    if (index % format_.every != 0) continue;
    CameraRecord record;
    record.index = index;
    record.source_index = frame.at("source_index").as_int64(frame.name("source_index"));
    record.name = frame.text("name");
    record.timestamp = frame.real("timestamp");
    record.camera = read_camera(frame.object("model"));
    frames_.push_back(std::move(record));
  }
}

void LiftedField::check_files() const {
  std::error_code ignored;
  for (const CodesKind kind : {CodesKind::kLanguage, CodesKind::kState}) {
    if (!has_codes(kind)) continue;
    for (std::int64_t i = 0; i < num_frames(); ++i) {
      const std::string name = file(codes_folder(kind), i, ".safetensors");
      if (!fs::exists(name, ignored))
        fail(ErrorKind::kRead, name, ": is missing, though ", kFieldFile, " says that frame ",
             frames_[static_cast<std::size_t>(i)].index,
             " has codes; lift_video --force makes it again");
    }
  }
}

std::string LiftedField::file(const std::string& folder, std::int64_t i,
                              const std::string& ending) const {
  LVGGT_CHECK(i >= 0 && i < num_frames(), path_, ": there is no frame ", i, " among ",
              num_frames());
  return path_ + "/" + folder + "/" + frame_stem(frames_[static_cast<std::size_t>(i)].index) +
         ending;
}

const CodesFormat& LiftedField::codes(CodesKind kind) const {
  const auto& found = codes_of(kind);
  const bool language = kind == CodesKind::kLanguage;
  LVGGT_CHECK(found.has_value(), path_, ": is a lifted field without ",
              language ? "semantics" : "states", ": lift the video again with ",
              language ? "--decoder" : "--state-decoder", " and without --no-codes");
  return *found;
}

Tensor<std::uint8_t, 3> LiftedField::read_picture(std::int64_t i) const {
  LVGGT_CHECK(has_pictures(), path_, ": has no frames; lift the video again without --no-frames");
  const std::string name = file("frames", i, ".png");
  Image image = load_image(name);
  LVGGT_CHECK(image.width() == width() && image.height() == height(), name, ": is ", image.width(),
              " x ", image.height(), ", but the field is ", width(), " x ", height());
  return std::move(image.pixels);
}

void LiftedField::read_depth(View<float, 2> depth, std::int64_t i) const {
  LVGGT_CHECK(format_.has_depth, path_, ": has no depth; lift the video again without --no-depth");
  read_depth_png(depth, file("depth", i, ".png"), file("depth", i, ".json"));
}

void LiftedField::read_confidence(View<float, 2> confidence, std::int64_t i) const {
  LVGGT_CHECK(format_.has_confidence, path_,
              ": has no confidence; lift the video again without --no-confidence");
  read_depth_png(confidence, file("confidence", i, ".png"), file("confidence", i, ".json"));
}

void LiftedField::read_codes(View<float, 4> values, CodesKind kind, std::int64_t i) const {
  const CodesFormat& format = codes(kind);
  lvggt::read_codes(values, file(codes_folder(kind), i, ".safetensors"), format,
                    frames_[static_cast<std::size_t>(i)].index);
}

}  // namespace lvggt
