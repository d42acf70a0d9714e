"""The mask's network: channels of `stages/mask/mask_channels.py` -> how likely each pixel is the object.

A U-Net that looks at the whole picture, reduced, hinted by a guess; then, with the same weights, at the object
alone, hinted by what it found before. No normalization, as in `model.py`: levels are information.
"""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from polcap.stages.mask.mask_channels import CHANNELS

_WIDTHS = (16, 32, 64, 112)  # from half resolution down


class Network(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Channels (B, 11, H, W) -> logits (B, 1, H, W); H and W multiples of 16."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = nn.Conv2d(4 * len(CHANNELS), _WIDTHS[0], 3, padding=1)
        self.levels = nn.ModuleList(Block(width) for width in _WIDTHS)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(_WIDTHS))
        self.context = nn.Linear(2 * _WIDTHS[-1], _WIDTHS[-1])
        self.deep = Block(_WIDTHS[-1])
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(_WIDTHS))
        self.joined = nn.ModuleList(Block(width) for width in _WIDTHS[:-1])
        self.wide = nn.Conv2d(_WIDTHS[0], 4 * 8, 1)
        self.raw = nn.Conv2d(len(CHANNELS) + 8, 12, 3, padding=1)
        self.out = nn.Conv2d(12, 1, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        features = [self.levels[0](self.stem(F.pixel_unshuffle(x, 2)))]
        for down, level in zip(self.down, list(self.levels)[1:]):
            features.append(level(down(features[-1])))
        deep = features[-1]
        summary = torch.cat([deep.mean(dim=(2, 3)), deep.amax(dim=(2, 3))], dim=1)
        deep = self.deep(deep + self.context(summary)[:, :, None, None])
        for up, block, skip in reversed(list(zip(self.up, self.joined, features))):
            wide = F.interpolate(up(deep), scale_factor=2.0, mode="bilinear", align_corners=False)
            deep = block(wide + skip)
        fine = F.pixel_shuffle(self.wide(deep), 2)
        return self.out(F.relu(self.raw(torch.cat([x, fine], dim=1))))


class Block(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Two convolutions beside the identity, nothing at first."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(F.relu(self.first(F.relu(x))))


def loss(logits: Tensor, truth: Tensor) -> Tensor:
    """Cross entropy, by which doubt is honest, and one minus the soft IoU of each picture; truth (B, 1, H, W) 0…1."""
    entropy = F.binary_cross_entropy_with_logits(logits, truth)
    chance = torch.sigmoid(logits)
    both = (chance * truth).sum(dim=(1, 2, 3))
    either = (chance + truth - chance * truth).sum(dim=(1, 2, 3))
    return entropy + 0.3 * (1 - (both + 1) / (either + 1)).mean()
