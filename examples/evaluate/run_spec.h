// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <vector>

namespace evaluate {

// Words for the same thing: other wordings of a phrase or sentence, by the annotated one.
using Paraphrases = std::map<std::string, std::vector<std::string>>;

// One row of the tables: a method on some scenes. In every path "{scene}" stands for the scene's
// folder name: with it in the decoder's there is a model for each scene, without it one for all.
struct RunSpec {
  std::string method = "4DLangVGGT, this decoder";
  std::string regime;               // for the table; empty: told by the paths
  std::vector<std::string> scenes;  // folders
  std::string text_encoder, sentence_encoder;
  std::string autoencoder, state_autoencoder;

  // Our model: decoders on tokens that are there already, or that the geometry weights make.
  std::string decoder, state_decoder, config;
  std::string tokens, weights, mode = "crop";
  std::string state_tokens;  // of the state decoder, if they are others
  int size = 0;              // 0: the model's
  bool stretched = false;    // decoders whose training targets were the pictures themselves
  std::int64_t max_past_frames = 128;
  // Or what lift_video left of the scene's frames.
  std::string field;
  // Or any method's feature maps: a folder of .npy for each level, and one of the dynamic features.
  std::vector<std::string> renders;
  std::string state_renders;

  Paraphrases paraphrases;
  bool all_polygons = false;
  bool check_images = true;

  // The path for a scene. A `path` without "{scene}" is the same for all.
  static std::string for_scene(const std::string& path, const std::string& scene_name);

  // "one model a scene" or "one model for all".
  std::string regime_text() const;

  // kUsage for runs that name no scene, no or several sources of features, or no text encoder.
  void check() const;
};

// {"phrase": ["another wording", ...], ...}. Errors: those of Json; kFormat for an empty list.
Paraphrases read_paraphrases(const std::string& path);

// A JSON list of runs, whose members are named as the program's options without the dashes, such as
// [{"method": "LangSplat", "renders": ["a/{scene}_1", ...], "autoencoder": "..."}]; what one does
// not say is as in `defaults`. Relative paths are relative to the file. Errors: those of Json;
// kFormat naming an unknown member.
std::vector<RunSpec> read_plan(const std::string& path, const RunSpec& defaults);

}  // namespace evaluate
