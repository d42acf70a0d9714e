"""Ablations of the main network: variants without one part, or with other inputs.

All are trained by the same code on the same pictures: their inputs are functions of the channels.

References
----------
Deschaintre, Lin & Ghosh, Deep polarization imaging for 3D shape and SVBRDF acquisition, CVPR 2021, §6.
Deschaintre et al., Single-image SVBRDF capture with a rendering-aware deep network, SIGGRAPH 2018 (loss).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from polcap.stages.cues import CHANNELS, FLOOR

_AT = {name: CHANNELS.index(name) for name in CHANNELS}
_UNPOLARIZED = ("log_r", "log_g", "log_b", "mask", "clipped", "ray_x", "ray_y")


@dataclass(frozen=True)
class Variant:
    """One ablation of the main network: its input channels, and the parts that it lacks."""

    inputs: Callable[[Tensor], Tensor] = lambda x: x  # channels (B, N, H, W) -> inputs of the same shape
    sees_dolp: bool = True  # in the gloss profiles
    skip_convolutions: bool = True  # residual blocks on every skip connection, else its projection alone
    polarized_loss: bool = True  # Stokes parameters in the rendering loss, else S0 alone


def _unpolarized(x: Tensor) -> Tensor:
    """Input of an ablation: the channels of one unpolarized flash photograph (radiance, mask, saturation and rays)."""
    keep = x.new_tensor([float(name in _UNPOLARIZED) for name in CHANNELS])
    return x * keep.view(1, -1, 1, 1)


def _published(x: Tensor) -> Tensor:
    """Input of an ablation: the published method's pictures at 0°, 45° and 90°, normalized Stokes map, diffuse color.

    The pictures are linear. Their polarization is the mean over the color channels, which differ by noise only. So the
    diffuse color, the normalized least intensity of each pixel, is the normalized S0.
    """
    s0 = torch.exp(x[:, _AT["log_r"] : _AT["log_b"] + 1]) - FLOOR
    s1, s2 = (x[:, _AT[name]].unsqueeze(1) / 10 for name in ("s1", "s2"))  # S1/S0 and S2/S0
    pictures = [s0 * (1 + part) / 2 for part in (s1, s2, -s1)]  # at 0°, 45°, 90°
    stokes = x[:, _AT["cos_2phi"] : _AT["sin_2phi"] + 1]
    both = torch.cat([*pictures, stokes, F.normalize(s0, dim=1, eps=1e-4)], dim=1)
    return both * x[:, _AT["mask"]].unsqueeze(1)


VARIANTS = {
    "ours": Variant(),
    "published inputs": Variant(_published),
    "unpolarized inputs": Variant(_unpolarized, sees_dolp=False),
    "plain skips": Variant(skip_convolutions=False),
    "unpolarized loss": Variant(polarized_loss=False),
    "no polarization": Variant(_unpolarized, sees_dolp=False, polarized_loss=False),
}
