// SPDX-License-Identifier: Apache-2.0
// Scores language fields by the published protocol and puts them beside the paper's figures.
#include <cstdio>
#include <filesystem>
#include <optional>

#include "examples/evaluate/pictures.h"
#include "examples/evaluate/protocol.h"
#include "examples/evaluate/report.h"
#include "examples/evaluate/run_spec.h"
#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/program.h"
#include "lvggt/cli/progress.h"
#include "lvggt/cli/threads.h"
#include "lvggt/io/atomic_file.h"

namespace evaluate {
namespace {

using namespace lvggt;

struct Options {
  RunSpec run;
  std::string plan, list, paraphrases, out;
  ReportOptions report;
  bool no_paper = false, json = false, csv = false, force = false, no_image_check = false;
  int threads = 0;
};

void say(const std::string& line) { std::fprintf(stderr, "evaluate: %s\n", line.c_str()); }

// What a folder of results holds.
const std::vector<std::string> kFiles{cli::kRunFile, "table.txt", "table.csv"};

std::vector<RunSpec> runs_of(Options& options) {
  if (!options.list.empty())
    for (std::string& scene : read_list_file(options.list))
      options.run.scenes.push_back(std::move(scene));
  for (std::string& scene : options.run.scenes) scene = cli::without_trailing_slashes(scene);
  if (!options.paraphrases.empty()) options.run.paraphrases = read_paraphrases(options.paraphrases);
  options.run.check_images = !options.no_image_check;
  std::vector<RunSpec> runs = options.plan.empty() ? std::vector<RunSpec>{options.run}
                                                   : read_plan(options.plan, options.run);
  for (const RunSpec& run : runs) run.check();
  return runs;
}

// The scene of one run; pictures go to the output folder, if there is one.
SceneResult score_scene(const Options& options, const RunSpec& run, const std::string& scene,
                        const std::string& stem, Encoders& encoders,
                        const cli::InterruptGuard& interrupt, Context& ctx) {
  std::optional<cli::Progress> progress;
  const auto step = [&](std::int64_t done, std::int64_t total) {
    if (!progress) progress.emplace(total);
    progress->show(done);
    if (interrupt.requested()) fail(ErrorKind::kInterrupted, "interrupted; nothing was written");
  };
  if (options.out.empty()) return evaluate_scene(run, scene, encoders, step, {}, ctx);
  const SceneAnnotations where =
      read_scene_annotations(scene, {Scene::open(scene).layout(), false});
  MaskSheet sheet(std::filesystem::path(where.coco_path).parent_path().string(),
                  run.method + ", " + std::filesystem::path(scene).filename().string());
  std::function<void(const FrameView&)> show;
  if (run.check_images) show = [&](const FrameView& view) { sheet.add(view); };
  SceneResult result = evaluate_scene(run, scene, encoders, step, show, ctx);
  sheet.write(stem + "_masks.png");
  write_time_lines(stem + "_states.png", result);
  return result;
}

// Makes the folder ready; numbered pictures of an earlier run go.
void open_output(const Options& options) {
  const bool earlier = cli::check_output_folder(
      options.out, options.force ? cli::Existing::kReplace : cli::Existing::kRefuse);
  cli::create_output_folder(options.out);
  if (!earlier) return;
  cli::remove_unfinished_files(options.out);
  std::vector<std::string> files = kFiles;
  for (const auto& entry : std::filesystem::directory_iterator(options.out)) {
    const std::string name = entry.path().filename().string();
    if (name.ends_with("_masks.png") || name.ends_with("_states.png")) files.push_back(name);
  }
  cli::remove_earlier_run(options.out, files, {});
}

void print(const std::string& text) {
  if (std::fwrite(text.data(), 1, text.size(), stdout) != text.size() || std::fflush(stdout) != 0)
    fail(ErrorKind::kWrite, "standard output: cannot be written");
}

int run(Options& options) {
  options.out = cli::without_trailing_slashes(options.out);
  options.report.paper = !options.no_paper;
  const cli::InterruptGuard interrupt;
  const std::vector<RunSpec> runs = runs_of(options);
  if (!options.out.empty()) open_output(options);
  Context ctx(cli::choose_threads(options.threads).threads);
  Encoders encoders;
  std::vector<RunResult> results;
  for (const RunSpec& spec : runs) {
    results.push_back({spec, {}});
    for (const std::string& path : spec.scenes) {
      const std::string scene = cli::without_trailing_slashes(path);
      const std::string name = std::filesystem::path(scene).filename().string();
      const std::string stem = concat(options.out, "/", results.size(), "_", name);
      results.back().scenes.push_back(
          score_scene(options, spec, scene, stem, encoders, interrupt, ctx));
      const SceneResult& scored = results.back().scenes.back();
      say(concat(spec.method, ", ", name, ": ", scored.frames, " annotated frames in ",
                 cli::fixed(scored.seconds, 1), " s"));
    }
  }
  const std::string text = report_text(results, options.report);
  print(options.json  ? report_json(results, LVGGT_VERSION)
        : options.csv ? report_csv(results, options.report)
                      : text);
  if (options.out.empty()) return 0;
  const ReportOptions everything{true, true, true};
  write_file(options.out + "/table.txt", text);
  write_file(options.out + "/table.csv", report_csv(results, everything));
  write_file(options.out + "/" + cli::kRunFile, report_json(results, LVGGT_VERSION));
  say(options.out + ": table.txt, table.csv, run.json, masks and time lines as pictures");
  return 0;
}

void add_model_options(cli::Program& program, Options& options) {
  CLI::App& app = program.app();
  RunSpec& run = options.run;
  const std::string ours = "Our model", theirs = "Any other method", words = "Words";
  const auto path = [&](const char* name, std::string& value, const char* text,
                        const std::string& group, const char* type = "FILE") {
    app.add_option(name, value, text)->type_name(type)->group(group);
  };
  path("--text-encoder", run.text_encoder,
       "CLIP folder, or .npy of precomputed phrases with their list", words);
  path("--sentence-encoder", run.sentence_encoder, "The same for the state sentences", words);
  path("--autoencoder", run.autoencoder, "From the codes to the phrases' space", words);
  path("--state-autoencoder", run.state_autoencoder, "From the dynamic codes to the sentences'",
       words);
  path("--paraphrases", options.paraphrases,
       "JSON {phrase: [other wordings]}: they are asked too and scored in a row of their own",
       words);
  path("--decoder", run.decoder, "Decoder of the time-agnostic codes", ours);
  path("--state-decoder", run.state_decoder, "Decoder of the dynamic codes", ours);
  path("--config", run.config, "Configuration, if the decoders' metadata have none", ours);
  path("--tokens", run.tokens, "Tokens that make_tokens wrote; else <scene>/lvggt_tokens", ours,
       "DIR");
  path("--state-tokens", run.state_tokens, "Those of the state decoder, if they are others", ours,
       "DIR");
  path("--weights", run.weights, "Geometry weights, to make the tokens on the way", ours);
  app.add_option("--mode", run.mode, "How a picture becomes a model frame, with --weights")
      ->check(CLI::IsMember({"crop", "pad", "original"}))
      ->capture_default_str()
      ->group(ours);
  program.add_number("--size", run.size, "Its width or longest side, with --weights", 14, 14336)
      ->default_str("the model's")
      ->group(ours);
  program
      .add_number("--max-past-frames", run.max_past_frames, "Frames that are seen, with --weights",
                  std::int64_t{1}, std::int64_t{1'000'000})
      ->group(ours);
  app.add_flag("--stretched", run.stretched,
               "The decoders were trained with --target original: their maps cover the picture")
      ->group(ours);
  path("--field", run.field, "What lift_video left of the scene's frames, instead of a decoder",
       ours, "DIR");
  app.add_option("--renders", run.renders,
                 "Folder of a level's feature maps, [H, W, d] .npy a frame (renders_npy); once a "
                 "level")
      ->type_name("DIR")
      ->group(theirs);
  path("--state-renders", run.state_renders, "The same for the dynamic features", theirs, "DIR");
}

void add_options(cli::Program& program, Options& options) {
  CLI::App& app = program.app();
  app.add_option("scenes", options.run.scenes, "Annotated scenes")->type_name("SCENE");
  app.add_option("--list", options.list, "File that names more scenes, one a line")
      ->type_name("FILE");
  app.add_option("--method", options.run.method, "Name of the row in the tables")
      ->capture_default_str();
  app.add_option("--regime", options.run.regime, "What the row says about the models");
  app.add_option("--plan", options.plan,
                 "JSON list of runs, a row each, with the options' names as members; the options "
                 "given here are what a run does not say")
      ->type_name("FILE");
  add_model_options(program, options);
  app.add_flag("--all-polygons", options.run.all_polygons,
               "All polygons of an annotation count, not the first only as published");
  app.add_flag("--no-image-check", options.no_image_check,
               "Do not ask for the annotated pictures to be there");
  app.add_flag("--per-phrase", options.report.per_phrase, "Scores of each phrase and sentence");
  app.add_flag("--per-frame", options.report.per_frame, "And of each frame");
  app.add_flag("--no-paper", options.no_paper, "Without the paper's own figures");
  CLI::Option* json = app.add_flag("--json", options.json, "Print JSON instead of the tables");
  app.add_flag("--csv", options.csv, "Print CSV instead of the tables")->excludes(json);
  app.add_option("--out", options.out,
                 "Folder for the tables in every form and for pictures of masks and time lines")
      ->type_name("DIR");
  app.add_flag("--force", options.force, "Replace an earlier run in that folder");
  cli::add_threads_option(program, options.threads);
  app.footer(
      "In every path {scene} stands for the folder name of the scene. docs/evaluate.md describes "
      "the protocol.\nExit status: 0 done, 1 failed, 2 wrong usage, 3 bad input, 4 memory, 130 "
      "interrupted.");
}

}  // namespace
}  // namespace evaluate

int main(int argc, char** argv) {
  lvggt::cli::Program program(
      "evaluate",
      "Scores language fields on annotated scenes by the published protocol: mIoU and mAcc of "
      "phrases, Acc and vIoU of states.\nOur model or any method's feature maps, several runs in "
      "one table.",
      LVGGT_VERSION);
  evaluate::Options options;
  evaluate::add_options(program, options);
  return program.run(argc, argv, [&] { return evaluate::run(options); });
}
