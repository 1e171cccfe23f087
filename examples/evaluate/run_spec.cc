// SPDX-License-Identifier: Apache-2.0
#include "examples/evaluate/run_spec.h"

#include <filesystem>

#include "lvggt/core/error.h"
#include "lvggt/io/json.h"

namespace evaluate {
namespace {

using namespace lvggt;

constexpr const char* kScene = "{scene}";

std::vector<std::string> strings(const Json& json, const std::string& place) {
  std::vector<std::string> list;
  if (json.is_string()) return {json.as_string(place)};
  for (const Json& entry : json.as_array(place)) list.push_back(entry.as_string(place));
  return list;
}

// Reads the members of one run.
class RunReader {
 public:
  RunReader(RunSpec& run, const std::filesystem::path& folder) : run_(run), folder_(folder) {}

  void read(const std::string& key, const Json& value, const std::string& place) {
    if (read_path(key, value, place) || read_setting(key, value, place)) return;
    fail(ErrorKind::kFormat, place, ": there is no such member of a run");
  }

 private:
  std::string path(const std::string& text) const { return (folder_ / text).string(); }
  std::vector<std::string> paths(const Json& value, const std::string& place) const {
    std::vector<std::string> list = strings(value, place);
    for (std::string& entry : list) entry = path(entry);
    return list;
  }

  bool read_path(const std::string& key, const Json& value, const std::string& place) {
    const std::map<std::string, std::string*> members{
        {"text-encoder", &run_.text_encoder},
        {"sentence-encoder", &run_.sentence_encoder},
        {"autoencoder", &run_.autoencoder},
        {"state-autoencoder", &run_.state_autoencoder},
        {"decoder", &run_.decoder},
        {"state-decoder", &run_.state_decoder},
        {"config", &run_.config},
        {"tokens", &run_.tokens},
        {"state-tokens", &run_.state_tokens},
        {"weights", &run_.weights},
        {"field", &run_.field},
        {"state-renders", &run_.state_renders}};
    if (key == "scenes") {
      run_.scenes = paths(value, place);
    } else if (key == "renders") {
      run_.renders = paths(value, place);
    } else if (key == "paraphrases") {
      run_.paraphrases = read_paraphrases(path(value.as_string(place)));
    } else if (const auto found = members.find(key); found != members.end()) {
      *found->second = path(value.as_string(place));
    } else {
      return false;
    }
    return true;
  }

  bool read_setting(const std::string& key, const Json& value, const std::string& place) {
    if (key == "method") {
      run_.method = value.as_string(place);
    } else if (key == "regime") {
      run_.regime = value.as_string(place);
    } else if (key == "mode") {
      run_.mode = value.as_string(place);
    } else if (key == "size") {
      run_.size = static_cast<int>(value.as_int64(place));
    } else if (key == "max-past-frames") {
      run_.max_past_frames = value.as_int64(place);
    } else if (key == "stretched") {
      run_.stretched = value.as_bool(place);
    } else if (key == "all-polygons") {
      run_.all_polygons = value.as_bool(place);
    } else {
      return false;
    }
    return true;
  }

  RunSpec& run_;
  std::filesystem::path folder_;
};

}  // namespace

std::string RunSpec::for_scene(const std::string& path, const std::string& scene_name) {
  std::string result = path;
  const std::string word = kScene;
  for (std::size_t at = result.find(word); at != std::string::npos;
       at = result.find(word, at + scene_name.size()))
    result.replace(at, word.size(), scene_name);
  return result;
}

std::string RunSpec::regime_text() const {
  if (!regime.empty()) return regime;
  const std::string& model = !decoder.empty() ? decoder : !field.empty() ? field : autoencoder;
  const bool each = model.find(kScene) != std::string::npos || scenes.size() == 1;
  return each ? "one model a scene" : "one model for all";
}

void RunSpec::check() const {
  const auto usage = [&](bool ok, const auto&... message) {
    if (!ok) fail(ErrorKind::kUsage, "the run \"", method, "\": ", message...);
  };
  usage(!scenes.empty(), "it names no scene");
  const bool ours = !decoder.empty() || !state_decoder.empty();
  const bool theirs = !renders.empty() || !state_renders.empty();
  usage((ours ? 1 : 0) + (theirs ? 1 : 0) + (field.empty() ? 0 : 1) == 1,
        "exactly one source of features is needed: --decoder, --field or --renders");
  usage(tokens.empty() || weights.empty(), "--tokens and --weights exclude each other");
  usage(state_tokens.empty() || (!state_decoder.empty() && weights.empty()),
        "--state-tokens needs --state-decoder, and tokens instead of --weights");
  usage(ours || (tokens.empty() && weights.empty()), "--tokens and --weights need --decoder");
  usage(!text_encoder.empty(), "--text-encoder is needed for the phrases");
  usage(ours ? !decoder.empty() : true, "masks need --decoder; --state-decoder adds the states");
  usage(!theirs || !renders.empty(), "masks need --renders; --state-renders adds the states");
}

Paraphrases read_paraphrases(const std::string& path) {
  const Json root = Json::read(path);
  Paraphrases paraphrases;
  for (const auto& [phrase, list] : root.as_object(path)) {
    const std::string place = concat(path, ": \"", phrase, "\"");
    paraphrases[phrase] = strings(list, place);
    if (paraphrases[phrase].empty()) fail(ErrorKind::kFormat, place, ": has no other wording");
  }
  return paraphrases;
}

std::vector<RunSpec> read_plan(const std::string& path, const RunSpec& defaults) {
  const Json root = Json::read(path);
  std::vector<RunSpec> runs;
  for (const Json& entry : root.as_array(path)) {
    RunSpec run = defaults;
    RunReader reader(run, std::filesystem::path(path).parent_path());
    for (const auto& [key, value] : entry.as_object(path))
      reader.read(key, value, concat(path, ": run ", runs.size() + 1, ": ", key));
    runs.push_back(std::move(run));
  }
  if (runs.empty()) fail(ErrorKind::kFormat, path, ": lists no run");
  return runs;
}

}  // namespace evaluate
