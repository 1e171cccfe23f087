// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/field/cloud_view.h"
#include "lvggt/field/contact_sheet.h"
#include "lvggt/field/frame_files.h"
#include "lvggt/field/frame_pictures.h"
#include "lvggt/field/lifted_field.h"
#include "lvggt/field/point_cloud.h"
#include "lvggt/field/semantic_codes.h"
#include "lvggt/io/cameras_json.h"
#include "lvggt/io/colmap.h"
#include "lvggt/io/depth_png.h"
#include "lvggt/io/ply.h"
#include "lvggt/io/png.h"
#include "lvggt/io/preprocess.h"

namespace lvggt {

// Which outputs of a run to write.
struct RunOutputs {
  bool ply = true, depth = true, confidence = true, rgb = true, semantics = true;
  bool colmap = true, contact_sheet = true;
  bool codes = true;             // what the decoders say, for queries
  bool frames = true;            // the model's input, for pictures of answers
  bool images = false;           // the original pictures, for programs that read the COLMAP model
  bool rgb_head_colors = false;  // points take the RGB head's colours instead of the input's
  std::int64_t every = 1;        // files and COLMAP images for every n-th frame only
  std::int64_t colmap_points = 100'000;       // at most about this many in the whole model
  double percentile = kConfidencePercentile;  // of confidence, that points must reach
};

// What a run is about; the same for all its frames.
struct RunFormat {
  ImageTransform transform;
  std::int64_t levels = 0, lang_dim = 0;         // 0 without language features
  std::int64_t state_levels = 0, state_dim = 0;  // the same of the state decoder
  std::string decoder_sha256, state_sha256;      // of the decoders, for the files of codes
  bool has_rgb = false;
  bool names_are_files = false;       // frames are image files whose names a COLMAP model can use
  std::int64_t expected_frames = -1;  // -1 if unknown
  std::string title, footer;          // of the contact sheet
};

// One frame with where it comes from.
struct RunFrame {
  CameraRecord record;
  View<const std::uint8_t, 3> original;  // [H, W, 3], the picture it was made from
  FrameMaps maps;
};

// The files a run leaves in its folder, but for run.json, and the folders with a file for each
// frame.
inline std::vector<std::string> run_files() {
  return {kFieldFile,
          "cameras.json",
          "contact_sheet.png",
          "cloud.png",
          "sparse/0/cameras.txt",
          "sparse/0/images.txt",
          "sparse/0/points3D.txt",
          "sparse/0",
          "sparse"};
}
inline std::vector<std::string> run_folders() {
  std::vector<std::string> folders{"points", "depth",  "depth_color", "confidence",
                                   "rgb",    "images", "frames"};
  for (const CodesKind kind : {CodesKind::kLanguage, CodesKind::kState})
    folders.push_back(codes_folder(kind));
  for (const std::int64_t levels : {1, 3})
    for (const auto& names : {level_names(levels), state_level_names(levels)})
      for (const std::string& level : names) folders.push_back("semantics_" + level);
  return folders;
}

// Writes a run's outputs into a folder, frame by frame, in memory that does not grow with their
// number:
//   points/NNNNNN.ply            coloured, language-featured points
//   depth/NNNNNN.png, .json      16 bits and their scale; depth_color/NNNNNN.png to look at
//   confidence/NNNNNN.png, .json 16 bits and their scale
//   rgb/NNNNNN.png               the RGB head's picture
//   semantics_LEVEL/NNNNNN.png   semantic vectors as colours
//   codes/NNNNNN.safetensors     the semantic vectors themselves; state_codes/ of the state decoder
//   frames/NNNNNN.png            the picture the model saw
//   images/NNNNNN.png            the original picture, if asked for
//   cameras.json                 every frame's camera
//   sparse/0/*.txt               COLMAP text model
//   contact_sheet.png            some frames side by side
//   cloud.png                    the first frame's points from the left and from the right
//   field.json                   what all these hold, for LiftedField
// NNNNNN counts the frames of the run from 0. A file appears only when it is complete.
class RunWriter {
 public:
  // The folder exists. With `keep_existing`, files of frames that are already there stay as they
  // are.
  RunWriter(std::string folder, const RunOutputs& outputs, const RunFormat& format,
            bool keep_existing)
      : folder_(std::move(folder)),
        outputs_(outputs),
        format_(format),
        keep_existing_(keep_existing),
        level_names_(names_of(format.levels, level_names)),
        map_names_(level_names_),
        cameras_(path("cameras.json"), format.transform),
        cloud_(format.transform.height, format.transform.width, format.levels, format.lang_dim) {
    for (std::string& name : names_of(format.state_levels, state_level_names))
      map_names_.push_back(std::move(name));
    if (outputs.codes && format.levels > 0)
      language_ = codes_format(level_names_, format.lang_dim, format.decoder_sha256);
    if (outputs.codes && format.state_levels > 0)
      states_ = codes_format(state_level_names(format.state_levels), format.state_dim,
                             format.state_sha256);
    if (outputs.colmap) {
      make_folder("sparse");
      make_folder("sparse/0");
      colmap_.emplace(path("sparse/0"));
    }
    if (outputs.contact_sheet) {
      ContactSheet::Options options;
      options.title = format.title;
      options.footer = format.footer;
      sheet_.emplace(sheet_rows(), options);
    }
    for (const std::string& name : output_folders()) make_folder(name);
  }

