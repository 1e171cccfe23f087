// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "lvggt/cli/program.h"
#include "lvggt/cli/threads.h"
#include "lvggt/field/field_query.h"
#include "lvggt/field/heat_map.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/preprocess.h"

namespace query_video {

// The options of the program.
struct Options {
  std::string field, out, phrase_file;
  // The video is lifted first, when there are weights or decoders.
  std::string weights, decoder, state_decoder, config;
  int size = 0;
  std::int64_t max_past_frames = 128;
  std::string text_encoder, sentence_encoder, autoencoder, state_autoencoder, vocabulary;
  lvggt::Questions questions;
  lvggt::PhraseQueryOptions protocol;
  double min_score = lvggt::kNeutralRelevancy;
  std::int64_t every = 1;
  int threads = 0;
  std::size_t memory_limit = 0;  // 0: what is free
  bool no_masks = false, no_heat = false, no_ply = false, no_sheet = false;
  bool interactive = false, force = false, json = false, dry_run = false;

  bool lifts() const { return !(weights.empty() && decoder.empty() && state_decoder.empty()); }
  bool asks_states() const {
    return interactive ? !sentence_encoder.empty() : !questions.states.empty();
  }

  // After parsing. Throws kUsage, and kRead for the file of phrases.
  void settle() {
    using namespace lvggt;
    if (!phrase_file.empty()) read_phrases();
    if (interactive) {
      if (questions.size() > 0)
        fail(ErrorKind::kUsage, "--interactive reads phrases from its input: give none");
      if (json) fail(ErrorKind::kUsage, "--interactive goes with text, not with --json");
    } else {
      check_questions(questions);
    }
    if (!questions.states.empty() && (sentence_encoder.empty() || state_autoencoder.empty()))
      fail(ErrorKind::kUsage, "--state needs --sentence-encoder and --state-autoencoder");
    if (sentence_encoder.empty() != state_autoencoder.empty())
      fail(ErrorKind::kUsage, "--sentence-encoder and --state-autoencoder go together");
    if (!config.empty() && weights.empty())
      fail(ErrorKind::kUsage, "--config is for --weights: the bundled small model has its own");
    if (lifts() && (out.empty() || dry_run))
      fail(ErrorKind::kUsage,
           weights.empty() ? "--decoder and --state-decoder need" : "--weights needs",
           " --out, where the lifted field goes, and no --dry-run");
    if (out.empty() && force) fail(ErrorKind::kUsage, "--force is for --out");
  }

