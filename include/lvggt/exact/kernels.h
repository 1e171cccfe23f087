// SPDX-License-Identifier: Apache-2.0
#pragma once

// Plain float64 kernels with the signatures of the fast ones: for checking mathematics, not for
// speed. With them every layer of lvggt/train runs on double.
#include "lvggt/exact/conv2d.h"
#include "lvggt/exact/elementwise.h"
#include "lvggt/exact/linear.h"
#include "lvggt/exact/loss.h"
#include "lvggt/exact/norm.h"
