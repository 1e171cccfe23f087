// SPDX-License-Identifier: Apache-2.0
#include "examples/make_features/pass.h"

#include <cstdio>
#include <filesystem>

#include "lvggt/cli/progress.h"

namespace {

using namespace lvggt;

constexpr std::size_t kMostWarnings = 20;

bool is_there(const std::string& path) {
  std::error_code ignored;
  return std::filesystem::exists(path, ignored);
}

// Features of an earlier run, whose frames may have been others.
void remove_features(const std::string& folder) {
  std::vector<std::filesystem::path> files;
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator(folder, error)) {
    const std::string name = entry.path().filename().string();
    if (name.ends_with("_s.npy") || name.ends_with("_f.npy")) files.push_back(entry.path());
  }
  for (const auto& file : files)
    if (!std::filesystem::remove(file, error) && error)
      fail(ErrorKind::kWrite, file.string(), ": cannot be removed: ", error.message());
}

// Makes what is missing; the record counts what is there.
void make_frames(const Pass& pass, const std::vector<SceneFrame>& frames, cli::RunRecord& record,
                 const cli::InterruptGuard& interrupt) {
  cli::Progress progress(static_cast<std::int64_t>(frames.size()));
  std::size_t warnings = 0;
  for (const SceneFrame& frame : frames) {
    if (interrupt.requested()) break;
    const std::string stem = pass.folder + "/" + frame.name;
    if (!is_there(stem + "_s.npy") || !is_there(stem + "_f.npy")) {
      std::string warning = pass.make(frame, stem);
      if (!warning.empty() && ++warnings <= kMostWarnings) record.warnings.push_back(warning);
    }
    progress.show(++record.frames);
  }
  if (warnings > kMostWarnings)
    record.warnings.push_back(concat(warnings - kMostWarnings, " more such warnings"));
}

int conclude(const Pass& pass, cli::RunRecord& record) {
  const bool interrupted = record.frames < record.expected_frames;
  record.status = interrupted ? "interrupted" : "complete";
  for (const std::string& warning : record.warnings) say("warning: " + warning);
  write_file(pass.folder + "/" + cli::kRunFile, run_json(record));
  say(concat(interrupted ? "interrupted: " : "", record.frames, " frames in ", pass.folder,
             interrupted ? "; --resume continues" : ""));
  return interrupted ? exit_code(ErrorKind::kInterrupted) : 0;
}

}  // namespace

void say(const std::string& line) { std::fprintf(stderr, "make_features: %s\n", line.c_str()); }

int run_pass(const Pass& pass, const std::vector<SceneFrame>& frames,
             const MakeFeaturesOptions& options, int threads,
             const std::vector<std::string>& arguments, const cli::InterruptGuard& interrupt) {
  cli::RunRecord record;
  record.tool = "make_features";
  record.version = LVGGT_VERSION;
  record.arguments = arguments;
  record.inputs = pass.inputs;
  record.settings = pass.settings;
  record.threads = threads;
  record.expected_frames = static_cast<std::int64_t>(frames.size());
  const bool existed = cli::check_output_folder(pass.folder, options.existing());
  const std::string run_file = pass.folder + "/" + cli::kRunFile;
  if (existed && options.resume) cli::check_same_settings(run_file, record);
  cli::create_output_folder(pass.folder);
  cli::remove_unfinished_files(pass.folder);
  if (existed && options.force) remove_features(pass.folder);
  write_file(run_file, run_json(record));
  try {
    make_frames(pass, frames, record, interrupt);
  } catch (const std::exception& error) {
    record.status = "failed";
    record.error = error.what();
    write_file(run_file, run_json(record));
    throw;
  }
  return conclude(pass, record);
}