 private:
  // One a line; empty lines and lines that begin with # are left out.
  void read_phrases() {
    const std::string text = lvggt::read_text_file(phrase_file);
    for (std::size_t begin = 0; begin < text.size();) {
      const std::size_t end = std::min(text.find('\n', begin), text.size());
      std::string line = text.substr(begin, end - begin);
      if (!line.empty() && line.back() == '\r') line.pop_back();
      if (!line.empty() && line[0] != '#') questions.phrases.push_back(std::move(line));
      begin = end + 1;
    }
  }
};

inline void add_lifting(lvggt::cli::Program& program, Options& o) {
  CLI::App& app = program.app();
  const std::string group = "Lifting first (lift_video has more choices)";
  const auto add_file = [&](const std::string& name, std::string& file, const std::string& text) {
    app.add_option(name, file, text)->type_name("FILE")->group(group);
  };
  add_file(
      "--weights", o.weights,
      "Lift FIELD with this geometry model into OUT/field, then ask; with a decoder only, with "
      "the small model that comes with lvggt");
  add_file("--decoder", o.decoder, "The semantic bridging decoder, unless it is in the same file");
  add_file("--state-decoder", o.state_decoder, "The decoder of states");
  add_file("--config", o.config, "The model's configuration, unless the weights tell");
  program
      .add_number<int>("--size", o.size, "Width of the model frames, a multiple of 14",
                       lvggt::kPatchSize, lvggt::kMaxFrameSize)
      ->default_str("the model's")
      ->group(group);
  program
      .add_number<std::int64_t>("--max-past-frames", o.max_past_frames,
                                "Past frames the model sees", 1, std::int64_t{1} << 20)
      ->group(group);
}

inline void add_options(lvggt::cli::Program& program, Options& o) {
  CLI::App& app = program.app();
  app.add_option(
         "FIELD", o.field,
         "The folder that lift_video wrote; with --weights or a decoder, a video or a folder of "
         "images")
      ->required();
  app.add_option("PHRASE", o.questions.phrases,
                 "What to look for, \"the cup\"; any number of them");
  app.add_option("--state", o.questions.states,
                 "When does this hold, \"the cup is tilted\"; may be given several times")
      ->type_name("SENTENCE")
      ->allow_extra_args(false);
  app.add_option("--phrases", o.phrase_file, "A file of further phrases, one a line")
      ->type_name("FILE");
  app.add_option("--text-encoder", o.text_encoder,
                 "Turns phrases into CLIP's space: a CLIP checkpoint, or a .npy of embeddings with "
                 "its .json of phrases")
      ->type_name("PATH")
      ->required();
  app.add_option("--vocabulary", o.vocabulary,
                 "CLIP's tokeniser, or a .npy's list of phrases, unless it is beside it")
      ->type_name("PATH");
  app.add_option("--autoencoder", o.autoencoder, "From the field's codes to that space")
      ->type_name("FILE")
      ->required();
  app.add_option("--sentence-encoder", o.sentence_encoder,
                 "Turns sentences into the space of states: an e5-mistral folder, or a .npy")
      ->type_name("PATH");
  app.add_option("--state-autoencoder", o.state_autoencoder,
                 "From the field's state codes to that space")
      ->type_name("FILE");

  app.add_option("--out", o.out, "Folder for masks, heat maps, point clouds, time lines and JSON")
      ->type_name("DIR");
  app.add_flag("--force", o.force, "Replace the answers of an earlier run in that folder");
  app.add_flag("--json", o.json, "Print the answers as JSON instead of text");
  app.add_flag("--interactive", o.interactive,
               "Read a phrase a line and answer at once; a line \"state: ...\" asks for a state");
  app.add_flag("--dry-run", o.dry_run,
               "Print what the field holds and the memory needed, and stop");
  program.add_number<std::int64_t>("--every", o.every, "Ask about every N-th frame of the field", 1,
                                   std::int64_t{1} << 40);
  app.add_flag("--no-masks", o.no_masks, "No mask pictures");
  app.add_flag("--no-heat", o.no_heat, "No heat maps");
  app.add_flag("--no-ply", o.no_ply, "No point clouds");
  app.add_flag("--no-sheet", o.no_sheet, "No overview and no time lines");

  program.add_number<double>(
      "--min-score", o.min_score,
      "A phrase whose relevancy stays at or below it is not in the frame; 0.5 is as near to the "
      "phrase as to \"object\", \"things\", \"stuff\" or \"texture\", 0 finds something everywhere",
      0, 1, "R");
  program.add_number<std::int64_t>("--box", o.protocol.box,
                                   "Side of the box filter of the relevancy, odd", 1, 999);
  program.add_number<std::int64_t>("--majority", o.protocol.majority,
                                   "Side of the majority filter of the mask, odd", 1, 999);
  program.add_number<float>("--threshold", o.protocol.threshold,
                            "Of the frame's scaled relevancy, above which a pixel is in the mask",
                            0, 1, "R");
  lvggt::cli::add_threads_option(program, o.threads);
  program.add_bytes("--memory-limit", o.memory_limit,
                    "Refuse to answer if more is needed; else what is free");
  add_lifting(program, o);
  app.footer(
      "Exit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input, 4 memory or a "
      "limit,\n"
      "130 interrupted.\n\n"
      "Examples:\n"
      "  query_video clip \"the cup\" \"a hand\" --text-encoder clip --autoencoder ae.safetensors "
      "--out answer\n"
      "  query_video clip --state \"the cup is tilted\" --text-encoder clip --autoencoder "
      "ae.safetensors \\\n"
      "    --sentence-encoder e5 --state-autoencoder state_ae.safetensors --out when\n"
      "  query_video clip --interactive --text-encoder clip --autoencoder ae.safetensors");
}

}  // namespace query_video
