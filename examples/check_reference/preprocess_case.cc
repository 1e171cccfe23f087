// SPDX-License-Identifier: Apache-2.0
#include <utility>

#include "examples/check_reference/cases.h"

namespace check_reference {

using namespace lvggt;

void check_preprocess(Comparison& comparison) {
  const Safetensors& file = comparison.file();
  for (const TensorEntry& entry : file.entries()) {
    const std::string suffix = ".image_u8";
    if (!entry.name.ends_with(suffix) || entry.shape.size() != 3) continue;
    comparison.accept(entry.name);
    const std::string image_name = entry.name.substr(0, entry.name.size() - suffix.size());
    Tensor<std::uint8_t, 3> bytes(Shape{entry.shape[0], entry.shape[1], entry.shape[2]});
    file.read_bytes(entry, std::as_writable_bytes(std::span(bytes.data(), bytes.num_bytes())));
    const Image image = image_from_pixels(std::as_const(bytes).view());
    for (const FrameMode mode :
         {FrameMode::kCrop, FrameMode::kPad, FrameMode::kOriginal, FrameMode::kGt}) {
      const std::string name = image_name + "." + std::string(frame_mode_name(mode));
      if (!comparison.wants(name + ".tensor")) continue;
      // The release turns landscape pictures to portrait in these two modes.
      const bool turns = mode == FrameMode::kOriginal || mode == FrameMode::kGt;
      const PreparedFrame frame = prepare_frame(image, {.mode = mode, .rotate_to_portrait = turns});
      const auto [H, W, C] = frame.pixels.shape();
      std::vector<float> planes;
      for (std::int64_t c = 0; c < C; ++c)
        for (std::int64_t i = 0; i < H * W; ++i) planes.push_back(frame.pixels.data()[i * C + c]);
      comparison.compare(name + ".tensor", planes);
      std::int64_t width = image.width(), height = image.height();
      if (frame.transform.quarter_turns_ccw == 1) std::swap(width, height);
      comparison.compare(name + ".width_height", std::vector<std::int64_t>{width, height});
    }
  }
}

}  // namespace check_reference
