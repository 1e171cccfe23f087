// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "examples/evaluate/protocol.h"

namespace evaluate {

// A run and what it scored, scene by scene.
struct RunResult {
  RunSpec run;
  std::vector<SceneResult> scenes;
};

struct ReportOptions {
  bool per_phrase = false, per_frame = false;
  bool paper = true;  // the paper's own figures below
};

// The tables for people: a row a run, a column a scene and the average, in percent.
std::string report_text(const std::vector<RunResult>& runs, const ReportOptions& options);

// One line for each number: method, regime, scene, task, phrase, wording, frame, metric, value.
// Averages leave the columns empty that they go over. Values are not in percent.
std::string report_csv(const std::vector<RunResult>& runs, const ReportOptions& options);

// Everything, with series and intervals.
std::string report_json(const std::vector<RunResult>& runs, const std::string& version);

}  // namespace evaluate
