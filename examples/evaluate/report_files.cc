// SPDX-License-Identifier: Apache-2.0
#include "examples/evaluate/paper.h"
#include "examples/evaluate/report.h"
#include "lvggt/io/json_writer.h"

namespace evaluate {
namespace {

using namespace lvggt;

std::string csv_cell(const std::string& text) {
  if (text.find_first_of(",\"\n\r") == std::string::npos) return text;
  std::string quoted = "\"";
  for (const char c : text) quoted += c == '"' ? "\"\"" : std::string(1, c);
  return quoted + '"';
}

class Csv {
 public:
  Csv() { text_ = "method,regime,scene,task,phrase,wording,frame,metric,value\n"; }

  void set_run(const RunSpec& run, const std::string& scene) {
    prefix_ = csv_cell(run.method) + ',' + csv_cell(run.regime_text()) + ',' + csv_cell(scene);
  }
  void add(const char* task, const std::string& phrase, const std::string& wording,
           const std::string& frame, const char* metric, double value) {
    text_ += prefix_ + ',' + task + ',' + csv_cell(phrase) + ',' + csv_cell(wording) + ',' + frame +
             ',' + metric + ',';
    append_number(text_, value);
    text_ += '\n';
  }
  std::string take() { return std::move(text_); }

 private:
  std::string text_, prefix_;
};

void add_means(Csv& csv, const SceneResult& scene) {
  for (const bool paraphrased : {false, true}) {
    const auto means = scene.means(paraphrased);
    const std::string wording = paraphrased ? "in other words" : "";
    if (means.masks) {
      csv.add("time-agnostic", "", wording, "", "mIoU", means.masks->iou);
      csv.add("time-agnostic", "", wording, "", "mAcc", means.masks->accuracy);
    }
    if (means.accuracy) {
      csv.add("time-sensitive", "", wording, "", "Acc", *means.accuracy);
      csv.add("time-sensitive", "", wording, "", "vIoU", *means.viou);
    }
  }
}

void add_phrase(Csv& csv, const PhraseResult& phrase, bool per_frame) {
  csv.add("time-agnostic", phrase.phrase, phrase.wording, "", "IoU", phrase.score.iou());
  csv.add("time-agnostic", phrase.phrase, phrase.wording, "", "accuracy", phrase.score.accuracy());
  for (const MaskScore& frame : phrase.score.frames) {
    if (!per_frame) return;
    const std::string index = std::to_string(frame.frame);
    csv.add("time-agnostic", phrase.phrase, phrase.wording, index, "IoU", frame.iou);
    csv.add("time-agnostic", phrase.phrase, phrase.wording, index, "accuracy", frame.accuracy);
  }
}

void add_state(Csv& csv, const StateResult& state, bool per_frame) {
  const auto add = [&](const std::string& frame, const char* metric, double value) {
    csv.add("time-sensitive", state.sentence, state.wording, frame, metric, value);
  };
  add("", "Acc", state.score.accuracy);
  add("", "vIoU", state.score.viou);
  add("", "precision", state.score.precision);
  add("", "recall", state.score.recall);
  for (std::size_t i = 0; per_frame && i < state.frames.size(); ++i) {
    const std::string index = std::to_string(state.frames[i]);
    add(index, "similarity", state.answer.similarity[i]);
    add(index, "smoothed", state.answer.smoothed[i]);
    add(index, "called", state.answer.positive[i]);
    add(index, "true", state.truth[i]);
    add(index, "IoU", state.iou[i]);
  }
}

void write_phrase(JsonWriter& json, const PhraseResult& phrase) {
  json.begin_object();
  json.field("phrase", phrase.phrase);
  json.field("wording", phrase.wording);
  json.field("iou", phrase.score.iou());
  json.field("accuracy", phrase.score.accuracy());
  std::vector<std::int64_t> frames;
  std::vector<double> iou, accuracy;
  for (const MaskScore& frame : phrase.score.frames) {
    frames.push_back(frame.frame);
    iou.push_back(frame.iou);
    accuracy.push_back(frame.accuracy);
  }
  json.key("frames");
  json.numbers(frames);
  json.key("frame_iou");
  json.numbers(iou);
  json.key("frame_accuracy");
  json.numbers(accuracy);
  json.end_object();
}

void write_intervals(JsonWriter& json, const char* key, const std::vector<FrameInterval>& list) {
  json.key(key);
  json.begin_array();
  for (const FrameInterval& interval : list)
    json.numbers(std::vector<std::int64_t>{interval.first, interval.second});
  json.end_array();
}

void write_state(JsonWriter& json, const StateResult& state) {
  json.begin_object();
  json.field("object", state.object);
  json.field("sentence", state.sentence);
  json.field("wording", state.wording);
  json.field("acc", state.score.accuracy);
  json.field("viou", state.score.viou);
  json.field("precision", state.score.precision);
  json.field("recall", state.score.recall);
  json.field("threshold", state.answer.threshold);
  json.key("frames");
  json.numbers(state.frames);
  json.key("similarity");
  json.numbers(state.answer.similarity);
  json.key("smoothed");
  json.numbers(state.answer.smoothed);
  json.key("called");
  json.numbers(std::vector<int>(state.answer.positive.begin(), state.answer.positive.end()));
  json.key("true");
  json.numbers(std::vector<int>(state.truth.begin(), state.truth.end()));
  json.key("frame_iou");
  json.numbers(state.iou);
  write_intervals(json, "called_intervals",
                  positive_intervals(state.answer.positive, state.frames));
  write_intervals(json, "annotated_intervals", state.intervals);
  json.end_object();
}

void write_means(JsonWriter& json, const char* key, const SceneResult::Means& means) {
  if (!means.masks && !means.accuracy) return;
  json.key(key);
  json.begin_object();
  if (means.masks) {
    json.field("miou", means.masks->iou);
    json.field("macc", means.masks->accuracy);
  }
  if (means.accuracy) {
    json.field("acc", *means.accuracy);
    json.field("viou", *means.viou);
  }
  json.end_object();
}

void write_scene(JsonWriter& json, const SceneResult& scene) {
  json.begin_object();
  json.field("scene", scene.scene);
  json.field("annotated_frames", scene.frames);
  json.field("seconds", scene.seconds);
  write_means(json, "means", scene.means(false));
  write_means(json, "means_in_other_words", scene.means(true));
  json.key("phrases");
  json.begin_array();
  for (const PhraseResult& phrase : scene.phrases) write_phrase(json, phrase);
  json.end_array();
  json.key("states");
  json.begin_array();
  for (const StateResult& state : scene.states) write_state(json, state);
  json.end_array();
  json.key("notes");
  json.begin_array();
  for (const std::string& note : scene.notes) json.value(note);
  json.end_array();
  json.end_object();
}

void write_paper(JsonWriter& json, const char* key, std::span<const PaperRow> rows,
                 const char* first, const char* second) {
  json.key(key);
  json.begin_array();
  for (const PaperRow& row : rows) {
    json.begin_object();
    json.field("method", row.method);
    json.field(first, row.first / 100);
    json.field(second, row.second / 100);
    json.end_object();
  }
  json.end_array();
}

}  // namespace

std::string report_csv(const std::vector<RunResult>& runs, const ReportOptions& options) {
  Csv csv;
  for (const RunResult& run : runs)
    for (const SceneResult& scene : run.scenes) {
      csv.set_run(run.run, scene.scene);
      add_means(csv, scene);
      if (!options.per_phrase && !options.per_frame) continue;
      for (const PhraseResult& phrase : scene.phrases) add_phrase(csv, phrase, options.per_frame);
      for (const StateResult& state : scene.states) add_state(csv, state, options.per_frame);
    }
  return csv.take();
}

std::string report_json(const std::vector<RunResult>& runs, const std::string& version) {
  JsonWriter json;
  json.begin_object();
  json.field("format_version", 1);
  json.field("tool", "evaluate");
  json.field("version", version);
  json.key("runs");
  json.begin_array();
  for (const RunResult& run : runs) {
    json.begin_object();
    json.field("method", run.run.method);
    json.field("regime", run.run.regime_text());
    json.key("scenes");
    json.begin_array();
    for (const SceneResult& scene : run.scenes) write_scene(json, scene);
    json.end_array();
    json.end_object();
  }
  json.end_array();
  json.key("paper");
  json.begin_object();
  write_paper(json, "hypernerf_time_agnostic", kHyperNerfMasks, "miou", "macc");
  write_paper(json, "hypernerf_time_sensitive", kHyperNerfStates, "acc", "viou");
  write_paper(json, "neu3d_time_agnostic", kNeu3dMasks, "miou", "macc");
  json.end_object();
  json.end_object();
  return json.take();
}

}  // namespace evaluate