  // Writes a frame. `stop` is asked between files; when it says so, the rest of the frame is left
  // out and false returned: the frame does not count.
  bool write(const RunFrame& frame, const std::function<bool()>& stop, Context& ctx) {
    const bool selected = frame.record.index % outputs_.every == 0;
    const bool in_sheet = sheet_ && sheet_->wants_next();
    // The first frame settles the colours, whether or not they are written.
    if (frame.record.index == 0 || in_sheet || selected) pictures_.paint(frame.maps);
    if (selected && !write_files(frame, stop, ctx)) return false;
    cameras_.add(frame.record);
    if (sheet_) {
      if (in_sheet)
        add_to_sheet(frame);
      else
        sheet_->skip();
    }
    ++num_frames_;
    return true;
  }

  // Writes what covers all frames: cameras.json, the COLMAP model, the contact sheet.
  void finish() {
    cameras_.finish();
    if (colmap_) colmap_->finish();
    if (sheet_ && !sheet_->empty()) write_png(path("contact_sheet.png"), sheet_->render());
    if (num_frames_ == 0) return;
    write_file(
        path(kFieldFile),
        field_json({num_frames_, outputs_.every, format_.transform.height, format_.transform.width,
                    outputs_.frames, outputs_.depth, outputs_.confidence, language_, states_}));
  }

  std::int64_t num_frames() const { return num_frames_; }                // complete
  std::int64_t num_files_kept() const { return num_files_kept_; }        // were there already
  std::int64_t num_files_written() const { return num_files_written_; }  // of single frames
  std::int64_t num_points() const { return num_points_; }                // in point clouds

 private:
  std::string path(const std::string& name) const { return folder_ + "/" + name; }

  void make_folder(const std::string& name) const {
    std::error_code error;
    std::filesystem::create_directory(path(name), error);
    if (error) fail(ErrorKind::kWrite, path(name), ": cannot create the folder: ", error.message());
  }

  template <class Names>
  static std::vector<std::string> names_of(std::int64_t levels, Names&& names) {
    return levels > 0 ? names(levels) : std::vector<std::string>();
  }

  CodesFormat codes_format(const std::vector<std::string>& levels, std::int64_t dim,
                           const std::string& sha256) const {
    return {levels, format_.transform.height, format_.transform.width, dim, sha256};
  }

