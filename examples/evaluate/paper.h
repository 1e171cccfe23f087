// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>

namespace evaluate {

// A row of the paper's tables: averages over a data set's scenes, in percent.
struct PaperRow {
  const char* method;
  double first, second;  // mIoU, mAcc or Acc, vIoU
};

inline constexpr std::array<PaperRow, 6> kHyperNerfMasks{{
    {"LangSplat", 73.54, 97.72},
    {"Feature-3DGS", 38.40, 70.75},
    {"Gaussian Grouping", 57.02, 82.22},
    {"4DLangSplat", 82.95, 98.59},
    {"4DLangVGGT, one model a scene", 85.02, 98.77},
    {"4DLangVGGT, one model for all", 83.99, 98.67},
}};

inline constexpr std::array<PaperRow, 6> kHyperNerfStates{{
    {"LangSplat", 54.01, 22.65},
    {"Deformable CLIP", 61.80, 44.72},
    {"Non-Status Field", 87.58, 68.57},
    {"4DLangSplat", 90.83, 72.26},
    {"4DLangVGGT, one model a scene", 90.86, 73.06},
    {"4DLangVGGT, one model for all", 91.44, 74.74},
}};

inline constexpr std::array<PaperRow, 6> kNeu3dMasks{{
    {"Feature-3DGS", 34.46, 90.47},
    {"Gaussian Grouping", 57.51, 94.79},
    {"LangSplat", 60.93, 98.04},
    {"4DLangSplat", 85.19, 99.30},
    {"4DLangVGGT, one model a scene", 87.41, 99.41},
    {"4DLangVGGT, one model for all", 85.64, 99.37},
}};

}  // namespace evaluate
