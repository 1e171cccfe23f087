#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# Trains what first_run.sh brings along, on the bundled clip and its labels: the decoder, the state decoder and the two
# autoencoders of examples/data/first_run.
#   bash examples/train_first_run.sh WORK    WORK: a folder for everything on the way
set -euo pipefail
work=$(realpath -m "${1:?give a folder to work in}")
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bin=build/release
data=examples/data
cmake --preset release >/dev/null
cmake --build --preset release --parallel "$(nproc)" --target weights_quantize make_tokens \
  train_autoencoder train_decoder

mkdir -p "$work"
tar -xJf $data/cup_scene.tar.xz -C "$work"
# The bundled small model sees the frames.
$bin/examples/make_tokens "$work/cup" --out "$work/tokens" --force

# Words have the published shape; the stand-in sentences have 256 numbers instead of 4096, and a smaller autoencoder.
$bin/examples/train_autoencoder "$work/cup" --supervision clip --learning-rate 2e-3 --epochs 400 \
  --encode --output "$work/autoencoder" --force
$bin/examples/train_autoencoder "$work/cup" --supervision dynamic --learning-rate 2e-3 --epochs 400 \
  --encoder-widths 128,64,32,6 --decoder-widths 32,64,128,256 --encode --output "$work/state_autoencoder" --force

decoder=(--tokens "$work/tokens" --config weights/small_model/config.json --out-channels 32 64 96 96
  --batch 4 --schedule cosine --warmup-steps 10 --force)
$bin/examples/train_decoder "$work/cup" "${decoder[@]}" --steps 180 --learning-rate 3e-3 --loss-cos 0.1 --hold-out-every 8 --evaluate-every 60 \
  --output "$work/decoder"
# The states of a few frames cannot be held out: all 24 are learnt.
$bin/examples/train_decoder "$work/cup" "${decoder[@]}" --supervision dynamic --no-rgb --steps 600 --learning-rate 2e-3 \
  --loss-cos 0.5 --output "$work/state_decoder"

to=$data/first_run
for name in decoder state_decoder; do
  $bin/weights/weights_quantize --storage f16 --force "$work/$name/decoder.safetensors" $to/$name.safetensors
done
# A question needs their decoders only.
for name in autoencoder state_autoencoder; do
  $bin/weights/weights_quantize --storage f32 --drop encoder. --force "$work/$name/autoencoder.safetensors" $to/$name.safetensors
done
cp "$work"/cup/text/{phrases,sentences}.{npy,json} $to
