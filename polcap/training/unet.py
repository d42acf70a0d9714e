"""The U-Net, which is the mask network and the refinement network, and the residual block of all networks."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from polcap.stages.infer import fine
from polcap.stages.mask import mask_channels


class UNet(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """U-Net: maps (B, outputs, H, W) from channels (B, inputs, H, W); H and W are multiples of 2 ** len(widths).

    Levels of `widths` channels from half resolution down. There is no normalization: absolute levels carry
    information. With `context` the mean and the maximum over the whole picture are added at the coarsest level.
    """

    def __init__(
        self, inputs: int, outputs: int, widths: tuple[int, ...], *, upsampled: int, full: int, context: bool
    ) -> None:
        """`upsampled`: channels that pass from half to full resolution; `full`: channels at full resolution."""
        super().__init__()
        self.stem = nn.Conv2d(4 * inputs, widths[0], 3, padding=1)
        self.levels = nn.ModuleList(ResidualBlock(width) for width in widths)
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(widths))
        if context:
            self.context = nn.Linear(2 * widths[-1], widths[-1])
            self.deep = ResidualBlock(widths[-1])
        self.up = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairwise(widths))
        self.joined = nn.ModuleList(ResidualBlock(width) for width in widths[:-1])
        self.wide = nn.Conv2d(widths[0], 4 * upsampled, 1)  # from half to full resolution
        self.raw = nn.Conv2d(inputs + upsampled, full, 3, padding=1)  # joins the input channels there
        self.out = nn.Conv2d(full, outputs, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Maps from channels: down the levels, up again with the features of each added, then to full resolution."""
        features = [self.levels[0](self.stem(F.pixel_unshuffle(x, 2)))]
        for down, level in zip(self.down, list(self.levels)[1:]):
            features.append(level(down(features[-1])))
        deep = features[-1]
        if hasattr(self, "context"):
            summary = torch.cat([deep.mean(dim=(2, 3)), deep.amax(dim=(2, 3))], dim=1)
            deep = self.deep(deep + self.context(summary)[:, :, None, None])
        for up, block, skip in reversed(list(zip(self.up, self.joined, features))):
            enlarged = F.interpolate(up(deep), scale_factor=2.0, mode="bilinear", align_corners=False)
            deep = block(enlarged + skip)
        upsampled = F.pixel_shuffle(self.wide(deep), 2)
        return self.out(F.relu(self.raw(torch.cat([x, upsampled], dim=1))))


class ResidualBlock(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Two convolutions added to their input; initially they add nothing."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(F.relu(self.first(F.relu(x))))


def mask_network() -> UNet:
    """The mask network: logit of the object at each pixel, from the channels of `stages/mask/mask_channels.py`.

    It runs twice with the same weights: on the whole picture at a reduced size, then on the part with the object, with
    the first result as a hint.
    """
    return UNet(len(mask_channels.CHANNELS), 1, (16, 32, 64, 112), upsampled=8, full=12, context=True)


def fine_network() -> UNet:
    """The refinement network: correction of the normals, from the channels of `stages/infer/fine.py`.

    Its receptive field is 62 px, so that tiles give the same result as the whole picture.
    """
    network = UNet(len(fine.CHANNELS), 3, (40, 48, 64), upsampled=10, full=16, context=False)
    nn.init.zeros_(network.out.weight)
    nn.init.zeros_(network.out.bias)
    return network
