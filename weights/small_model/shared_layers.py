# SPDX-License-Identifier: Apache-2.0
"""Layers that a model uses many times in a step with few rows each, as the camera head does in every iteration of every frame: the gradients of their
weights are computed once a step, from the rows of all uses together, instead of added up."""
import functools

import torch
import torch.nn as nn
import torch.nn.functional as F


class Linear(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, weight, bias, uses):
        ctx.save_for_backward(x, weight)
        ctx.uses = uses
        return F.linear(x, weight, bias)

    @staticmethod
    def backward(ctx, given):
        x, weight = ctx.saved_tensors
        ctx.uses.append((x, given))
        return (given @ weight if ctx.needs_input_grad[0] else None), None, None, None


class SharedLayers:
    """All linear layers of `module`, while it trains."""

    def __init__(self, module):
        self.uses = {layer: [] for layer in module.modules() if isinstance(layer, nn.Linear)}
        for layer, uses in self.uses.items():
            layer.forward = functools.partial(self.apply, layer, uses)

    @staticmethod
    def apply(layer, uses, x):
        return Linear.apply(x, layer.weight, layer.bias, uses)

    def add_gradients(self):
        """After backward()."""
        for layer, uses in self.uses.items():
            if uses and layer.weight.requires_grad:
                x, given = (torch.cat([use[i].flatten(0, -2) for use in uses]) for i in (0, 1))
                layer.weight.grad, layer.bias.grad = given.T @ x, given.sum(0)
            uses.clear()
