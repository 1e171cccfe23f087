#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""lvggt beside PyTorch and oneDNN: the same shapes in the same run, as one table.

  cmake --preset release && cmake --build --preset release
  bench/peers/compare.py [--rows REGEX] [--rounds 3] [--weights published.safetensors] [--json FILE]

Each round runs every row once with each library, one after the other (a peer once for all rows that
differ only in our storage types); the table has the medians of the rounds, each row's share of the
multiply-add peak (which our benchmark measures around its own loop) and the fastest peer's time over
ours. Peers: python3-torch (Debian's uses OpenBLAS; install libopenblas0-pthread), and oneDNN if
libdnnl-dev was there when lvggt was built. PyTorch runs with passive OpenMP waiting and a malloc that
keeps its memory, which makes it a quarter faster than as installed. Frames: "torch" is our own
definition of the model, "release" takes the steps of the authors' release. They need a file of weights
(weights_init --seed 3 FILE) and 12 GB of memory.
"""
import argparse
import json
import os
import pathlib
import re
import statistics
import subprocess
import sys

HERE = pathlib.Path(__file__).resolve().parent
TUNED = {"OMP_WAIT_POLICY": "passive", "MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": "20000000000"}
# What keeps the peers to the instruction set that --simd keeps us to.
LIMITS = {"AVX2": {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "DNNL_MAX_CPU_ISA": "AVX2",
                   "OPENBLAS_CORETYPE": "Zen"}}


def rows():
    """Label, our program and benchmark, and each peer's operation."""
    table = []
    for M in (782, 1374):
        for N, K in ((3072, 1024), (1024, 1024), (4096, 1024), (1024, 4096)):
            shape = f"M:{M}/N:{N}/K:{K}/threads:0"
            table.append((f"linear f32 {M}x{N}x{K}", "bench_gemm", f"linear_forward/f32/{shape}",
                          {"torch": ["linear", M, N, K], "onednn": ["linear", M, N, K]}))
            table.append((f"linear int8 {M}x{N}x{K}", "bench_gemm", f"linear_forward/int8/{shape}",
                          {"onednn": ["linear_int8", M, N, K]}))
    for Nq, Nk in ((782, 782), (1374, 1374), (782, 3128), (782, 12512), (782, 50048)):
        for storage in ("f32", "bf16", "int8"):
            table.append((f"attention {storage} {Nq} x {Nk}", "bench_attention",
                          f"scaled_dot_product_attention/{storage}/Nq:{Nq}/Nk:{Nk}/threads:0",
                          {"torch": ["attention", Nq, Nk]}))
    for N in (782, 1374):
        for storage in ("f32", "bf16", "int8"):
            table.append((f"block {storage} {N}", "bench_block", f"block_forward/{storage}/N:{N}/threads:0",
                          {"torch": ["block", N]}))
    for k, cin, cout, H, W in ((3, 256, 256, 168, 296), (3, 256, 128, 168, 296), (3, 128, 128, 168, 296),
                               (3, 128, 32, 294, 518), (3, 32, 32, 294, 518), (1, 2048, 256, 21, 37)):
        args = ["conv", k, cin, cout, H, W]
        table.append((f"conv {k}x{k} {cin}->{cout} {H}x{W}", "bench_conv",
                      f"conv2d_forward/kernel:{k}/Cin:{cin}/Cout:{cout}/H:{H}/W:{W}",
                      {"torch": args, "onednn": args}))
    table.append(("bilinear 256 channels to 294x518", "bench_conv", "bilinear_forward/C:256", {"torch": ["bilinear", 256]}))
    for past in (1, 3):
        for storage, cache in (("f32", "f32"), ("int8", "bf16")):
            table.append((f"frame {storage}, cache {cache}, {past} past", "bench_frame", f"{storage}/{cache}/{past + 1}",
                          {"torch": ["frame", 518, past + 1], "release": ["release", 518, past + 1]}))
    for storage, cache in (("f32", "f32"), ("int8", "bf16")):
        table.append((f"stream {storage}, cache {cache}, median of 8 frames", "bench_frame", f"{storage}/{cache}/8/median",
                      {"torch": ["stream", 518, 8]}))
    return table


def run(command, extra=None):
    env = dict(os.environ, **(extra or {}))
    done = subprocess.run([str(c) for c in command], env=env, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"compare: {' '.join(map(str, command))} failed:\n{done.stderr.strip()}")
    return done.stdout


def ours(args, program, name):
    """Milliseconds, and percent of peak."""
    command = [args.build / "bench" / program, "--benchmark_format=json", "--benchmark_min_time=0.5"]
    if args.simd:
        command.append(f"--simd={args.simd}")
    if program == "bench_frame":
        storage, cache, frames, *median = name.split("/")
        command += [f"--weights={args.weights}", f"--frames={frames}", f"--weights-storage={storage}", f"--cache-storage={cache}"]
        name = ".*"
    else:
        command.append(f"--benchmark_filter=^{name}(/manual_time|/real_time)?$")
    found = json.loads(run(command))["benchmarks"]
    if not found:
        sys.exit(f"compare: {program} has no benchmark {name}")
    if program == "bench_frame" and median:
        return [statistics.median(f[key] for f in found) * unit for key, unit in (("real_time", 1e3), ("%peak", 1))]
    last = found[-1]  # of the frames, the last
    return last["real_time"] * {"ms": 1, "s": 1e3}[last["time_unit"]], last.get("%peak")


def peer(args, name, operation):
    if name in ("torch", "release"):
        return float(run([args.python, HERE / "torch_peer.py", *operation], {**TUNED, **LIMITS.get(args.simd, {})}))
    return float(run([args.build / "bench" / "onednn_peer", *operation], LIMITS.get(args.simd, {})))


def available(args):
    """The peers that this machine has."""
    found = []
    if subprocess.run([args.python, "-c", "import torch"], capture_output=True).returncode == 0:
        found += ["torch", "release"]
    if (args.build / "bench" / "onednn_peer").exists():
        found.append("onednn")
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rows", default="", help="regular expression that a row's label must contain")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--simd", default="", help="limit all to an instruction set: AVX2")
    parser.add_argument("--weights", help="weights of the published configuration, for the frame rows")
    parser.add_argument("--build", type=pathlib.Path, default=HERE.parents[1] / "build" / "release")
    parser.add_argument("--python", default="/usr/bin/python3", help="a Python that has torch")
    parser.add_argument("--json", help="write every measurement there")
    args = parser.parse_args()
    chosen = [r for r in rows() if re.search(args.rows, r[0]) and (args.weights or r[1] != "bench_frame")]
    if not chosen:
        sys.exit(f"compare: no row matches '{args.rows}'")
    peers = [p for p in available(args) if any(p in r[3] for r in chosen)]
    times = {label: {name: [] for name in ["lvggt", *peers]} for label, *_ in chosen}
    shares = {label: [] for label, *_ in chosen}
    for turn in range(args.rounds):
        measured = {}  # rows that differ in our storage types share the peer's time
        for i, (label, program, name, operations) in enumerate(chosen):
            print(f"\rround {turn + 1}/{args.rounds}, row {i + 1}/{len(chosen)}: {label:40s}", end="", file=sys.stderr)
            ms, share = ours(args, program, name)
            times[label]["lvggt"].append(ms)
            if share is not None:
                shares[label].append(share)
            for p in peers:
                if p in operations:
                    key = (p, *operations[p])
                    if key not in measured:
                        measured[key] = peer(args, p, operations[p])
                    times[label][p].append(measured[key])
    print(file=sys.stderr)
    print("| row | lvggt ms | of peak | " + " | ".join(f"{p} ms" for p in peers) + " | best peer / lvggt |")
    print("|---|---|---|" + "---|" * (len(peers) + 1))
    for label, *_ in chosen:
        medians = {p: statistics.median(t) for p, t in times[label].items() if t}
        best = min((m for p, m in medians.items() if p != "lvggt"), default=None)
        cells = [f"{medians[p]:.3g}" if p in medians else "" for p in peers]
        share = f"{statistics.median(shares[label]):.0f} %" if shares[label] else ""
        ratio = f"{best / medians['lvggt']:.2f}" if best else ""
        print(f"| {label} | {medians['lvggt']:.3g} | {share} | " + " | ".join(cells) + f" | {ratio} |")
    if args.json:
        pathlib.Path(args.json).write_text(json.dumps({"milliseconds": times, "percent_of_peak": shares}, indent=1))


if __name__ == "__main__":
    main()
