#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# From a fresh Debian 12 machine to pictures: installs what is missing, builds the programs, lifts the bundled
# clip with the bundled small model and asks it in words.
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
cmake --build --preset release --parallel "$(nproc)" --target lift_video query_video

mkdir -p "$out"
words=examples/data/first_run
build/release/examples/lift_video examples/data/cup_24.mp4 --decoder $words/decoder.safetensors \
  --state-decoder $words/state_decoder.safetensors --out "$out/cup" --force
build/release/examples/query_video "$out/cup" bottle hand unicorn --state "the bottle is tilted" \
  --text-encoder $words/phrases.npy --autoencoder $words/autoencoder.safetensors \
  --sentence-encoder $words/sentences.npy --state-autoencoder $words/state_autoencoder.safetensors --out "$out/answer" --force
cat <<END
Open $out/answer/answers.png, $out/answer/time_lines.png, $out/cup/contact_sheet.png and $out/cup/cloud.png.
The geometry was trained on rendered scenes only (weights/small_model/README.md); both decoders and autoencoders on this clip
(examples/train_first_run.sh); the phrases' embeddings are stand-ins, fixed random vectors instead of CLIP's and e5's.
END
