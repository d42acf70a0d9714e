"""The main network: cue channels of a crop -> normal, depth, diffuse, specular, roughness and expected error.

One encoder and three decoders (normal, depth and error; diffuse; specular and roughness). Each decoder has residual
blocks and a convolution of its own on every skip connection, as in the paper below. There is no normalization: the
absolute levels of radiance and DoLP carry information. At the coarsest level every cell sees all cells of the object
(attention, and their mean). Uncertain diffuse color is moved towards the colors that recur in the picture. Gloss comes
last. Its inputs are the normal and diffuse color of the other decoders, and the light and polarization that these do
not explain. It shares its estimates between places of similar features or the same color, so that a highlight in one
place gives the roughness in another.

References
----------
Deschaintre, Lin & Ghosh, Deep polarization imaging for 3D shape and SVBRDF acquisition, CVPR 2021.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from polcap.stages.cues import CHANNELS, FLOOR
from polcap.training.gloss_profiles import GlossEvidence, Profiles, figures_of
from polcap.training.recurring_colors import ColorGloss, Recolor
from polcap.training.unet import ResidualBlock
from polcap.training.variants import VARIANTS

SIZE_MULTIPLE = 32
OUTPUTS = ("normal", "depth", "diffuse", "specular", "roughness", "sigma")
_GEOMETRY_OUTPUTS = 5  # normal, depth, sigma
_COLOR_OUTPUTS = 5  # diffuse, doubt of its lightness and of its hue
_GLOSS_OUTPUTS = 5  # specular, roughness, highlight
_HINTS = 10  # inputs of the gloss decoder: normal, diffuse, light above their shading, DoLP missing from theirs
_SHARED = (2, 1)  # decoder levels with attention, at 1/8 and 1/4 of the resolution
_MASK = CHANNELS.index("mask")
_CLIPPED = CHANNELS.index("clipped")
_RATIO = slice(CHANNELS.index("s1"), CHANNELS.index("s2") + 1)
COLOR = slice(CHANNELS.index("log_r"), CHANNELS.index("log_b") + 1)


@dataclass(frozen=True)
class NetworkShape:
    """Width of the main network: channels per level, from half resolution down."""

    encoder: tuple[int, ...] = (32, 64, 128, 192, 256)
    geometry: tuple[int, ...] = (32, 64, 96, 128)  # decoders
    color: tuple[int, ...] = (32, 32, 64, 96)
    gloss: tuple[int, ...] = (32, 48, 64, 96)
    blocks: tuple[int, ...] = (1, 2, 2, 2, 1)  # residual blocks per encoder level
    skip_blocks: int = 1


SMALL = NetworkShape()
LARGE = NetworkShape(
    (64, 128, 256, 384, 512), (64, 128, 192, 256), (64, 64, 128, 192), (64, 64, 128, 192), (2, 2, 3, 3, 3), 2
)


class MainNetwork(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Main network: cue channels (B, 14, H, W) -> maps (B, ·, H, W) by name; H and W are multiples of 32.

    normal             unit vectors in the frame of each pixel's ray
    depth              growing away from the camera, mean about 0, in units of `traced_views.depth_unit`
    diffuse, specular  ρ_d and F0, linear
    roughness          perceptual
    sigma              expected angle between estimated and true normal, degrees
    highlight          specular share of S0; not exported, but learned because it helps the other maps
    """

    def __init__(self, shape: NetworkShape = SMALL, variant: str = "ours") -> None:
        super().__init__()
        self.shape, self.variant = shape, variant
        self.inputs, self.sees_dolp = VARIANTS[variant].inputs, float(VARIANTS[variant].sees_dolp)
        skips = shape.skip_blocks if VARIANTS[variant].skip_convolutions else 0
        widths = shape.encoder
        self.stem = nn.Conv2d(4 * len(CHANNELS), widths[0], 3, padding=1)
        self.levels = nn.ModuleList(_residuals(w, n) for w, n in zip(widths, shape.blocks))
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(widths))
        self.context = Context(widths[-1])
        self.geometry = Decoder(widths, shape.geometry, shape.skip_blocks, skips, _GEOMETRY_OUTPUTS)
        self.color = Decoder(widths, shape.color, shape.skip_blocks, skips, _COLOR_OUTPUTS)
        self.recolor = Recolor()
        self.profiles = Profiles(widths[1], widths[0], shape.gloss[1] + _GLOSS_OUTPUTS)
        self.color_gloss = ColorGloss(_GLOSS_OUTPUTS)
        self.gloss = Decoder(widths, shape.gloss, shape.skip_blocks, skips, _GLOSS_OUTPUTS, hints=_HINTS)

    def forward(self, x: Tensor) -> dict[str, Tensor]:
        seen = self.inputs(x)
        features = [self.levels[0](self.stem(F.pixel_unshuffle(seen, 2)))]
        for down, level in zip(self.down, list(self.levels)[1:]):
            features.append(level(down(features[-1])))
        inside, clipped = (x[:, at : at + 1].clamp(0, 1) for at in (_MASK, _CLIPPED))
        features[-1] = self.context(features[-1], F.avg_pool2d(inside, SIZE_MULTIPLE))
        geometry, color = (decoder(features, seen, inside).float() for decoder in (self.geometry, self.color))
        log_radiance = x[:, COLOR].float()
        facing = geometry.new_tensor([0.0, 0.0, 0.5]).view(1, 3, 1, 1)  # the initial normals face the camera
        normal = F.normalize(geometry[:, :3] + facing, dim=1, eps=1e-6)
        albedo = torch.sigmoid(log_radiance + color[:, :3] + 0.7)
        cosine, usable = normal[:, 2:].detach(), inside * (1 - clipped)
        with torch.autocast(x.device.type, enabled=False):
            diffuse, member, colors = self.recolor(albedo, color[:, 3:], cosine, inside.float(), clipped.float())
        log_body = torch.log(0.9 * diffuse * normal[:, 2:].clamp(min=0) + FLOOR)  # log S0 of diffuse light alone
        figures = figures_of(log_radiance, self.sees_dolp * x[:, _RATIO].float() / 10, normal, diffuse)
        hints = torch.cat([normal, diffuse, log_radiance - log_body, figures[:, -1:]], dim=1).detach() * inside
        halved = GlossEvidence(*(part[:, :, ::2, ::2].detach() for part in (figures, normal[:, 2:], diffuse, usable)))
        parts = [self.shape.gloss[1], _GLOSS_OUTPUTS]  # features for the decoder, and a first gloss
        readings, direct = self.profiles(features[1], features[0], halved).split(parts, dim=1)
        hinted = torch.cat([seen, hints.to(seen.dtype)], dim=1)
        gloss = self.gloss(features, hinted, inside, F.avg_pool2d(readings, 2)).float()
        gloss = gloss + F.interpolate(direct, scale_factor=2.0, mode="bilinear", align_corners=False)
        with torch.autocast(x.device.type, enabled=False):
            corrected = self.color_gloss(halved, gloss[:, :, ::2, ::2], member[:, :, ::2, ::2].detach(), colors)
        gloss = gloss + F.interpolate(corrected, scale_factor=2.0, mode="bilinear", align_corners=False)
        return {  # summands set the maps before training, factors their greatest values
            "normal": normal,
            "depth": geometry[:, 3:4],
            "diffuse": diffuse,
            "specular": 0.4 * torch.sigmoid(gloss[:, :3] - 1.7),
            "roughness": torch.sigmoid(gloss[:, 3:4]),
            "sigma": 60 * torch.sigmoid(geometry[:, 4:5] - 1.5),
            "highlight": torch.sigmoid(gloss[:, 4:5] - 1.0),
        }


