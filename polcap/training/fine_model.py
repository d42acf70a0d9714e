"""The fine pass's network: channels of `stages/infer/fine.py` -> how the normals deviate from what is known.

A U-Net of three levels that sees 62 px far and nothing of the whole object, so that tiles make no difference. No
normalization, as in `model.py`: levels are information.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from polcap.stages.infer.fine import CHANNELS
from polcap.training.mask_model import Block

_WIDTHS = (40, 48, 64)  # from half resolution down
_WIDE = 10  # channels at full resolution


class Network(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Channels (B, 23, H, W) -> relief (B, 3, H, W) in the frame of each ray; H and W multiples of 8."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(4 * len(CHANNELS), _WIDTHS[0], 3, padding=1)
        self.levels = nn.ModuleList(Block(width) for width in _WIDTHS)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(_WIDTHS))
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(_WIDTHS))
        self.joined = nn.ModuleList(Block(width) for width in _WIDTHS[:-1])
        self.wide = nn.Conv2d(_WIDTHS[0], 4 * _WIDE, 1)
        self.raw = nn.Conv2d(len(CHANNELS) + _WIDE, 16, 3, padding=1)
        self.out = nn.Conv2d(16, 3, 3, padding=1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, x: Tensor) -> Tensor:
        features = [self.levels[0](self.stem(F.pixel_unshuffle(x, 2)))]
        for down, level in zip(self.down, list(self.levels)[1:]):
            features.append(level(down(features[-1])))
        deep = features[-1]
        for up, block, skip in reversed(list(zip(self.up, self.joined, features))):
            wide = F.interpolate(up(deep), scale_factor=2.0, mode="bilinear", align_corners=False)
            deep = block(wide + skip)
        fine = F.pixel_shuffle(self.wide(deep), 2)
        return self.out(F.relu(self.raw(torch.cat([x, fine], dim=1))))


def loss(relief: Tensor, target: Tensor, known: Tensor) -> Tensor:
    """Squared and plain distance of the relief from what it should be (B, 3, H, W), where `known` (B, 1, H, W)."""
    off = (relief - target).square().sum(dim=1, keepdim=True)
    return ((off + 0.5 * (off + 1e-4).sqrt()) * known).sum() / known.sum().clamp(min=1)
