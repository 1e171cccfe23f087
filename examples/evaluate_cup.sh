#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# evaluate_cup.sh SCENE [OUT]: the whole way from a labelled scene to the tables: tokens, autoencoders, decoders,
# scores and pictures. The annotated frames are held out of everything that learns. What is done already is kept, so
# the same command goes on after an interruption. Eight minutes on two idle cores.
set -euo pipefail
scene=$(realpath "${1:?give the labelled scene, such as cup}")
out=${2:-out/evaluate_cup}
here=$(cd "$(dirname "$0")/.." && pwd)
programs=${LVGGT_BUILD:-$here/build/release}

# The codes of the autoencoders go beside links to the scene's own folders, not into them.
name=$(basename "$scene")
mkdir -p "$out/$name"
for folder in rgb annotations clip_features video_features text; do
  ln -sfn "$scene/$folder" "$out/$name/$folder"
done
cd "$out"

# Frames whose masks are annotated, as 2,5,8,...
annotated=$(grep -o '"file_name": *"[0-9]*' "$name/annotations/train/_annotations.coco.json" |
  sed 's/.*"0*//' | sort -n | paste -sd, -)

"$programs/examples/train_autoencoder" "$name" --held-out-frames "$annotated" --output autoencoder --encode --resume
"$programs/examples/train_autoencoder" "$name" --supervision dynamic --held-out-frames "$annotated" \
  --learning-rate 7e-4 --epochs 40 --output state_autoencoder --encode --resume
# What the bundled small model sees of each frame alone: tokens that know the frames before tell how late it is in the
# clip, and a decoder would learn that instead of the state.
"$programs/examples/make_tokens" "$name" --max-past-frames 1 --out tokens --resume
decoder=(--tokens tokens --config "$here/weights/small_model/config.json"
  --held-out-frames "$annotated" --batch 4 --schedule cosine --warmup-steps 10 --evaluate-every 100 --loss-cos 0.5 --resume)
"$programs/examples/train_decoder" "$name" "${decoder[@]}" --out-channels 48 64 96 96 --seed 3 --steps 680 --learning-rate 2e-3 \
  --ema 0.98 --output decoder
"$programs/examples/train_decoder" "$name" "${decoder[@]}" --supervision dynamic --no-rgb --out-channels 32 64 96 96 --steps 500 \
  --learning-rate 2e-3 --output state_decoder
"$programs/examples/evaluate" "$name" --tokens tokens \
  --method "4DLangVGGT's decoder on the small model" --decoder decoder/decoder.safetensors --state-decoder state_decoder/decoder.safetensors \
  --autoencoder autoencoder/autoencoder.safetensors --state-autoencoder state_autoencoder/autoencoder.safetensors \
  --text-encoder "$name/text/phrases_512.npy" --sentence-encoder "$name/text/sentences_4096.npy" \
  --per-phrase --out scores --force