def run(network: nn.Module, channels: Tensor) -> dict[str, Tensor]:
    """Run the main network on channels (B, N, H, W) in the number type that is fastest on this machine."""
    kind, half = channels.device.type, _has_bfloat16(channels.device)
    with torch.autocast(kind, torch.bfloat16, enabled=half, cache_enabled=False):  # threads would share the cache
        maps: dict[str, Tensor] = network(channels.contiguous(memory_format=torch.channels_last))
    return maps


@cache
def _has_bfloat16(device: torch.device) -> bool:
    """Whether convolutions and matrix products are faster in bfloat16 than in float32.

    bfloat16 doubles the speed of a GPU, and of a CPU with bfloat16 instructions. On other CPUs it is emulated and a
    dozen times slower.
    """
    return device.type != "cpu" or bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def _residuals(width: int, count: int) -> nn.Sequential:
    return nn.Sequential(*[ResidualBlock(width) for _ in range(count)])


class Context(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Network layer: attention of each cell of the coarsest level to all cells of the object, and their mean."""

    def __init__(self, width: int, heads: int = 4) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Conv2d(width, 3 * width, 1)
        self.proj = nn.Conv2d(2 * width, width, 1)
        nn.init.zeros_(self.proj.weight)

    def forward(self, x: Tensor, inside: Tensor) -> Tensor:
        batch, width, height, across = x.shape
        query, key, value = (
            part.flatten(2).reshape(batch, self.heads, width // self.heads, -1).transpose(2, 3)
            for part in self.qkv(F.relu(x)).chunk(3, dim=1)
        )
        weight = inside.flatten(2)  # (B, 1, cells)
        score = query @ key.transpose(2, 3) / (width // self.heads) ** 0.5
        attention = torch.softmax(score.float() + torch.log(weight[:, :, None].float() + 1e-4), dim=-1)
        seen = (attention.to(value.dtype) @ value).transpose(2, 3).reshape(batch, width, height, across)
        mean = (x.flatten(2) * weight).sum(dim=2) / (weight.sum(dim=2) + 1e-4)
        return x + self.proj(torch.cat([seen, mean[:, :, None, None].expand_as(x).to(seen.dtype)], dim=1))


class LinearAttention(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Network layer that assigns pixels to soft groups and gives each pixel the means of its groups.

    The cost is linear in the number of pixels.

    References
    ----------
    Shen et al., Efficient attention: attention with linear complexities, WACV 2021.
    """

    def __init__(self, width: int, heads: int = 4, groups: int = 16) -> None:
        super().__init__()
        self.heads, self.groups = heads, groups
        self.qkv = nn.Conv2d(width, heads * groups * 2 + width, 1)
        self.proj = nn.Conv2d(width, width, 1)
        nn.init.zeros_(self.proj.weight)

    def forward(self, x: Tensor, inside: Tensor) -> Tensor:
        batch, width, height, across = x.shape
        count = self.heads * self.groups
        member, weight, value = self.qkv(F.relu(x)).split([count, count, width], dim=1)
        group = (batch, self.heads, self.groups, -1)
        member = torch.softmax(member.float().reshape(group), dim=2)
        weight = torch.softmax(weight.float().reshape(group) + torch.log(inside.flatten(2)[:, :, None] + 1e-4), dim=3)
        value = value.float().reshape(batch, self.heads, width // self.heads, -1)
        means = value @ weight.transpose(2, 3)  # (B, heads, width/heads, groups)
        return x + self.proj((means @ member).reshape(batch, width, height, across).to(x.dtype))


class Decoder(nn.Module):  # type: ignore[misc]  # torch comes without types here
    """Decoder from the coarsest level to full resolution; `hints` more input channels reach every level."""

    def __init__(
        self, encoder: tuple[int, ...], widths: tuple[int, ...], blocks: int, skip_blocks: int, outputs: int,
        hints: int = 0,
    ) -> None:  # fmt: skip
        super().__init__()
        coarse = (*widths[1:], encoder[-1])  # channels from the next coarser level
        self.up = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in zip(coarse, widths))
        self.skip = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in zip(encoder, widths))
        self.block = nn.ModuleList(_residuals(w, blocks) for w in widths)
        self.skip_block = nn.ModuleList(_residuals(w, skip_blocks) for w in widths)
        self.fine = nn.Conv2d(widths[0], 64, 3, padding=1)  # 16 channels at full resolution
        self.raw = nn.Conv2d(len(CHANNELS) + hints, 16, 3, padding=1)
        self.mix = nn.Conv2d(16, 16, 3, padding=1)
        self.out = nn.Conv2d(16, outputs, 3, padding=1)  # a convolution after the shuffle avoids a grid pattern
        nn.init.normal_(self.out.weight, std=1e-2)
        nn.init.zeros_(self.out.bias)
        self.hint = nn.ModuleList()
        self.attention = nn.ModuleDict()
        if hints:
            self.hint.append(nn.Conv2d(4 * (hints + len(CHANNELS)), widths[0], 3, padding=1))
            self.hint.extend(nn.Conv2d(a, b, 3, stride=2, padding=1) for a, b in pairwise(widths))
            self.attention = nn.ModuleDict({str(level): LinearAttention(widths[level]) for level in _SHARED})

    def forward(self, features: list[Tensor], seen: Tensor, inside: Tensor, readings: Tensor | None = None) -> Tensor:
        """Outputs (B, ·, H, W) from the encoder's features; `readings` (B, ·, H/4, W/4) join the hints there."""
        hinted: list[Tensor] = []
        for hint in self.hint:
            hinted.append(hint(F.relu(hinted[-1]) if hinted else F.pixel_unshuffle(seen, 2)))
            if readings is not None and len(hinted) == 2:
                hinted[-1] = hinted[-1] + readings
        y = features[-1]
        for level in reversed(range(len(self.up))):
            skip = self.skip[level](features[level])
            skip = self.skip_block[level](skip + hinted[level] if hinted else skip)
            lifted = F.interpolate(self.up[level](y), scale_factor=2.0, mode="bilinear", align_corners=False)
            y = self.block[level](skip + lifted)
            if str(level) in self.attention:
                y = self.attention[str(level)](y, F.avg_pool2d(inside, 2 << level))  # level 0 has half resolution
        y = F.pixel_shuffle(self.fine(F.relu(y)), 2) + self.raw(seen)
        y = y + self.mix(F.relu(y))
        return self.out(F.relu(y))
