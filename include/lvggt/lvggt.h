// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/arena.h"
#include "lvggt/core/context.h"
#include "lvggt/core/error.h"
#include "lvggt/core/float16.h"
#include "lvggt/core/parallel.h"
#include "lvggt/core/shape.h"
#include "lvggt/core/tensor.h"
