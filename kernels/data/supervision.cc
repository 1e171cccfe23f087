// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/supervision.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/npy.h"

namespace lvggt {

namespace {

constexpr std::string_view kNames[] = {"clip", "dynamic"};
constexpr std::string_view kLevelNames[] = {"default", "small", "middle", "large"};

std::string level_name(std::int64_t file_level, const SupervisionSpec& spec) {
  if (spec.kind == Supervision::kDynamic) return "the only level";
  return "level " + std::string(kLevelNames[static_cast<std::size_t>(file_level)]);
}

struct Files {
  NpyFile rows, codes;

  Files(const std::string& rows_path, const std::string& codes_path, const SupervisionSpec& spec)
      : rows(rows_path), codes(codes_path) {
    const std::int64_t levels = spec.file_levels();
    LVGGT_CHECK(rows.shape().size() == 3 && rows.shape()[0] == levels, rows_path,
                ": has the shape ", shape_of(rows), ", but ", supervision_name(spec.kind),
                " supervision has label maps of [", levels, ",H,W]");
    LVGGT_CHECK(codes.shape().size() == 2 && codes.shape()[1] == spec.dim, codes_path,
                ": has the shape ", shape_of(codes), ", but ", supervision_name(spec.kind),
                " features of ", spec.dim, " numbers are expected, [n,", spec.dim, "]",
                is_raw(codes, spec)
                    ? "; these are not yet encoded by the autoencoder to so few numbers"
                    : "");
    LVGGT_CHECK(rows.shape()[1] > 0 && rows.shape()[2] > 0, rows_path, ": the label map is empty");
    if (codes.shape()[0] > std::numeric_limits<std::int32_t>::max())
      fail(ErrorKind::kLimit, codes_path, ": has ", codes.shape()[0], " features");
  }

