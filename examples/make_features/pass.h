// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <string>
#include <utility>
#include <vector>

#include "examples/make_features/options.h"
#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/run_record.h"
#include "lvggt/data/scene.h"

// One folder of features, made frame by frame.
struct Pass {
  std::string folder;  // of the results
  std::vector<lvggt::cli::RunInput> inputs;
  std::vector<std::pair<std::string, std::string>> settings;  // what the results depend on
  // Makes FOLDER/NAME_f.npy and NAME_s.npy; returns a warning, or nothing.
  std::function<std::string(const lvggt::SceneFrame& frame, const std::string& stem)> make;
};

// Works through the frames whose files are not there yet. run.json in the folder says how it went.
// Returns the exit status.
int run_pass(const Pass& pass, const std::vector<lvggt::SceneFrame>& frames,
             const MakeFeaturesOptions& options, int threads,
             const std::vector<std::string>& arguments,
             const lvggt::cli::InterruptGuard& interrupt);

// One line on stderr.
void say(const std::string& line);