  std::vector<std::string> output_folders() const {
    std::vector<std::string> names;
    if (outputs_.ply) names.push_back("points");
    if (outputs_.depth) names.insert(names.end(), {"depth", "depth_color"});
    if (outputs_.confidence) names.push_back("confidence");
    if (outputs_.rgb && format_.has_rgb) names.push_back("rgb");
    if (outputs_.semantics)
      for (const std::string& level : map_names_) names.push_back("semantics_" + level);
    if (outputs_.images) names.push_back("images");
    if (outputs_.frames) names.push_back("frames");
    if (language_) names.push_back(codes_folder(CodesKind::kLanguage));
    if (states_) names.push_back(codes_folder(CodesKind::kState));
    return names;
  }

  std::vector<std::string> sheet_rows() const {
    std::vector<std::string> rows{"input"};
    if (format_.has_rgb) rows.push_back("RGB head");
    rows.insert(rows.end(), {"depth", "confidence"});
    for (const std::string& level : map_names_) rows.push_back("semantics " + level);
    return rows;
  }

  void add_to_sheet(const RunFrame& frame) {
    std::vector<View<const std::uint8_t, 3>> pictures{pictures_.input()};
    if (format_.has_rgb) pictures.push_back(pictures_.rgb());
    pictures.insert(pictures.end(), {pictures_.depth(), pictures_.confidence()});
    for (std::size_t level = 0; level < map_names_.size(); ++level)
      pictures.push_back(pictures_.semantics(level));
    std::string caption = "#" + std::to_string(frame.record.index) + "  ";
    append_number(caption, std::round(frame.record.timestamp * 100) / 100);
    sheet_->add(caption + " s", pictures);
  }

  // Calls write(path) unless the file is there already and is to be kept; false if stopped before.
  template <class Write>
  bool write_file_of_frame(const std::string& name, const std::function<bool()>& stop,
                           Write&& write) {
    if (stop()) return false;
    if (keep_existing_ && std::filesystem::exists(path(name))) {
      ++num_files_kept_;
      return true;
    }
    write(path(name));
    ++num_files_written_;
    return true;
  }

  bool write_files(const RunFrame& frame, const std::function<bool()>& stop, Context& ctx) {
    const std::string png = "/" + frame_stem(frame.record.index) + ".png";
    const auto picture = [&](const std::string& folder, View<const std::uint8_t, 3> pixels) {
      return write_file_of_frame(folder + png, stop,
                                 [&](const std::string& file) { write_png(file, pixels); });
    };
    if (outputs_.depth &&
        !(write_map(frame, "depth", frame.maps.depth,
                    "z in the camera's frame; its unit is relative, not a metre", stop) &&
          picture("depth_color", pictures_.depth())))
      return false;
    if (outputs_.confidence && !write_map(frame, "confidence", frame.maps.confidence,
                                          "of the depth; at least 1, without a unit", stop))
      return false;
    if (outputs_.rgb && format_.has_rgb && !picture("rgb", pictures_.rgb())) return false;
    if (outputs_.semantics)
      for (std::size_t level = 0; level < map_names_.size(); ++level)
        if (!picture("semantics_" + map_names_[level], pictures_.semantics(level))) return false;
    if (outputs_.images && !picture("images", frame.original)) return false;
    if (outputs_.frames && !picture("frames", pictures_.input())) return false;
    if (!write_codes_of(frame, CodesKind::kLanguage, language_, frame.maps.language, stop) ||
        !write_codes_of(frame, CodesKind::kState, states_, frame.maps.states, stop))
      return false;
    return write_points(frame, stop, ctx);
  }

  bool write_codes_of(const RunFrame& frame, CodesKind kind,
                      const std::optional<CodesFormat>& format, View<const float, 4> codes,
                      const std::function<bool()>& stop) {
    if (!format) return true;
    return write_file_of_frame(
        codes_folder(kind) + ("/" + frame_stem(frame.record.index)) + ".safetensors", stop,
        [&](const std::string& file) { write_codes(file, codes, *format, frame.record.index); });
  }

