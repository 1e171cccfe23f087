#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Attention of whole clips in training, from queries, keys and values on, by kernels/attention.cc: what ../pytorch
computes, and a step takes little more than half the time.
  attention.py      compares both, and says how long each takes"""
import copy
import ctypes
import functools
import time

import torch

import scenes

HEAD = 32   # values of a head that attention.cc is for
KEPT = 2    # heads whose queries and keys a training may want to see
POINTERS = ("qkv", "out", "log_sums", "shaped_q", "shaped_k", "dout", "dqkv", "dshape", "dshaped_q", "dshaped_k", "q_weight", "q_bias",
            "q_cosines", "q_sines", "k_weight", "k_bias", "k_cosines", "k_sines")
SIZES = ("clips", "heads", "tokens", "frame", "shaped", "threads")


class Call(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in POINTERS] + [(name, ctypes.c_int64) for name in SIZES]


def level():
    """Of the x86-64 instruction sets, the largest that this processor has: a library is built for each and chosen when it runs."""
    with open("/proc/cpuinfo") as file:
        flags = next((set(line.split()) for line in file if line.startswith("flags")), set())
    for name, needed in (("v4", {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"}), ("v3", {"avx2", "fma", "bmi2"})):
        if needed <= flags:
            return name
    return None


@functools.lru_cache(maxsize=None)
def library():
    name = level()
    flags = [f"-march=x86-64-{name}"] if name else []
    built = scenes.build_library(f"kernels_{name or 'any'}", scenes.HERE / "kernels", [*flags, "-fopenmp", "-Wno-psabi"])
    return ctypes.CDLL(str(built))


def call(function, heads, frame, **tensors):
    tensors = {name: t for name, t in tensors.items() if t is not None}
    for name, t in tensors.items():
        if t.dtype != torch.float32 or not t.is_contiguous():
            raise ValueError(f"attention: {name} is not contiguous float32")
    clips, tokens, _ = tensors["out"].shape
    sizes = dict(clips=clips, heads=heads, tokens=tokens, frame=frame, shaped=KEPT, threads=torch.get_num_threads())
    function(ctypes.byref(Call(**{name: t.data_ptr() for name, t in tensors.items()}, **sizes)))


class Attention(torch.autograd.Function):
    @staticmethod
    def forward(ctx, qkv, q_weight, q_bias, k_weight, k_bias, cosines, sines, heads, frame, keep):
        clips, tokens, width = qkv.shape
        out, log_sums = qkv.new_empty(clips, tokens, width // 3), qkv.new_empty(clips, heads, tokens)
        shaped = [qkv.new_empty(clips, KEPT, tokens, HEAD) for _ in range(2)] if keep else [None, None]
        ctx.shape = dict(q_weight=q_weight, q_bias=q_bias, k_weight=k_weight, k_bias=k_bias, q_cosines=cosines, q_sines=sines,
                         k_cosines=cosines, k_sines=sines)
        ctx.sizes = heads, frame
        call(library().small_model_attention, heads, frame, qkv=qkv, out=out, log_sums=log_sums, shaped_q=shaped[0],
             shaped_k=shaped[1], **ctx.shape)
        ctx.save_for_backward(qkv, out, log_sums)
        ctx.set_materialize_grads(False)
        return out, *shaped

    @staticmethod
    def backward(ctx, dout, dshaped_q, dshaped_k):
        qkv, out, log_sums = ctx.saved_tensors
        dqkv, dshape = torch.empty_like(qkv), qkv.new_empty(*log_sums.shape[:2], 4, HEAD)
        dout, dshaped_q, dshaped_k = (t if t is None else t.float().contiguous() for t in (dout, dshaped_q, dshaped_k))
        call(library().small_model_attention_gradients, *ctx.sizes, qkv=qkv, out=out, log_sums=log_sums, dqkv=dqkv, dshape=dshape,
             dout=torch.zeros_like(out) if dout is None else dout, dshaped_q=dshaped_q, dshaped_k=dshaped_k, **ctx.shape)
        norms = dshape.sum((0, 1)) if ctx.shape["q_weight"] is not None else [None] * 4
        return (dqkv, *norms, *[None] * 5)


def attend(module, x, rope=None, cache=None, frame=None):
    """In place of a torch_geometry.Attention's forward, without cache."""
    norms = [getattr(norm, name, None) for norm in (module.q_norm, module.k_norm) for name in ("weight", "bias")]
    tables = (None, None) if rope is None else (rope.cos, rope.sin)
    out, q, k = Attention.apply(module.qkv(x).float(), *norms, *tables, module.heads, frame or x.shape[1],
                                module.kept is not None)
    if module.kept is not None:
        module.kept.append((q, k))
    return module.proj(out)


def use(model):
    """In the blocks of an encoder that trains."""
    for module in model.aggregator.modules():
        if getattr(module, "heads", 0) and module.proj.in_features == HEAD * module.heads:
            module.forward = functools.partial(attend, module)


def main():
    import model  # noqa: F401 finds torch_geometry
    import torch_geometry
    torch.manual_seed(1)
    special, h, w = 5, 12, 17
    for clips, frames in ((24, 1), (6, 4), (3, 7)):
        plain = torch_geometry.Attention(128, 4, True)
        for p in plain.parameters():
            torch.nn.init.normal_(p, 0.3 if p.ndim == 1 else 0, 0.3)
        fast = copy.deepcopy(plain)
        fast.forward = functools.partial(attend, fast)
        frame = special + h * w
        rope = torch_geometry.Rope2d(h, w, HEAD, special=special, frames=frames)
        x, given = torch.randn(clips, frames * frame, 128), torch.randn(clips, frames * frame, 128)
        results = []
        for way in (plain, fast):
            way.kept = []
            for _ in range(3):
                start = x.clone().requires_grad_()
                begin = time.perf_counter()
                out = way(start, rope, None, frame)
                middle = time.perf_counter()
                q, k = (t[:, :KEPT] for t in way.kept.pop())
                loss = (out * given).sum() + (q * k.roll(1, 2)).square().sum()
                gradients = torch.autograd.grad(loss, [start, *way.parameters()])
                times = middle - begin, time.perf_counter() - middle
            results.append((out.detach(), *gradients))
            print(f"{clips} clips of {frames} frames, {'attention.cc' if way is fast else 'PyTorch'}: {1e3 * times[0]:.0f} ms, "
                  f"gradients {1e3 * times[1]:.0f} ms")
        off = [((a - b).abs().max() / a.abs().max()).item() for a, b in zip(*results)]
        print(f"  apart by {max(off):.1e} of the largest value at most")
        if not max(off) < 2e-5:
            raise SystemExit(f"attention.py: attention.cc does not compute what PyTorch does: {off}")


if __name__ == "__main__":
    main()
