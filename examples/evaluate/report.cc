// SPDX-License-Identifier: Apache-2.0
#include "examples/evaluate/report.h"

#include <algorithm>
#include <array>
#include <optional>

#include "examples/evaluate/paper.h"
#include "lvggt/cli/progress.h"

namespace evaluate {
namespace {

using namespace lvggt;

// A pair of scores; nothing where there are none.
using Pair = std::optional<std::array<double, 2>>;

std::string percent(double value) { return cli::fixed(100 * value, 2); }

std::string text_of(const Pair& pair) {
  return pair ? percent((*pair)[0]) + "/" + percent((*pair)[1]) : "-";
}

Pair masks_of(const SceneResult& scene, bool paraphrased) {
  const auto means = scene.means(paraphrased);
  if (!means.masks) return std::nullopt;
  return std::array<double, 2>{means.masks->iou, means.masks->accuracy};
}

Pair states_of(const SceneResult& scene, bool paraphrased) {
  const auto means = scene.means(paraphrased);
  if (!means.accuracy) return std::nullopt;
  return std::array<double, 2>{*means.accuracy, *means.viou};
}

Pair average(const std::vector<Pair>& pairs) {
  std::array<double, 2> sum{};
  double count = 0;
  for (const Pair& pair : pairs) {
    if (!pair) continue;
    sum[0] += (*pair)[0];
    sum[1] += (*pair)[1];
    ++count;
  }
  if (count == 0) return std::nullopt;
  return std::array<double, 2>{sum[0] / count, sum[1] / count};
}

// Rows of text in columns as wide as their widest entry.
class Table {
 public:
  void add(std::vector<std::string> row) { rows_.push_back(std::move(row)); }
  std::string text() const {
    std::vector<std::size_t> widths;
    for (const auto& row : rows_)
      for (std::size_t i = 0; i < row.size(); ++i) {
        if (i == widths.size()) widths.push_back(0);
        widths[i] = std::max(widths[i], row[i].size());
      }
    std::string text;
    for (const auto& row : rows_) {
      for (std::size_t i = 0; i < row.size(); ++i) {
        const std::string padding(widths[i] - row[i].size(), ' ');
        text += i == 0 ? row[i] + padding : "  " + padding + row[i];
      }
      text += '\n';
    }
    return text;
  }

 private:
  std::vector<std::vector<std::string>> rows_;
};

// All scenes of all runs, in order of appearance.
std::vector<std::string> scene_names(const std::vector<RunResult>& runs) {
  std::vector<std::string> names;
  for (const RunResult& run : runs)
    for (const SceneResult& scene : run.scenes)
      if (std::find(names.begin(), names.end(), scene.scene) == names.end())
        names.push_back(scene.scene);
  return names;
}

template <class Score>
void add_run(Table& table, const RunResult& run, const std::vector<std::string>& names,
             bool paraphrased, const Score& score) {
  std::vector<std::string> row{run.run.method + (paraphrased ? ", in other words" : "") + " (" +
                               run.run.regime_text() + ")"};
  std::vector<Pair> pairs;
  for (const std::string& name : names) {
    Pair pair;
    for (const SceneResult& scene : run.scenes)
      if (scene.scene == name) pair = score(scene, paraphrased);
    pairs.push_back(pair);
    row.push_back(text_of(pair));
  }
  const Pair mean = average(pairs);
  if (!mean) return;
  row.push_back(text_of(mean));
  table.add(std::move(row));
}

template <class Score>
std::string task_table(const std::vector<RunResult>& runs, const std::string& title,
                       const Score& score) {
  const std::vector<std::string> names = scene_names(runs);
  Table table;
  std::vector<std::string> header{title};
  header.insert(header.end(), names.begin(), names.end());
  header.push_back("average");
  table.add(std::move(header));
  for (const RunResult& run : runs)
    for (const bool paraphrased : {false, true}) add_run(table, run, names, paraphrased, score);
  return table.text();
}

std::string paper_table(const char* title, std::span<const PaperRow> rows) {
  Table table;
  table.add({title, "average"});
  for (const PaperRow& row : rows)
    table.add({row.method, cli::fixed(row.first, 2) + "/" + cli::fixed(row.second, 2)});
  return table.text();
}

std::string details(const RunResult& run, const ReportOptions& options) {
  Table table;
  table.add({run.run.method, "scene", "frames", "IoU", "accuracy"});
  for (const SceneResult& scene : run.scenes)
    for (const PhraseResult& phrase : scene.phrases) {
      table.add({"  \"" + phrase.wording + "\"", scene.scene,
                 std::to_string(phrase.score.frames.size()), percent(phrase.score.iou()),
                 percent(phrase.score.accuracy())});
      for (const MaskScore& frame : phrase.score.frames)
        if (options.per_frame)
          table.add(
              {"", "", std::to_string(frame.frame), percent(frame.iou), percent(frame.accuracy)});
    }
  Table states;
  states.add({run.run.method, "scene", "frames", "Acc", "vIoU", "precision", "recall"});
  bool any = false;
  for (const SceneResult& scene : run.scenes)
    for (const StateResult& state : scene.states) {
      any = true;
      states.add({"  \"" + state.wording + "\"", scene.scene, std::to_string(state.frames.size()),
                  percent(state.score.accuracy), percent(state.score.viou),
                  percent(state.score.precision), percent(state.score.recall)});
      for (std::size_t i = 0; options.per_frame && i < state.frames.size(); ++i)
        states.add({"", "", std::to_string(state.frames[i]),
                    cli::fixed(state.answer.smoothed[i], 4),
                    state.answer.positive[i] != 0 ? "called" : "-",
                    state.truth[i] != 0 ? "true" : "-", percent(state.iou[i])});
    }
  return table.text() + (any ? "\n" + states.text() : "");
}

// Whose scenes there are, so that the right figures of the paper stand below.
bool any_layout(const std::vector<RunResult>& runs, SceneLayout layout) {
  for (const RunResult& run : runs)
    for (const SceneResult& scene : run.scenes)
      if (scene.layout == layout) return true;
  return false;
}

bool any_states(const std::vector<RunResult>& runs) {
  for (const RunResult& run : runs)
    for (const SceneResult& scene : run.scenes)
      if (!scene.states.empty()) return true;
  return false;
}

}  // namespace

std::string report_text(const std::vector<RunResult>& runs, const ReportOptions& options) {
  std::string text = task_table(runs, "time-agnostic, mIoU/mAcc in %", masks_of);
  if (any_states(runs)) text += "\n" + task_table(runs, "time-sensitive, Acc/vIoU in %", states_of);
  if (options.paper) {
    if (any_layout(runs, SceneLayout::kHyperNerf)) {
      text += "\n" + paper_table("the paper on HyperNeRF's scenes, mIoU/mAcc", kHyperNerfMasks);
      if (any_states(runs))
        text += "\n" + paper_table("the paper on HyperNeRF's scenes, Acc/vIoU", kHyperNerfStates);
    }
    if (any_layout(runs, SceneLayout::kNeu3d))
      text += "\n" + paper_table("the paper on Neu3D's scenes, mIoU/mAcc", kNeu3dMasks);
  }
  if (options.per_phrase || options.per_frame)
    for (const RunResult& run : runs) text += "\n" + details(run, options);
  for (const RunResult& run : runs)
    for (const SceneResult& scene : run.scenes)
      for (const std::string& note : scene.notes)
        text += "\n" + run.run.method + ", " + scene.scene + ": " + note + "\n";
  return text;
}

}  // namespace evaluate
