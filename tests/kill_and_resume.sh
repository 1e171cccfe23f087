#!/usr/bin/env bash
# SPDX-License-Identifier: Apache-2.0
# kill_and_resume.sh KILLS OUTPUT COMMAND...: runs a training to its end in OUTPUT/whole; then again in OUTPUT/cut,
# killed (SIGKILL) KILLS times at random moments and resumed each time; and compares the final weights, the
# newest checkpoint and every loss. COMMAND is train_decoder with its options but --output.
#   bash tests/kill_and_resume.sh 10 /tmp/kills build/release/examples/train_decoder SCENE --steps 60 ...
set -euo pipefail
kills=$1
output=$2
shift 2
mkdir -p "$output"

start=$(date +%s%N)
"$@" --output "$output/whole" --force 2>"$output/whole.err"
whole_ms=$((($(date +%s%N) - start) / 1000000))
echo "uninterrupted: $((whole_ms / 1000)) s"

rm -rf "$output/cut"
done_steps() { tail -n 1 "$output/cut/log.jsonl" 2>/dev/null | grep -o '"step": [0-9]*' | cut -d' ' -f2 || true; }
for ((kill_idx = 1; kill_idx <= kills; ++kill_idx)); do
  "$@" --output "$output/cut" --resume 2>"$output/cut.err" &
  child=$!
  # Anywhere in a stretch a little longer than the run would be if the kills divided it evenly.
  sleep "$(awk -v r="$RANDOM" -v ms="$whole_ms" -v n="$kills" 'BEGIN { print r / 32768 * 3 * ms / n / 1000 }')"
  kill -KILL "$child" 2>/dev/null || true
  wait "$child" 2>/dev/null || true
  echo "kill $kill_idx: after step $(done_steps)"
done
"$@" --output "$output/cut" --resume 2>"$output/cut.err"
grep -E "goes on|DAMAGED|anew" "$output/cut.err" || true

cmp "$output/whole/decoder.safetensors" "$output/cut/decoder.safetensors"
newest=$(cd "$output/whole/checkpoints" && ls step_*.safetensors | tail -n 1)
cmp "$output/whole/checkpoints/$newest" "$output/cut/checkpoints/$newest"
cmp <(sed 's/, "seconds".*//' "$output/whole/log.jsonl") <(sed 's/, "seconds".*//' "$output/cut/log.jsonl")
echo "killed $kills times: weights, optimiser state and all $(wc -l <"$output/whole/log.jsonl") lines of the log are the same"
