#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# ship.sh RUN [CUP]: from a training's folder to everything that ships: the model, its SHA-256 in the programs, the reference
# values of the test, the log, the curve and the scores (CUP: the labelled cup clip). The card's text is for people to write.
set -euo pipefail
run=$(realpath "${1:?give the folder of the training}")
cup=${2:+$(realpath "$2")}
cd "$(dirname "${BASH_SOURCE[0]}")"
python=${PYTHON:-/usr/bin/python3}
model=lvggt_small.safetensors

"$python" export.py "$run/checkpoint.pt" "$model"
sum=$(sha256sum "$model" | cut -d' ' -f1)
sed -i -E "s/\"[0-9a-f]{64}\"/\"$sum\"/" ../../include/lvggt/model/small_model.h
"$python" export.py --dump ../../tests/golden/small_model.safetensors --frames 2 "$model"
cp "$run/log.jsonl" log.jsonl
"$python" curve.py log.jsonl curve.svg
size=$("$python" -c 'import json; s = json.load(open("config.json"))["img_size"]; print(f"{s * 3 // 4 // 14 * 14}x{s}")')
"$python" evaluate.py "$model" --size "$size" ${cup:+--cup "$cup"} --json scores.json
