#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# From a fresh Debian 12 machine to pictures: installs what is missing, builds the programs, makes the weights
# of a small model and lifts the bundled clip.
#   bash examples/first_run.sh [FOLDER]      FOLDER: where the results go, out/first_run unless given
set -euo pipefail
out=${1:+$(realpath -m "$1")}
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=${out:-out/first_run}

bash tests/setup.sh
if command -v ccache >/dev/null; then
  export CMAKE_CXX_COMPILER_LAUNCHER=ccache
fi
cmake --preset release >/dev/null
cmake --build --preset release --parallel "$(nproc)" --target lift_video weights_init

mkdir -p "$out"
build/release/weights/weights_init --config examples/data/small.json --seed 1 --force "$out/model.safetensors"
build/release/examples/lift_video examples/data/cup_24.mp4 --weights "$out/model.safetensors" --size 168 \
  --out "$out/cup" --force
echo "Open $out/cup/contact_sheet.png (the weights are made from a rule, not trained: it shows that everything runs, not what is in the video)."
