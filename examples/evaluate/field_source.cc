// SPDX-License-Identifier: Apache-2.0
#include "examples/evaluate/codes_source.h"
#include "lvggt/field/lifted_field.h"
#include "lvggt/io/json.h"

namespace evaluate {
namespace {

using namespace lvggt;

// How the pictures became model frames, from the field's cameras.json.
ImageTransform read_transform(const std::string& folder) {
  const std::string path = folder + "/cameras.json";
  const Json root = Json::read(path);
  const Json* json = root.find("transform");
  if (json == nullptr) fail(ErrorKind::kFormat, path, ": there is no \"transform\"");
  const auto member = [&](const char* key) -> const Json& {
    const Json* found = json->find(key);
    if (found == nullptr) fail(ErrorKind::kFormat, path, ": transform: there is no \"", key, "\"");
    return *found;
  };
  const auto whole = [&](const char* key) {
    return static_cast<int>(member(key).as_int64(concat(path, ": transform: ", key)));
  };
  const auto pair = [&](const char* key, double& x, double& y) {
    const std::string place = concat(path, ": transform: ", key);
    const Json::Array& values = member(key).as_array(place);
    LVGGT_CHECK(values.size() == 2, place, " has ", values.size(), " entries, not 2");
    x = values[0].as_double(place);
    y = values[1].as_double(place);
  };
  ImageTransform transform;
  transform.original_width = whole("original_width");
  transform.original_height = whole("original_height");
  transform.quarter_turns_ccw = whole("quarter_turns_ccw");
  transform.width = whole("model_width");
  transform.height = whole("model_height");
  pair("scale", transform.scale_x, transform.scale_y);
  pair("offset", transform.offset_x, transform.offset_y);
  return transform;
}

class FieldSource : public CodesSource {
 public:
  FieldSource(const std::string& folder, const Scene& scene)
      : scene_(scene), field_(LiftedField::open(folder)), transform_(read_transform(folder)) {
    const CodesFormat& format = field_.codes(CodesKind::kLanguage);
    codes_ = Tensor<float, 4>(format.shape());
    if (!has_states()) return;
    const CodesFormat& states = field_.codes(CodesKind::kState);
    LVGGT_CHECK(states.num_levels() == 1, folder, ": its dynamic codes have ", states.num_levels(),
                " levels, not one");
    states_ = Tensor<float, 4>(states.shape());
  }

  bool has_states() const override { return field_.has_codes(CodesKind::kState); }

  void read(FrameCodes& codes, std::int64_t frame, std::int64_t H, std::int64_t W) override {
    const std::int64_t i = position(frame_of(scene_, frame));
    const Shape maps{codes_.extent(0), H, W, codes_.extent(3)};
    if (codes.language.shape() != maps) codes.language = Tensor<float, 4>(maps);
    field_.read_codes(codes_, CodesKind::kLanguage, i);
    for (std::int64_t level = 0; level < maps[0]; ++level)
      resample_to_picture(codes.language[level], codes_[level], transform_);
    if (!has_states()) return;
    const Shape map{H, W, states_.extent(3)};
    if (codes.states.shape() != map) codes.states = Tensor<float, 3>(map);
    field_.read_codes(states_, CodesKind::kState, i);
    resample_to_picture(codes.states, states_[0], transform_);
  }

 private:
  // Which of the field's frames a picture of the scene became.
  std::int64_t position(const SceneFrame& frame) const {
    const auto index = &frame - scene_.frames().data();
    for (std::int64_t i = 0; i < field_.num_frames(); ++i)
      if (field_.frames()[static_cast<std::size_t>(i)].source_index == index) return i;
    fail(ErrorKind::kMismatch, field_.path(), ": frame ", frame.name,
         " is annotated, but was not lifted");
  }

  const Scene& scene_;
  LiftedField field_;
  ImageTransform transform_;
  Tensor<float, 4> codes_, states_;
};

}  // namespace

std::unique_ptr<CodesSource> open_field(const std::string& folder, const Scene& scene) {
  return std::make_unique<FieldSource>(folder, scene);
}

}  // namespace evaluate