  bool write_map(const RunFrame& frame, const std::string& quantity, View<const float, 2> map,
                 const std::string& meaning, const std::function<bool()>& stop) {
    const std::string file = quantity + "/" + frame_stem(frame.record.index);
    return write_file_of_frame(file + ".png", stop, [&](const std::string& png) {
      write_depth_png(png, path(file + ".json"), map, quantity, meaning);
    });
  }

  bool write_points(const RunFrame& frame, const std::function<bool()>& stop, Context& ctx) {
    if (!outputs_.ply && !colmap_) return true;
    const bool from_head = outputs_.rgb_head_colors && format_.has_rgb;
    cloud_.build(
        {frame.maps.depth, frame.maps.confidence, from_head ? frame.maps.rgb : frame.maps.input,
         frame.maps.language, frame.record.camera},
        outputs_.percentile, ctx);
    if (outputs_.ply) {
      num_points_ += cloud_.size();
      const PlyPoints points{cloud_.positions(), cloud_.colors(), cloud_.confidence(),
                             cloud_.semantics(), level_names_,    frame.record.timestamp};
      if (!write_file_of_frame("points/" + frame_stem(frame.record.index) + ".ply", stop,
                               [&](const std::string& file) { write_ply(file, points); }))
        return false;
      if (frame.record.index == 0) {
        constexpr std::int64_t kWidth = 480;
        write_png(path("cloud.png"),
                  render_cloud_from_both_sides(cloud_, frame.record.camera,
                                               frame.maps.depth.shape(), kWidth));
      }
    }
    if (colmap_) add_to_colmap(frame);
    return true;
  }

  // An even selection of the frame's points, so that all frames together stay near the limit.
  void add_to_colmap(const RunFrame& frame) {
    constexpr std::int64_t kFramesIfUnknown = 200;
    const std::int64_t frames =
        format_.expected_frames > 0 ? format_.expected_frames : kFramesIfUnknown;
    const std::int64_t images = (frames + outputs_.every - 1) / outputs_.every;
    const std::int64_t wanted = std::max<std::int64_t>(1, outputs_.colmap_points / images);
    const std::int64_t stride = std::max<std::int64_t>(1, (cloud_.size() + wanted - 1) / wanted);
    colmap_selection_.clear();
    for (std::int64_t i = 0; outputs_.colmap_points > 0 && i < cloud_.size(); i += stride) {
      const auto position = cloud_.positions()[i];
      const auto color = cloud_.colors()[i];
      const auto pixel = cloud_.pixels()[i];
      const Eigen::Vector2d original = pixel_in_original(format_.transform, pixel[0], pixel[1]);
      colmap_selection_.push_back({{position[0], position[1], position[2]},
                                   {color[0], color[1], color[2]},
                                   original[0],
                                   original[1]});
    }
    const std::string name = format_.names_are_files && !outputs_.images
                                 ? frame.record.name
                                 : frame_stem(frame.record.index) + ".png";
    colmap_->add_image(name, in_original_pixels(frame.record.camera, format_.transform),
                       format_.transform.original_width, format_.transform.original_height,
                       colmap_selection_);
  }

  std::string folder_;
  RunOutputs outputs_;
  RunFormat format_;
  bool keep_existing_;
  std::vector<std::string> level_names_;  // of the language
  std::vector<std::string> map_names_;    // the same, then those of the states
  std::optional<CodesFormat> language_, states_;
  CamerasJson cameras_;
  PointCloud cloud_;
  FramePictures pictures_;
  std::optional<ColmapWriter> colmap_;
  std::optional<ContactSheet> sheet_;
  std::vector<ColmapPoint> colmap_selection_;
  std::int64_t num_frames_ = 0, num_files_kept_ = 0, num_files_written_ = 0, num_points_ = 0;
};

}  // namespace lvggt
