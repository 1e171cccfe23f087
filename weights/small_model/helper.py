# SPDX-License-Identifier: Apache-2.0
"""Only for training, not shipped: linear readings of the encoder's tokens, and what they should say. Without them a small
model learns depth from single pictures and never how the camera moved: nothing in its tokens says where a patch was before.

- the patch's own colours, from DINOv2's tokens: pictures can be compared only while they are still there
- from each global block's tokens, where in the first frame the patch was; the blocks' attention learns to look there, see
  matching.py
- depth and points in the first camera, from the last block's tokens, before the dense head knows them
"""
import torch
import torch.nn as nn
import torch.nn.functional as F

from matching import cells

CELLS = 4      # values along each side of a patch
FARTHEST = 4   # patches: a move that counts


class Helper(nn.Module):
    def __init__(self, config):
        super().__init__()
        C, self.step = config["embed_dim"], config["patch_size"]
        self.colour = nn.Linear(C, 3 * CELLS * CELLS)
        self.back = nn.ModuleList(nn.Linear(2 * C, 2) for _ in range(len(config["taps"]) - 1))
        self.read = nn.Linear(2 * C, 4 * CELLS * CELLS)
        for parameter in self.parameters():  # readings that know nothing yet should not push trained tokens about
            nn.init.zeros_(parameter)

    def watch(self, model):
        model.aggregator.patch_embed.register_forward_hook(lambda module, given, tokens: setattr(self, "seen", tokens))

    def loss(self, taps, batch):
        """taps: [B * S, h * w, 2C] of all layers. The loss, and the error of the ways back in parts of their length."""
        B, S, H, W = batch["depth"].shape
        h, w = H // self.step, W // self.step

        def pooled(x):
            """[B, S, c, H, W] -> [B * S, h * w, c * CELLS * CELLS]"""
            x = F.adaptive_avg_pool2d(x.flatten(0, 1), (h * CELLS, w * CELLS))
            return x.view(B * S, -1, h, CELLS, w, CELLS).permute(0, 2, 4, 1, 3, 5).reshape(B * S, h * w, -1)

        colour = (self.colour(self.seen.float()) - pooled(batch["images"])).abs().mean()
        log_depth, points = (pooled(x) for x in (batch["depth"].log()[:, :, None], batch["points"].permute(0, 1, 4, 2, 3)))
        depth, place = self.read(taps[-1]).split([log_depth.shape[-1], points.shape[-1]], -1)
        distance = points.unflatten(-1, (3, -1)).norm(dim=-2).repeat(1, 1, 3).clamp(min=0.1)
        scene = (depth - log_depth).abs().mean() + ((place - points).abs() / distance).mean()
        wanted = ways_back(batch, self.step).flatten(0, 1)
        back = [(read(tap) - wanted).view(B, S, -1)[:, 1:].abs() for read, tap in zip(self.back, taps[1:])]
        if S == 1:
            return 0.3 * scene + 0.5 * colour, torch.ones(())
        length = wanted.view(B, S, -1)[:, 1:].abs().mean().clamp(min=1e-3)
        return 0.3 * scene + 0.5 * colour + 0.7 * sum(x.mean() for x in back), back[-1].mean() / length


def ways_back(batch, step):
    """From each patch's middle to where it was in the first frame, in patches: [B, S, h * w, 2]."""
    B, S, H, W = batch["depth"].shape
    h, w = H // step, W // step
    points = cells(batch["points"].permute(0, 1, 4, 2, 3), step).permute(0, 1, 3, 4, 2)
    tangent = (batch["pose"][:, :, None, None, 7:9] / 2).tan().flip(-1)  # width, height
    where = points[..., :2] / points[..., 2:].clamp(min=0.05) / tangent
    u, v = ((torch.arange(n) + 0.5) / n * 2 - 1 for n in (w, h))
    here = torch.stack(torch.broadcast_tensors(u[None, :], v[:, None]), -1)
    return ((where - here) * torch.tensor([w / 2, h / 2])).clamp(-FARTHEST, FARTHEST).view(B, S, h * w, 2)
