// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "lvggt/io/json.h"
#include "lvggt/io/npy.h"
#include "lvggt/model/deterministic_weights.h"
#include "tests/support/child_process.h"
#include "tests/support/files.h"
#include "tests/support/paths.h"
#include "tests/support/tiny_scene.h"

namespace lvggt::test {

struct TrainResult {
  int status = 0;
  std::string out, err;
  bool says(const std::string& text) const { return err.find(text) != std::string::npos; }
};

// A tiny scene with tokens, and the train_decoder program to train on it. Codes are the same in all
// frames, but for the state of object 0, which changes after the sixth.
class TrainingScene : public TinyScene {
 public:
  explicit TrainingScene(int num_frames = 12) : TinyScene(num_frames) {
    for (const SupervisionSpec& spec : specs())
      for (int i = 0; i < num_frames; ++i) {
        Tensor<float, 2> codes(Shape{std::int64_t{4}, spec.dim});
        for (std::int64_t row = 0; row < 4; ++row) {
          const std::int64_t kind =
              row == 0 && i >= 6 && spec.kind == Supervision::kDynamic ? 4 : row;
          codes(row, kind % spec.dim) = 1;
          codes(row, (kind + 1) % spec.dim) = kind < 3 ? 0.0F : 0.5F;
        }
        write_npy(label_file(i, "f", spec), codes);
      }
    // Tokens without any pattern, so that frames differ in their statistics.
    const TokenManifest manifest = make_tokens();
    for (const TokenFrame& frame : manifest.frames) {
      std::array<Tensor<float, 2>, 4> taps;
      for (std::size_t tap = 0; tap < 4; ++tap) {
        taps[tap] = Tensor<float, 2>(Shape{manifest.h() * manifest.w(), manifest.channels()});
        deterministic_uniform(frame.name + std::to_string(tap), 1, -1, 1,
                              {taps[tap].data(), static_cast<std::size_t>(taps[tap].size())});
      }
      write_tokens(tokens(), frame, {taps[0], taps[1], taps[2], taps[3]}, Dtype::kF32);
    }
  }

  // Trains into the folder `out` inside the scene's, eight frames with four held out.
  std::vector<std::string> command(const std::string& out,
                                   const std::vector<std::string>& more = {}) const {
    std::vector<std::string> argv{program("train_decoder"),
                                  path(),
                                  "--config",
                                  test_data("golden/config_tiny.json"),
                                  "--held-out-frames",
                                  "5-8",
                                  "--batch",
                                  "4",
                                  "--threads",
                                  "2",
                                  "--output",
                                  *this / out};
    for (const auto& [option, value] :
         std::map<std::string, std::string>{{"--steps", "12"},
                                            {"--learning-rate", "1e-3"},
                                            {"--warmup-steps", "3"},
                                            {"--evaluate-every", "6"},
                                            {"--checkpoint-every", "3"}}) {
      if (std::find(more.begin(), more.end(), option) != more.end()) continue;
      argv.push_back(option);
      argv.push_back(value);
    }
    argv.insert(argv.end(), more.begin(), more.end());
    return argv;
  }

  TrainResult train(const std::string& out, const std::vector<std::string>& more = {},
                    rlim_t max_file_bytes = RLIM_INFINITY) const {
    ChildProcess child(command(out, more), max_file_bytes);
    const int status = child.wait();
    return {status, child.out(), child.err()};
  }

  std::string bytes(const std::string& name) const { return read_bytes(*this / name); }
  Json json(const std::string& name) const { return Json::read(*this / name); }

  // The newest checkpoint of a run.
  std::string newest_checkpoint(const std::string& out) const {
    std::string newest;
    for (const auto& file : std::filesystem::directory_iterator(*this / (out + "/checkpoints"))) {
      const std::string name = file.path().filename().string();
      if (name.starts_with("step_") && name.ends_with(".safetensors") && name > newest)
        newest = name;
    }
    return out + "/checkpoints/" + newest;
  }
};

}  // namespace lvggt::test
