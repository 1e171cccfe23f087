// SPDX-License-Identifier: Apache-2.0
// Runs the case that a reference file names and compares every tensor in it with ours.
#include <cstdio>
#include <filesystem>
#include <string>

#include "examples/check_reference/cases.h"
#include "examples/check_reference/encoder_cases.h"
#include "examples/check_reference/query_cases.h"
#include "lvggt/cli/program.h"

namespace {

using namespace lvggt;

struct Options {
  LoadOptions load;
  std::string case_file;
  std::string inputs;
  std::string vocabulary;
  std::string weights_storage = "stored", cache_storage = "f32";
  double tolerance = 2e-4;
  int threads = 0;
  bool json = false;
};

std::string case_of(const Safetensors& file) {
  const auto found = file.metadata().find("case");
  if (found == file.metadata().end())
    fail(ErrorKind::kFormat, file.path(), ": its metadata has no \"case\" that says what it is a ",
         "reference for");
  return found->second;
}

// Weights that are not all float32 are never silent.
void say_storage(const LoadOptions& load) {
  const Checkpoint checkpoint(load);
  if (!checkpoint.all_f32())
    std::fprintf(stderr, "check_reference: %s\n", checkpoint.storage_summary().c_str());
  for (const std::string& warning : checkpoint.warnings())
    std::fprintf(stderr, "check_reference: warning: %s\n", warning.c_str());
}

void run_case(const std::string& name, check_reference::Comparison& comparison,
              const Options& options, Context& ctx) {
  if (name == "ops") return check_reference::check_ops(comparison, ctx);
  if (name == "preprocess") return check_reference::check_preprocess(comparison);
  if (name == "crops") return check_reference::check_crops(comparison);
  if (name == "autoencoder") return check_reference::check_autoencoder(comparison, ctx);
  if (name == "query") return check_reference::check_query(comparison, ctx);
  if (name == "polygons") return check_reference::check_polygons(comparison);
  if (name == "timeseries") return check_reference::check_timeseries(comparison, ctx);
  const bool training = name.starts_with("train");
  const bool streamed = name.starts_with("stream") || name == "evict" || name == "full_size";
  const bool bidirectional = name == "vggt";
  const bool encoder = name == "clip" || name == "mistral";
  if (!training && !streamed && !bidirectional && !encoder && name != "batch" && name != "square")
    fail(ErrorKind::kUnsupported, comparison.file().path(), ": case \"", name,
         "\" is not one of stream, ",
         "stream_lang6, evict, batch, square, vggt, ops, preprocess, full_size, train, "
         "train_small, train_upstream_cos, clip, mistral, crops, autoencoder, query, polygons, "
         "timeseries");
  if (options.load.weights.empty())
    fail(ErrorKind::kUsage, "--weights is required for the case \"", name, "\"");
  if (name == "clip")
    return check_reference::check_clip_towers(comparison, options.load.weights, options.load.config,
                                              ctx);
  if (name == "mistral")
    return check_reference::check_mistral(comparison, options.load.weights, options.load.config,
                                          ctx);
  if (training)
    return check_reference::check_train(comparison, name, options.load, options.inputs, ctx);
  LoadOptions load = options.load;
  if (options.weights_storage != "stored")
    load.storage = StoragePolicy::of(parse_storage(options.weights_storage, "--weights-storage"));
  say_storage(load);
  if (streamed) {
    check_reference::check_stream(comparison, load,
                                  parse_storage(options.cache_storage, "--cache-storage"), ctx);
  } else {
    check_reference::check_clip(
        comparison, load, bidirectional ? BatchMode::kBidirectional : BatchMode::kCausal, ctx);
  }
}

int check_file(const std::string& path, const Options& options) {
  const Safetensors file = Safetensors::open(path);
  const std::string name = case_of(file);
  Context ctx(options.threads);
  check_reference::Comparison comparison(file, options.tolerance);
  run_case(name, comparison, options, ctx);
  comparison.finish();
  const std::string report = options.json ? comparison.json(name) : comparison.text();
  if (std::fwrite(report.data(), 1, report.size(), stdout) != report.size() ||
      std::fflush(stdout) != 0)
    fail(ErrorKind::kWrite, "standard output: cannot be written");
  return comparison.ok() ? 0 : 1;
}

// Cases that are JSON have no metadata: their content or name tells them apart. Annotations are
// inputs: what they give is in the polygons case beside them.
int check_json(const Options& options) {
  const Json json = Json::read(options.case_file);
  if (check_reference::is_tokenizer_case(json)) {
    if (options.vocabulary.empty())
      fail(ErrorKind::kUsage, "--vocabulary is required for the case \"tokenizer\"");
    return check_reference::check_tokenizer(json, options.case_file, options.vocabulary,
                                            options.json)
               ? 0
               : 1;
  }
  const auto polygons =
      std::filesystem::path(options.case_file).parent_path() / "polygons_seed1.safetensors";
  if (!options.case_file.ends_with("annotations_seed1.json") &&
      !options.case_file.ends_with("annotations_seed1.coco.json"))
    fail(ErrorKind::kUnsupported, options.case_file,
         ": is none of the JSON cases: tokenizer, annotations (beside polygons_seed1.safetensors)");
  return check_file(polygons.string(), options);
}

int check(const Options& options) {
  return options.case_file.ends_with(".json") ? check_json(options)
                                              : check_file(options.case_file, options);
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  cli::Program program(
      "check_reference",
      "Compares the engine with reference values: runs the case that CASE names in its "
      "metadata and prints one line a tensor, `name  max_abs_err  rel_err  ok|FAIL`, where "
      "rel_err = max|ours - ref| / max|ref|; for gradients and updates of the train cases it is "
      "|ours - ref| / |ref| by Euclidean norms. Those cases have limits of their own and are run "
      "twice: in float64 as the reference was, lines \"float64.NAME\", and by the float32 trainer, "
      "each step from where the float64 step started.",
      LVGGT_VERSION);
  auto& app = program.app();
  app.add_option("case", options.case_file,
                 "Reference file (safetensors; JSON for the tokenizer and annotations)")
      ->required()
      ->type_name("CASE");
  app.add_option("--inputs", options.inputs,
                 "Reference file with the inputs, for train_upstream_cos; else train's beside CASE")
      ->type_name("FILE");
  app.add_option("--weights", options.load.weights, "Geometry weights, maybe with the decoder's")
      ->type_name("FILE");
  app.add_option("--decoder", options.load.decoder,
                 "Decoder weights, if they are in a file of their own")
      ->type_name("FILE");
  app.add_option("--config", options.load.config,
                 "Configuration (JSON); else the weights' metadata or shapes tell it")
      ->type_name("FILE");
  app.add_option("--vocabulary", options.vocabulary,
                 "Folder of CLIP's vocabulary (merges.txt and vocab.json, or tokenizer.json), for "
                 "the tokenizer case")
      ->type_name("DIR");
  app.add_option("--weights-storage", options.weights_storage,
                 "How weights are kept: stored (as in their file), f32, bf16, f16 or int8 (linear "
                 "layers of the transformer)")
      ->type_name("TYPE")
      ->capture_default_str();
  app.add_option("--cache-storage", options.cache_storage,
                 "How cached keys and values are kept: f32, bf16 or int8")
      ->type_name("TYPE")
      ->capture_default_str();
  program.add_number("--tolerance", options.tolerance, "Largest rel_err that passes", 0.0, 1e9);
  program.add_number("--threads", options.threads, "Threads; 0: all this process may use", 0,
                     kMaxThreads);
  app.add_flag("--json", options.json, "Print one JSON object instead of lines");
  app.footer(
      "Exit status: 0 all within the tolerance, 1 some are not, 2 wrong usage, 3 bad input file, 4 "
      "memory.");
  return program.run(argc, argv, [&] { return check(options); });
}
