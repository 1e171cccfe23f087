#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Trains the small model on scenes rendered as it goes. Interrupted, it continues with --resume.

  train.py RUN --stage 56x84:14x2,7x4:3000:7e-4 --stage 112x154:8x2,4x4:60m:3e-4

A stage: the frames' size; the kinds of batches, taken in turns, clips x frames; how many steps, or minutes; the
learning rate, which falls by half a cosine, to a half and in the last stage to a fiftieth. A quarter of a batch's clips are
new, the others come back mirrored or backwards. RUN gets checkpoint.pt (every few minutes, the weights' running average
included), log.jsonl (losses and scores), arguments.json.
"""
import argparse
import collections
import concurrent.futures
import json
import math
import os
import pathlib
import signal
import sys
import time

import numpy as np
import torch

import attention
import evaluate
import matching
import model as small
import scenes
import tuned
from helper import Helper
from muon import Muon
from shared_layers import SharedLayers

TRAIN_SEED = 10_000_000      # batch k of stage s with --seed n: TRAIN_SEED * (10 (n - 1) + s + 1) + 64 k, and from n = 10 on
BEYOND = 2_000_000_000       # so much more, because training never uses those between
HELD_OUT_SEED = 900_000_000
MUON_RATE = 3                # its learning rate beside AdamW's


class Stage:
    def __init__(self, text):
        size, kinds, steps, rate = text.split(":")
        self.height, self.width = map(int, size.split("x"))
        self.kinds = [tuple(map(int, kind.split("x"))) for kind in kinds.split(",")]
        self.minutes = float(steps[:-1]) if steps.endswith("m") else 0
        self.steps, self.rate = 0 if self.minutes else int(steps), float(rate)

    def plan(self, k):
        clips, frames = self.kinds[k % len(self.kinds)]
        return (clips + 3) // 4, frames, self.height, self.width

    def done(self, k, seconds):
        """The part of the stage that k steps and so many seconds are."""
        return seconds / 60 / self.minutes if self.minutes else k / self.steps

    def learning_rate(self, k, done, last, warm=100):
        end = 0.02 if last else 0.5
        fall = end + (1 - end) * 0.5 * (1 + math.cos(math.pi * min(done, 1)))
        return self.rate * fall * min(1, (k + 1) / warm)


class Recent:
    """Clips seen a few steps before, to be seen three times more: mirrored and backwards, backwards, mirrored."""
    CHANGES = (lambda clip: scenes.mirrored(scenes.backwards(clip)), scenes.backwards, scenes.mirrored)

    def __init__(self, kinds):
        self.queues, self.kinds, self.turn = [collections.deque(maxlen=3) for _ in range(kinds)], kinds, 0

    def add_old(self, fresh, clips):
        queue = self.queues[self.turn % self.kinds]
        self.turn += 1
        old = [change(clip) for change, seen in zip(self.CHANGES, reversed(queue)) for clip in seen]
        queue.append(fresh)
        return fresh + old[:clips - len(fresh)]


def first_scene(seed):
    return TRAIN_SEED * (10 * (seed - 1) + 1) + (BEYOND if seed > 9 else 0)


def has_muon(name, parameter):
    """Inner matrices of the blocks and the dense head. First and last layers, tokens, vectors and the camera head,
    whose iterations share their weights, learn by AdamW."""
    return (parameter.ndim > 1 and ("blocks." in name or name.startswith("depth_head."))
            and not name.endswith("output_conv2.2.weight"))


class Run:
    def __init__(self, args):
        self.folder = pathlib.Path(args.run)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.stages = [Stage(text) for text in args.stage]
        self.config = small.load_config(args.config)
        self.model = small.make_model(self.config, args.seed)
        self.helper = Helper(self.config)
        self.helper.watch(self.model)
        self.average = small.make_model(self.config, args.seed)
        parts = {}  # of weights that are trained already and learn at a part of the rate
        if args.start_from:
            weights, new = small.deepened(evaluate.load(args.start_from, args.config).state_dict(), self.config["agg_depth"])
            if args.start_from.endswith(".pt") and "helper" in (state := torch.load(args.start_from)):
                self.helper.load_state_dict(state["helper"])
            self.model.load_state_dict(weights)
            self.average.load_state_dict(weights)
            new |= {name for name in weights if name.startswith(tuple(args.new))}
            parts = {name: args.trained_rate for name in weights if name not in new}
        self.choose_learnt(args)
        matching.watch(self.model)
        attention.use(self.model)
        self.shared = SharedLayers(self.model.camera_head)
        matrices = {name: p for name, p in self.learnt.items() if has_muon(name, p)}
        self.muon = Muon(matrices, parts, args.momentum)
        groups = {}
        for name, p in [*self.model.named_parameters(), *self.helper.named_parameters()]:
            if name not in matrices and p.requires_grad:
                groups.setdefault((p.ndim > 1, parts.get(name, 1)), []).append(p)
        self.optimiser = torch.optim.AdamW([{"params": ps, "weight_decay": 0.02 * matrix, "part": part}
                                            for (matrix, part), ps in groups.items()], lr=0, betas=(0.9, 0.98), foreach=True)
        self.stage, self.step, self.total, self.spent, self.stop = 0, 0, 0, 0.0, False
        self.bf16, self.depth_part, self.first_scene = args.bf16, args.depth_part, first_scene(args.seed)
        self.decay = args.average
        self.save_every, self.score_every = 60 * args.save_minutes, args.score_every
        if args.resume:
            self.load()
        elif (self.folder / "checkpoint.pt").exists():
            sys.exit(f"train.py: {self.folder} has a checkpoint; --resume continues it")
        (self.folder / "arguments.json").write_text(json.dumps(vars(args), indent=1))

    def choose_learnt(self, args):
        """Those weights that args.learn names, or all; the depth head's only where depth has a loss."""
        for option, name in [("learn", name) for name in args.learn] + [("new", name) for name in args.new]:
            if not any(weight.startswith(name) for weight, _ in self.model.named_parameters()):
                sys.exit(f"train.py: --{option}: no weight's name begins with {name!r}, such as \"camera_head\" or "
                         "\"aggregator.global_blocks.3.\"")
        for name, p in self.model.named_parameters():
            p.requires_grad_((not args.learn or name.startswith(tuple(args.learn)))
                             and (args.depth_part > 0 or not name.startswith("depth_head.")))
        self.learnt = {name: p for name, p in self.model.named_parameters() if p.requires_grad}
        if not self.learnt:
            sys.exit("train.py: --learn names the depth head only, and --depth-part 0 leaves it no loss")
        # Apart, because the camera head's iterations make its gradients far larger.
        self.cameras = [p for name, p in self.learnt.items() if name.startswith("camera_head.")]
        self.dense = [p for name, p in self.learnt.items() if not name.startswith("camera_head.")]
        self.tokens = any(name.startswith("aggregator.") for name in self.learnt)

    def say(self, **entry):
        with open(self.folder / "log.jsonl", "a") as file:
            file.write(json.dumps(entry) + "\n")
        print(json.dumps(entry), flush=True)

    def state(self):
        return {"model": self.model.state_dict(), "average": self.average.state_dict(),
                "helper": self.helper.state_dict(), "optimiser": self.optimiser.state_dict(),
                "muon": self.muon.state_dict(), "stage": self.stage, "step": self.step, "total": self.total, "spent": self.spent}

    def save(self):
        path = self.folder / "checkpoint.pt"
        torch.save(self.state(), f"{path}.tmp")
        os.replace(f"{path}.tmp", path)

    def load(self):
        state = torch.load(self.folder / "checkpoint.pt")
        for name in ("model", "average", "helper", "optimiser", "muon"):
            getattr(self, name).load_state_dict(state[name])
        self.stage, self.step, self.total, self.spent = (state[k] for k in ("stage", "step", "total", "spent"))

    def one_step(self, batch, rate):
        batch = {k: torch.from_numpy(v) for k, v in batch.items()}
        for group in self.optimiser.param_groups:
            group["lr"] = rate * group["part"]
        self.muon.lr = MUON_RATE * rate
        # Frames of a clip are alike: depth of a part of them leaves time for more clips.
        B, S = batch["depth"].shape[:2]
        dense = torch.cat([b * S + torch.randperm(S)[:math.ceil(S * self.depth_part)] for b in range(B)])
        out = self.model.clips(batch["images"], self.bf16, dense)
        loss, terms = small.objective(out, batch, dense)
        learnt = loss
        if self.tokens:
            terms["helper"], terms["back"] = self.helper.loss(out["blocks"], batch)
            terms["matching"], terms["matched"] = matching.loss(self.model, batch, 1 + self.config["num_register_tokens"])
            learnt = loss + 0.6 * terms["helper"] + 0.12 * terms["matching"]
        self.model.zero_grad(set_to_none=True)
        self.helper.zero_grad(set_to_none=True)
        learnt.backward()
        self.shared.add_gradients()
        norm = sum(torch.nn.utils.clip_grad_norm_(part, 1.0) for part in (self.dense, self.cameras) if part)
        if not math.isfinite(norm):
            raise RuntimeError(f"the gradient of step {self.total} is not finite")
        self.optimiser.step()
        self.muon.step()
        self.total += 1
        decay = min(self.decay, self.total / (self.total + 20))
        with torch.no_grad():
            mean = [p for name, p in self.average.named_parameters() if name in self.learnt]
            torch._foreach_mul_(mean, decay)
            torch._foreach_add_(mean, list(self.learnt.values()), alpha=1 - decay)
        return {**{k: float(v) for k, v in terms.items()}, "loss": float(loss), "norm": float(norm)}

    def score(self, stage, generator):
        scores = evaluate.score_rendered(self.average, generator, HELD_OUT_SEED, 32, 4, stage.height, stage.width)
        images = scenes.targets([generator.clip(HELD_OUT_SEED + i, 2, stage.height, stage.width) for i in range(6)])["images"]
        levels = evaluate.depth_levels(self.average, images)
        self.say(step=self.total, stage=self.stage, held_out={k: np.round(v, 4).tolist() for k, v in scores.items()},
                 depth_levels=[round(share, 3) for share in levels])
        for level, share in enumerate(levels, 1):
            if share < 0.02:
                print(f"train.py: the depth head's level {level} is above 0 in {100 * share:.1f} % of its values only and learns "
                      "next to nothing; revive.py gives a dead level a new start", file=sys.stderr, flush=True)

    def run_stage(self, stage, generator):
        """To its end, or until asked to stop."""
        fresh = scenes.Batches(generator, stage.plan, self.first_scene + TRAIN_SEED * self.stage, self.step)
        recent, sums, begin, clock = Recent(len(stage.kinds)), {}, time.time(), time.time()

        def batch(k):
            return scenes.targets(recent.add_old(next(fresh), stage.kinds[k % len(stage.kinds)][0]))

        ahead = concurrent.futures.ThreadPoolExecutor(1)
        pending = ahead.submit(batch, self.step)
        while stage.done(self.step, self.spent) < 1 and not self.stop:
            rate = stage.learning_rate(self.step, stage.done(self.step, self.spent), stage is self.stages[-1])
            now, pending = pending.result(), ahead.submit(batch, self.step + 1)
            for k, v in self.one_step(now, rate).items():
                sums.setdefault(k, []).append(v)
            self.step += 1
            if self.step % 20 == 0:
                means = {k: round(sum(v) / len(v), 4) for k, v in sums.items()}
                self.say(step=self.total, stage=self.stage, rate=round(rate, 7), **means,
                         seconds=round((time.time() - begin) / len(sums["loss"]), 3), time=round(time.time()))
                sums, begin = {}, time.time()
            if self.step % self.score_every == 0:
                self.score(stage, generator)
                begin = time.time()
            self.spent += time.time() - clock
            clock = time.time()
            if clock - self.saved > self.save_every:
                self.save()
                self.saved = time.time()

    def train(self, generator):
        self.saved = time.time()
        while self.stage < len(self.stages) and not self.stop:
            stage = self.stages[self.stage]
            self.run_stage(stage, generator)
            if self.stop:
                break
            self.score(stage, generator)
            torch.save(self.state(), self.folder / f"stage{self.stage}.pt")
            self.stage, self.step, self.spent = self.stage + 1, 0, 0.0
            self.save()
        self.save()


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("run")
    arguments.add_argument("--stage", action="append", required=True)
    arguments.add_argument("--config", default=str(small.HERE / "config.json"))
    arguments.add_argument("--seed", type=int, default=1, metavar="N",
                           help="of the first weights and of the scenes, 1 to 99")
    arguments.add_argument("--threads", type=int, default=2)
    arguments.add_argument("--bf16", action="store_true", help="products in bfloat16: faster on a CPU with AVX512_BF16")
    arguments.add_argument("--resume", action="store_true")
    arguments.add_argument("--start-from", help="a model's safetensors, or another run's checkpoint with "
                           "this --config: its averaged weights, and its readings if it has them")
    arguments.add_argument("--trained-rate", type=float, default=1, help="learning rate of weights from --start-from, in parts of "
                           "that of blocks that --config has more and of what --new names")
    arguments.add_argument("--new", nargs="+", default=[], metavar="NAME", help="weights whose names begin so learn as new ones "
                           "though --start-from has them, such as those that revive.py started again")
    arguments.add_argument("--average", type=float, default=0.998, help="decay of the weights' running average in a step")
    arguments.add_argument("--momentum", type=float, default=0.95, help="of Muon")
    arguments.add_argument("--learn", nargs="+", default=[], metavar="NAME", help="only weights whose names begin so, such as "
                           "camera_head or aggregator.global_blocks.3.; everything if not given")
    arguments.add_argument("--depth-part", type=float, default=0.25, help="how much of a clip's frames the depth head learns "
                           "from in a step, 0 to 1; 0: cameras alone, the depth head stays as it is")
    arguments.add_argument("--save-minutes", type=float, default=3)
    arguments.add_argument("--score-every", type=int, default=500)
    args = arguments.parse_args()
    if not 0 <= args.depth_part <= 1:
        arguments.error(f"--depth-part: {args.depth_part} is not in 0 to 1")
    if not 1 <= args.seed <= 99:
        arguments.error(f"--seed: {args.seed} is not in 1 to 99")
    if args.new and not args.start_from:
        arguments.error("--new: without --start-from everything is new")
    for name in ("average", "momentum"):
        if not 0 <= getattr(args, name) < 1:
            arguments.error(f"--{name}: {getattr(args, name)} is not at least 0 and less than 1")
    tuned.tune()
    torch.set_num_threads(args.threads)
    run = Run(args)

    def ask_to_stop(*_):
        run.stop = True

    signal.signal(signal.SIGTERM, ask_to_stop)
    signal.signal(signal.SIGINT, ask_to_stop)
    run.say(values=small.count(run.model), stages=args.stage, resumed_at=run.total)
    run.train(scenes.Generator())


if __name__ == "__main__":
    main()