  static std::string shape_of(const NpyFile& file) {
    std::string text = "[";
    for (const std::int64_t extent : file.shape())
      text += (text.size() > 1 ? "," : "") + std::to_string(extent);
    return text + "]";
  }
  static bool is_raw(const NpyFile& codes, const SupervisionSpec& spec) {
    return codes.shape().size() == 2 &&
           codes.shape()[1] == (spec.kind == Supervision::kClip ? 512 : 4096);
  }
};

Tensor<float, 2> read_codes(const NpyFile& file) {
  Tensor<float, 2> codes = file.read<2>();
  for (std::int64_t row = 0; row < codes.extent(0); ++row)
    for (const float value : std::span(&codes[row][0], static_cast<std::size_t>(codes.extent(1))))
      if (!std::isfinite(value))
        fail(ErrorKind::kNumeric, file.path(), ": row ", row, " holds ", value);
  return codes;
}

// Which rows stand for something.
std::vector<char> usable_rows(const Tensor<float, 2>& codes, const SupervisionSpec& spec) {
  std::vector<char> usable(static_cast<std::size_t>(codes.extent(0)), 1);
  if (spec.kind == Supervision::kClip) return usable;
  const auto d = static_cast<std::size_t>(codes.extent(1));
  for (std::size_t row = 0; row < usable.size(); ++row) {
    const float* code = codes.data() + row * d;
    usable[row] = std::any_of(code, code + d, [](float x) { return x != 0; }) ? 1 : 0;
  }
  return usable;
}

// For each target pixel along one axis, the pixel of the picture its centre falls into, or -1.
std::vector<std::int64_t> source_pixels(std::int64_t target, std::int64_t source, double scale,
                                        double offset) {
  std::vector<std::int64_t> pixels(static_cast<std::size_t>(target));
  for (std::int64_t i = 0; i < target; ++i) {
    const double at = std::floor((static_cast<double>(i) + 0.5 - offset) / scale);
    const bool inside = at >= 0 && at < static_cast<double>(source);
    pixels[static_cast<std::size_t>(i)] = inside ? static_cast<std::int64_t>(at) : -1;
  }
  return pixels;
}

}  // namespace

Supervision parse_supervision(std::string_view name) {
  if (name == kNames[0]) return Supervision::kClip;
  if (name == kNames[1]) return Supervision::kDynamic;
  fail(ErrorKind::kUsage, "supervision: '", name, "' is neither clip nor dynamic");
}

std::string_view supervision_name(Supervision kind) {
  return kNames[kind == Supervision::kClip ? 0 : 1];
}

std::string SupervisionSpec::folder() const {
  return std::string(kind == Supervision::kClip ? "clip" : "video") +
         "_features-language_features_dim" + std::to_string(dim);
}

LabelHeader check_labels(const std::string& rows_path, const std::string& codes_path,
                         const SupervisionSpec& spec) {
  const Files files(rows_path, codes_path, spec);
  return {files.rows.shape()[1], files.rows.shape()[2], files.codes.shape()[0]};
}

FrameLabels read_labels(const std::string& rows_path, const std::string& codes_path,
                        const SupervisionSpec& spec) {
  const Files files(rows_path, codes_path, spec);
  FrameLabels labels;
  labels.codes = read_codes(files.codes);
  const std::int64_t H = files.rows.shape()[1], W = files.rows.shape()[2];
  const std::int64_t skipped = spec.file_levels() - spec.levels();
  const std::int64_t num_codes = labels.codes.extent(0);
  labels.rows = Tensor<std::int32_t, 3>(Shape{spec.levels(), H, W});
  std::vector<std::int64_t> level_rows(static_cast<std::size_t>(size_product(H, W)));
  for (std::int64_t level = 0; level < spec.levels(); ++level) {
    files.rows.read_part((skipped + level) * H * W, std::span(level_rows));
    std::int32_t* out = labels.rows.data() + level * H * W;
    for (std::size_t i = 0; i < level_rows.size(); ++i) {
      const std::int64_t row = level_rows[i];
      if (row < -1 || row >= num_codes) [[unlikely]] {
        const auto at = static_cast<std::int64_t>(i);
        fail(ErrorKind::kFormat, rows_path, ": the label at row ", at / W, ", column ", at % W,
             " of ", level_name(skipped + level, spec), " is ", row,
             row < -1 ? ", but below -1 (no label) there is nothing"
                      : concat(", but ", codes_path, " has ", num_codes, " rows"));
      }
      out[i] = static_cast<std::int32_t>(row);
    }
  }
  return labels;
}

void check_codes(const std::string& codes_path) { read_codes(NpyFile(codes_path)); }

std::int64_t num_labelled(const FrameLabels& labels, const SupervisionSpec& spec) {
  const std::vector<char> usable = usable_rows(labels.codes, spec);
  const std::int32_t* rows = labels.rows.data();
  return std::count_if(rows, rows + labels.rows.size(), [&](std::int32_t row) {
    return row >= 0 && usable[static_cast<std::size_t>(row)] != 0;
  });
}

void paint_targets(View<float, 4> features, View<float, 3> mask, const FrameLabels& labels,
                   const SupervisionSpec& spec, const ImageTransform& transform,
                   bool original_size) {
  const auto [levels, H, W, d] = features.shape();
  LVGGT_CHECK(levels == spec.levels() && d == spec.dim && mask.shape() == (Shape{levels, H, W}),
              "paint_targets: features are ", features.shape(), " and the mask ", mask.shape());
  const bool turned = transform.quarter_turns_ccw == 1;
  const std::int64_t label_H = labels.rows.extent(1), label_W = labels.rows.extent(2);
  const std::int64_t turned_H = turned ? label_W : label_H, turned_W = turned ? label_H : label_W;
  const auto ys = original_size ? source_pixels(H, turned_H, 1, 0)
                                : source_pixels(H, turned_H, transform.scale_y, transform.offset_y);
  const auto xs = original_size ? source_pixels(W, turned_W, 1, 0)
                                : source_pixels(W, turned_W, transform.scale_x, transform.offset_x);
  const std::vector<char> usable = usable_rows(labels.codes, spec);
  for (std::int64_t level = 0; level < levels; ++level) {
    const std::int32_t* rows = labels.rows.data() + level * label_H * label_W;
    for (std::int64_t y = 0; y < H; ++y) {
      float* feature = &features(level, y, 0, 0);
      float* labelled = &mask(level, y, 0);
      const std::int64_t sy = ys[static_cast<std::size_t>(y)];
      for (std::int64_t x = 0; x < W; ++x, feature += d) {
        const std::int64_t sx = xs[static_cast<std::size_t>(x)];
        // A quarter turn counter-clockwise moves column c of the picture to row W - 1 - c.
        const std::int32_t row =
            sy < 0 || sx < 0 ? -1
                             : rows[turned ? sx * label_W + label_W - 1 - sy : sy * label_W + sx];
        const bool known = row >= 0 && usable[static_cast<std::size_t>(row)] != 0;
        labelled[x] = known ? 1.0f : 0.0f;
        if (known)
          std::copy_n(&labels.codes(row, 0), d, feature);
        else
          std::fill_n(feature, d, 0.0f);
      }
    }
  }
}

}  // namespace lvggt
