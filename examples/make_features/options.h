// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "examples/compact_codes.h"
#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/program.h"
#include "lvggt/cli/threads.h"

// The options of make_features.
struct MakeFeaturesOptions {
  std::string scene, masks, out;
  std::string image_encoder, clip_config, autoencoder;                       // what things are
  std::string captions, sentence_encoder, vocabulary, sentence_autoencoder;  // what they do
  int threads = 0;
  bool force = false, resume = false, dry_run = false;

  // After parsing: throws kUsage for what does not go together.
  void settle() const {
    using namespace lvggt;
    const bool clip = !image_encoder.empty(), sentences = !captions.empty();
    if (!clip && !sentences && autoencoder.empty() && sentence_autoencoder.empty())
      fail(ErrorKind::kUsage,
           "nothing to make: give --image-encoder, --captions, --autoencoder or ",
           "--sentence-autoencoder");
    if ((clip || sentences) && masks.empty())
      fail(ErrorKind::kUsage, "--masks is needed with --image-encoder and --captions");
    if (sentences != !sentence_encoder.empty())
      fail(ErrorKind::kUsage, "--captions and --sentence-encoder need each other");
    if (force && resume) fail(ErrorKind::kUsage, "--force and --resume exclude each other");
  }

  lvggt::cli::Existing existing() const {
    using lvggt::cli::Existing;
    return force ? Existing::kReplace : resume ? Existing::kResume : Existing::kRefuse;
  }
  lvggt::ExistingCodes existing_codes() const {
    using lvggt::ExistingCodes;
    return force ? ExistingCodes::kReplace : resume ? ExistingCodes::kKeep : ExistingCodes::kRefuse;
  }
};

inline constexpr const char* kMakeFeaturesHelp =
    "Makes, in the layout of 4DLangSplat:\n"
    "  clip_features/NAME_s.npy, NAME_f.npy    with --image-encoder: each object cut out and "
    "encoded\n"
    "  video_features/NAME_s.npy, NAME_f.npy   with --captions: each object's sentence, encoded\n"
    "  ...-language_features_dimD/             with an autoencoder: the same as D numbers each, "
    "from\n"
    "                                          the folders above, made now or before\n\n"
    "MASKS holds label maps of objects, 0 the background: NAME.npy with whole numbers [4,H,W]\n"
    "(default, small, middle, large), [1,H,W] or [H,W]; or NAME.png (grey values are the "
    "numbers);\n"
    "or default/NAME.png, small/NAME.png, middle/NAME.png and large/NAME.png. Or it is a COCO "
    "file\n"
    "(.json), whose categories are the objects. One level stands for all four. CSV has the "
    "columns\n"
    "frame (the number in the picture's name), object (its number in the masks) and sentence.\n\n"
    "Examples:\n"
    "  make_features SCENE --masks SCENE/masks --image-encoder CLIP-ViT-B-16-laion2B-s34B-b88K\n"
    "  make_features SCENE --masks SCENE/masks --captions captions.csv --sentence-encoder "
    "e5-mistral-7b-instruct\n"
    "  make_features SCENE --autoencoder ae_clip.safetensors\n\n"
    "Every file appears when it is complete; an interrupted run is continued by --resume, which "
    "needs\n"
    "the same settings. Exit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input "
    "file, 4\n"
    "memory or a limit, 130 interrupted.";

inline void add_make_features_options(lvggt::cli::Program& program, MakeFeaturesOptions& options) {
  CLI::App& app = program.app();
  app.footer(kMakeFeaturesHelp);
  app.add_option("scene", options.scene, "Scene in the HyperNeRF or Neu3D layout")
      ->required()
      ->type_name("SCENE");
  app.add_option("--masks", options.masks, "Label maps of the objects")->type_name("MASKS");
  app.add_option("--image-encoder", options.image_encoder,
                 "CLIP's weights (safetensors, or a folder with them): makes clip_features")
      ->type_name("PATH");
  app.add_option("--clip-config", options.clip_config,
                 "CLIP's configuration; else the one beside the weights")
      ->type_name("FILE");
  app.add_option("--captions", options.captions,
                 "Sentences of what the objects do: makes video_features")
      ->type_name("CSV");
  app.add_option(
         "--sentence-encoder", options.sentence_encoder,
         "Encoder of the sentences: e5-mistral's folder, or a .npy with its list of phrases")
      ->type_name("PATH");
  app.add_option("--vocabulary", options.vocabulary,
                 "Its tokenizer.model, or the list of phrases of a .npy; else what is beside it")
      ->type_name("PATH");
  app.add_option(
         "--autoencoder", options.autoencoder,
         "Autoencoder of clip_features (safetensors, .pth, .ckpt): makes their compact form; "
         "train_autoencoder --encode does the same with the one it trains")
      ->type_name("FILE");
  app.add_option("--sentence-autoencoder", options.sentence_autoencoder,
                 "The same for video_features")
      ->type_name("FILE");
  app.add_option("--out", options.out, "Folder for the results; else the scene")->type_name("DIR");
  lvggt::cli::add_threads_option(program, options.threads);
  app.add_flag("--dry-run", options.dry_run, "Check the inputs and say what would be made");
  app.add_flag("--force", options.force, "Replace features that an earlier run made");
  app.add_flag("--resume", options.resume, "Continue an earlier run; complete files stay");
}
