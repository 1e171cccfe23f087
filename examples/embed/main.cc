// SPDX-License-Identifier: Apache-2.0
// embed VIDEO_OR_FOLDER [GEOMETRY [DECODER]]: each frame's camera, and what is in its middle.
#include <lvggt/io/video.h>
#include <lvggt/lvggt.h>

#include <cstdio>
#include <string>

int main(int argc, char** argv) try {
  if (argc < 2) lvggt::fail(lvggt::ErrorKind::kUsage, "give a video or folder (and weights)");
  const std::string weights = argc > 2 ? argv[2] : SMALL_MODEL;  // from CMakeLists.txt
  if (argc == 2) {
    lvggt::check_bundled_file(lvggt::kSmallModel, weights);
    std::fprintf(stderr, "embed: no weights given: using the bundled small model\n");
  }
  lvggt::Context ctx;  // all CPUs this process may use
  const auto model =
      lvggt::LangVggt::load({.weights = weights, .decoder = argc > 3 ? argv[3] : ""}, ctx);
  const lvggt::PreprocessOptions size{.size = static_cast<int>(model.config().img_size)};

  lvggt::Stream stream(model, ctx, {.max_past_frames = 8});
  const auto frames = lvggt::open_frames(argv[1], {}, lvggt::open_video);
  while (const auto input = frames->next()) {
    const lvggt::PreparedFrame prepared = lvggt::prepare_frame(input->image, size);
    const lvggt::Frame frame = stream.push(prepared.pixels);  // views live until the next push

    const auto [H, W] = frame.depth.shape();
    const auto& pose = frame.camera.cam_from_world;  // [R | t], OpenCV axes
    std::printf("%6.2f s  t (%.3f %.3f %.3f)  depth %.3f", input->timestamp, pose(0, 3), pose(1, 3),
                pose(2, 3), frame.depth(H / 2, W / 2));
    if (model.has_decoder()) {
      const auto meaning = frame.language[0][H / 2][W / 2];  // [lang_dim], smallest level
      std::printf("  semantics (%.3f %.3f %.3f)", meaning(0), meaning(1), meaning(2));
    }
    std::printf("\n");
  }
} catch (const lvggt::Error& error) {
  std::fprintf(stderr, "embed: %s\n", error.what());
  return lvggt::exit_code(error.kind());
}
