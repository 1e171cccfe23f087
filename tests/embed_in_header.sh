#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# embed_in_header.sh SOURCE_DIR: the program that lvggt/lvggt.h and the README show is the one that is built and run.
set -euo pipefail
program=$(sed '1,2d' "$1/examples/embed/main.cc")
in_header=$(sed -n 's|^//   ||p; s|^//$||p' "$1/include/lvggt/lvggt.h")
in_readme=$(sed -n '/^```cpp/,/^```/p' "$1/README.md" | sed '/^```/d')
[[ $in_header == *"$program"* ]] || { echo "include/lvggt/lvggt.h shows another program than examples/embed/main.cc" >&2; exit 1; }
[[ $in_readme == *"$program"* ]] || { echo "README.md shows another program than examples/embed/main.cc" >&2; exit 1; }
