# SPDX-License-Identifier: Apache-2.0
"""Muon (Jordan et al. 2024): momentum whose matrices are made near-orthogonal before they are applied, so that
all directions of a layer learn at one pace. Several times fewer steps than AdamW for a small transformer."""
import collections

import torch

NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)  # of the odd polynomial that drives singular values towards 1
ITERATIONS = 5


def orthogonal(matrices):
    """[N, r, c], r <= c: each matrix's singular values drawn near 1."""
    a, b, c = NEWTON_SCHULZ
    x = matrices / (matrices.norm(dim=(1, 2), keepdim=True) + 1e-7)
    x = x.bfloat16()
    for _ in range(ITERATIONS):
        gram = x @ x.mT
        x = a * x + (b * gram + c * (gram @ gram)) @ x
    return x.float()


def as_matrices(name, parameter, gradient):
    """The matrices a weight consists of: a qkv weight's are three; a convolution's taps belong to its inputs."""
    parts = 3 if name.endswith("qkv.weight") else 1
    return gradient.reshape(parts, parameter.shape[0] // parts, -1)


class Muon:
    """For a dictionary of weights with two or more dimensions. `lr` compares with AdamW's: updates are scaled
    to a root mean square of 0.2 lr (Liu et al. 2025). parts: of weights that learn at a part of it."""

    def __init__(self, weights, parts, momentum=0.95, weight_decay=0.02):
        self.weights, self.parts, self.momentum, self.weight_decay, self.lr = weights, parts, momentum, weight_decay, 0.0
        self.buffers = {name: torch.zeros_like(p) for name, p in weights.items()}

    def state_dict(self):
        return self.buffers

    def load_state_dict(self, buffers):
        for name, buffer in self.buffers.items():
            buffer.copy_(buffers[name])

    @torch.no_grad()
    def step(self):
        groups = collections.defaultdict(list)
        for name, p in self.weights.items():
            buffer = self.buffers[name]
            buffer.lerp_(p.grad, 1 - self.momentum)
            m = as_matrices(name, p, p.grad.lerp(buffer, self.momentum))
            upright = m.shape[1] > m.shape[2]
            m = m.mT if upright else m
            groups[m.shape[1:]].append((p, m, upright, self.lr * self.parts.get(name, 1)))
        for (rows, columns), members in groups.items():
            update = orthogonal(torch.cat([m for _, m, _, _ in members])) * (0.2 * columns ** 0.5)
            begin = 0
            for p, m, upright, lr in members:
                u = update[begin:begin + len(m)]
                begin += len(m)
                p.mul_(1 - lr * self.weight_decay)
                p.sub_((u.mT if upright else u).reshape(p.shape), alpha=lr)
