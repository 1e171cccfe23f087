#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# evaluate_cup.sh SCENE [OUT]: the whole way from a labelled scene to the tables: tokens, autoencoders, decoders,
# scores and pictures. The annotated frames are held out of everything that learns. What is done already is kept, so
# the same command goes on after an interruption. Three minutes on two idle cores.
set -euo pipefail
scene=$(realpath "${1:?give the labelled scene, such as cup}")
out=${2:-out/evaluate_cup}
here=$(cd "$(dirname "$0")/.." && pwd)
programs=${LVGGT_BUILD:-$here/build/release}
config=$here/examples/data/cup_train.json

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

if [[ ! -e model.safetensors ]]; then
  "$programs/weights/weights_init" --config "$config" --seed 1 model.safetensors
fi
"$programs/examples/train_autoencoder" "$name" --held-out-frames "$annotated" --output autoencoder --encode --resume
"$programs/examples/train_autoencoder" "$name" --supervision dynamic --held-out-frames "$annotated" \
  --learning-rate 7e-4 --epochs 40 --output state_autoencoder --encode --resume
# Smaller frames let the decoder see more of the scene at once, which states need and edges do not. Tokens of each
# frame alone do not tell how late it is in the clip: a decoder would learn that instead of the state.
"$programs/examples/make_tokens" "$name" --weights model.safetensors --size 196 --out tokens --resume
"$programs/examples/make_tokens" "$name" --weights model.safetensors --size 182 --max-past-frames 1 --out state_tokens \
  --resume
"$programs/examples/train_decoder" "$name" --tokens tokens --config "$config" --held-out-frames "$annotated" --batch 4 \
  --steps 300 --learning-rate 3e-3 --schedule cosine --warmup-steps 10 --evaluate-every 60 --loss-cos 0.5 \
  --output decoder --resume
"$programs/examples/train_decoder" "$name" --supervision dynamic --tokens state_tokens --config "$config" \
  --held-out-frames "$annotated" --batch 4 --steps 400 --no-rgb --learning-rate 2e-3 --schedule cosine --warmup-steps 10 \
  --evaluate-every 80 --loss-cos 0.5 --output state_decoder --resume
"$programs/examples/evaluate" "$name" --tokens tokens --state-tokens state_tokens \
  --method "4DLangVGGT's decoder on an untrained encoder" --decoder decoder/decoder.safetensors --state-decoder state_decoder/decoder.safetensors \
  --autoencoder autoencoder/autoencoder.safetensors --state-autoencoder state_autoencoder/autoencoder.safetensors \
  --text-encoder "$name/text/phrases_512.npy" --sentence-encoder "$name/text/sentences_4096.npy" \
  --per-phrase --out scores --force
