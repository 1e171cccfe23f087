// SPDX-License-Identifier: Apache-2.0
// Asks a lifted video in words: where is it, and when does it happen?
#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <string>

#include "examples/query_video/interactive.h"
#include "examples/query_video/lift_first.h"
#include "examples/query_video/options.h"
#include "examples/query_video/session.h"
#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/memory_check.h"
#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/progress.h"
#include "lvggt/cli/run_record.h"
#include "lvggt/field/run_writer.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/model/stage_times.h"

namespace query_video {
namespace {

using namespace lvggt;
namespace fs = std::filesystem;

void say(const std::string& line) { std::fprintf(stderr, "query_video: %s\n", line.c_str()); }

// Whether a name is one of ours: a number, an underscore and the words that were asked.
bool is_answer(const std::string& name) {
  const std::size_t digits = name.find_first_not_of("0123456789");
  return digits >= 3 && (digits == std::string::npos || name[digits] == '_');
}

// Checks the output folder; a run of another program in it is never replaced.
void check_folder(const Options& o) {
  if (!cli::check_output_folder(o.out, o.force ? cli::Existing::kReplace : cli::Existing::kRefuse))
    return;
  const std::string path = o.out + "/" + cli::kRunFile;
  const Json record = Json::read(path);
  const Json* tool = record.find("tool");
  if (tool == nullptr || !tool->is_string() || tool->as_string(path) != "query_video")
    fail(ErrorKind::kUsage, o.out, ": holds what another program wrote; choose another folder");
}

void remove_earlier_answers(const std::string& out) {
  std::vector<std::string> folders,
      files{"answers.json", "answers.png", "time_lines.png", cli::kRunFile};
  std::error_code error;
  for (const auto& entry : fs::directory_iterator(out, error)) {
    const std::string name = entry.path().filename().string();
    if (!is_answer(entry.path().stem().string())) continue;
    (entry.is_directory(error) ? folders : files).push_back(name);
  }
  for (const std::string& folder : folders) {
    cli::remove_earlier_run(out + "/" + folder, {}, {"mask", "heat", "points"});
    cli::remove_earlier_run(out, {folder}, {});
  }
  cli::remove_earlier_run(out + "/" + kLiftedFolder, run_files(), run_folders());
  files.push_back(kLiftedFolder);
  cli::remove_earlier_run(out, files, {});
  cli::remove_unfinished_files(out);
}

void open_folder(const Options& o) {
  cli::create_output_folder(o.out);
  if (o.force) remove_earlier_answers(o.out);
}

cli::RunRecord make_record(const Options& o, const Session& session, int threads, int argc,
                           char** argv) {
  cli::RunRecord record;
  record.tool = "query_video";
  record.version = LVGGT_VERSION;
  record.arguments.assign(argv + 1, argv + argc);
  for (const auto& [role, path] : {std::pair{"field", o.field},
                                   {"text_encoder", o.text_encoder},
                                   {"autoencoder", o.autoencoder},
                                   {"sentence_encoder", o.sentence_encoder},
                                   {"state_autoencoder", o.state_autoencoder}})
    if (!path.empty()) record.inputs.push_back(cli::describe_input(role, path, false));
  record.settings = {{"text_encoder", session.text_encoder().describe()},
                     {"min_score", cli::fixed(o.min_score, 3)},
                     {"box", concat(o.protocol.box)},
                     {"majority", concat(o.protocol.majority)},
                     {"threshold", cli::fixed(static_cast<double>(o.protocol.threshold), 3)},
                     {"every", concat(o.every)}};
  if (session.sentence_encoder() != nullptr)
    record.settings.emplace_back("sentence_encoder", session.sentence_encoder()->describe());
  record.expected_frames = static_cast<std::int64_t>(session.clip().frames.size());
  record.threads = threads;
  return record;
}

std::string answers_json(const Options& o, const Session& session,
                         const std::vector<Result>& results) {
  JsonWriter json;
  json.begin_object();
  json.field("format_version", 1);
  json.field("field", o.field);
  json.field("text_encoder", session.text_encoder().describe());
  if (session.sentence_encoder() != nullptr)
    json.field("sentence_encoder", session.sentence_encoder()->describe());
  json.field("frames", session.clip().frames.size());
  write_results(json, results, session.clip());
  json.end_object();
  return json.take();
}

void print_plan(const Options& o, const Session& session) {
  const LiftedField& field = session.field();
  std::printf("field         %s: %zu frames of %lld x %lld\n", o.field.c_str(),
              session.clip().frames.size(), static_cast<long long>(field.width()),
              static_cast<long long>(field.height()));
  for (const CodesKind kind : {CodesKind::kLanguage, CodesKind::kState})
    if (field.has_codes(kind))
      std::printf("%-13s %lld levels of %lld values\n", codes_folder(kind),
                  static_cast<long long>(field.codes(kind).num_levels()),
                  static_cast<long long>(field.codes(kind).dim));
  std::printf("questions     %lld\n", static_cast<long long>(o.questions.size()));
  std::printf("phrases by    %s\n", session.text_encoder().describe().c_str());
  std::printf(
      "memory        about %s, with the encoders and autoencoders\n",
      cli::bytes_text(cli::resident_bytes() + session.planned_bytes(o.questions.size())).c_str());
}

void check_plan(const Options& o, const Session& session) {
  const std::size_t held = cli::resident_bytes();
  const std::size_t answers = session.planned_bytes(o.interactive ? 1 : o.questions.size());
  cli::check_memory(held + answers, cli::memory_limit(o.memory_limit, held),
                    concat(cli::bytes_text(held), " with the encoders and autoencoders, ",
                           cli::bytes_text(answers), " for the answers"),
                    {});
}

int answer_all(const Options& o, Session& session, const cli::ThreadChoice& threads, Context& ctx,
               int argc, char** argv) {
  const cli::InterruptGuard interrupt;
  cli::RunRecord record = make_record(o, session, threads.threads, argc, argv);
  record.planned_bytes = cli::resident_bytes() + session.planned_bytes(o.questions.size());
  AnswerTarget target{
      o.out,
      {!o.no_masks, !o.no_heat, !o.no_ply && session.field().has_points(), !o.no_sheet},
      "answers.png",
      "time_lines.png"};
  const auto warn = [&](const std::string& warning) {
    record.warnings.push_back(warning);
    say("warning: " + warning);
  };
  if (!o.out.empty() && !o.no_ply && !session.field().has_points())
    warn(o.field + ": has no depth or no confidence, so there are no point clouds");
  if (!o.out.empty() && !session.field().has_pictures())
    warn(o.field + ": has no frames, so answers are painted on black");
  const auto save_record = [&](const std::string& status) {
    record.status = status;
    if (!o.out.empty()) write_file(o.out + "/" + cli::kRunFile, run_json(record));
  };
  save_record("running");
  cli::Progress progress(record.expected_frames);
  const Hooks hooks{[&] { return interrupt.requested(); },
                    [&](std::int64_t done) {
                      record.frames = done;
                      progress.show(done);
                    },
                    warn};
  double seconds = 0;
  std::vector<Result> results;
  try {
    const StageTimer timer(seconds);
    results = session.ask(o.questions, target, hooks, ctx);
  } catch (const Error& error) {
    record.error = error.what();
    save_record(error.kind() == ErrorKind::kInterrupted ? "interrupted" : "failed");
    throw;
  }
  progress.clear();
  record.seconds = {{"answer", seconds}};
  const std::string json = answers_json(o, session, results);
  if (!o.out.empty()) write_file(o.out + "/answers.json", json);
  save_record("complete");
  if (o.json)
    std::fputs(json.c_str(), stdout);
  else
    for (const Result& result : results)
      std::printf("%s\n", sentence_about(result, session.clip()).c_str());
  say(concat(results.size(), results.size() == 1 ? " answer" : " answers", " about ", record.frames,
             " frames in ", cli::fixed(seconds, 2), " s",
             o.out.empty() ? "" : ", pictures and answers.json in " + o.out));
  return 0;
}

int run(Options& o, int argc, char** argv) {
  o.settle();
  o.field = cli::without_trailing_slashes(o.field);
  o.out = cli::without_trailing_slashes(o.out);
  if (!o.out.empty() && !o.dry_run) check_folder(o);
  const cli::ThreadChoice threads = cli::choose_threads(o.threads);
  Context ctx(threads.threads);
  if (!o.weights.empty()) {
    lift_first(
        o, o.out + "/" + kLiftedFolder, [&] { open_folder(o); }, ctx);
    o.field = o.out + "/" + kLiftedFolder;
  }
  Session session(o, ctx);
  if (o.dry_run) print_plan(o, session);
  check_plan(o, session);
  if (o.dry_run) return 0;
  if (!o.out.empty() && o.weights.empty()) open_folder(o);
  if (!o.interactive) return answer_all(o, session, threads, ctx, argc, argv);
  if (!o.out.empty()) {
    cli::RunRecord record = make_record(o, session, threads.threads, argc, argv);
    record.status = "interactive";
    write_file(o.out + "/" + cli::kRunFile, run_json(record));
  }
  const std::size_t held = cli::resident_bytes();
  const std::size_t limit = cli::memory_limit(o.memory_limit, held).bytes;
  return converse(session, o.out, limit - std::min(limit, held), ctx);
}

}  // namespace
}  // namespace query_video

int main(int argc, char** argv) {
  lvggt::cli::Program program(
      "query_video",
      "Asks a lifted video in words: where a phrase is in every frame, and when a state holds.",
      LVGGT_VERSION);
  query_video::Options options;
  query_video::add_options(program, options);
  return program.run(argc, argv, [&] { return query_video::run(options, argc, argv); });
}
