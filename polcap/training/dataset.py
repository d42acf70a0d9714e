"""Batches made fresh at every step: traced views, new materials, flash and camera -> channels and truth.

The cues are computed by `stages/cues.py`, the same code that a capture goes through.
"""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from polcap.images import Quality
from polcap.optics import frames, shade
from polcap.stages import cues
from polcap.training import materials
from polcap.training.camera import Errors, photograph


@dataclass(frozen=True)
class Batch:
    """What the network sees and what it should say; pixels where `mask` is False count for nothing."""

    channels: Tensor  # (B, N, H, W)
    mask: Tensor  # (B, H, W) bool: object in truth and in the mask that the network was given
    normal: Tensor  # (B, 3, H, W) in the frame of each ray
    depth: Tensor  # (B, 1, H, W) units of gbuffers.depth_unit, mean 0
    diffuse: Tensor  # (B, 3, H, W)
    specular: Tensor  # (B, 3, H, W)
    roughness: Tensor  # (B, 1, H, W)
    highlight: Tensor  # (B, 1, H, W) share of S0 that the surface reflects


@dataclass(frozen=True)
class Photo:
    """What the camera measured at the M pixels `at` of the mask it was given, and the truth of every pixel."""

    stokes: Tensor  # (3, M, 3)
    covariance: Tensor  # (6, M, 3)
    clipped: Tensor  # (M,) bool
    at: Tensor  # (M,) indices into B·H·W
    given: Tensor  # (B, H, W) bool, the mask
    rays: Tensor  # (B, H, W, 3)
    mask: Tensor  # (B, H, W) bool, the object
    truth: dict[str, Tensor]  # (B, H, W, ·): normal (ray frame), depth, diffuse, specular, roughness, highlight


@dataclass(frozen=True)
class Light:
    """The flash of each object."""

    position: Tensor  # (B, 3) camera frame, in units of the object's distance
    strength: Tensor  # (B,) S0 of a white plane facing it at the object's distance

    @staticmethod
    def draw(count: int, device: torch.device) -> "Light":
        """Up to 10 % of the distance beside the lens; scale of the chart within 15 %."""
        way = 2 * torch.pi * torch.rand(count, device=device)
        off = 0.1 * torch.rand(count, device=device)
        position = torch.stack([off * torch.cos(way), off * torch.sin(way), torch.zeros_like(off)], dim=1)
        return Light(position, 0.85 + 0.3 * torch.rand(count, device=device))

    @staticmethod
    def stated(count: int, device: torch.device) -> "Light":
        """The evaluation's: 5 % of the distance above the lens."""
        position = torch.tensor([0.0, 0.05, 0.0], device=device).repeat(count, 1)
        return Light(position, torch.ones(count, device=device))


class Simulator:
    """Views and materials on one device; draws batches from torch's global random state."""

    def __init__(self, views: dict[str, NDArray[Any]], library: materials.Library, device: torch.device) -> None:
        self.views, self.library, self.device = views, library, device
        self.size = views["mask"].shape[1]

    def draw(self, count: int, size: int) -> Batch:
        """`count` random objects at size² pixels (≤ the cache's), with every augmentation."""
        pick = torch.randint(len(self.views["camera"]), (count,)).numpy()
        view = self.look(pick, size, flip=True)
        jitter = torch.rand(count, device=self.device)
        return batch(self.shoot(view, Light.draw(count, self.device), Errors.draw(count, self.device), jitter))

    def look(self, pick: NDArray[np.integer[Any]], size: int, *, flip: bool) -> SimpleNamespace:
        """Some of the traced views, thinned out to size² pixels and, with `flip`, mirrored at random."""
        step = self.size / size
        where = np.floor((np.arange(size) + 0.5) * step).astype(np.int64)  # pixels that stay
        data = {}
        for name in ("normal", "depth", "position", "mask"):
            array = self.views[name]
            taken = np.stack([array[i][where[:, None], where[None, :]] for i in pick])
            data[name] = torch.from_numpy(taken).to(self.device)
        camera = torch.from_numpy(self.views["camera"][pick]).to(self.device)
        normal, depth, position = (data[k].float() for k in ("normal", "depth", "position"))
        focal, middle, unit = camera[:, 0], camera[:, 3], camera[:, 4]
        at = torch.from_numpy(where.astype(np.float32)).to(self.device)
        x = ((at[None] - camera[:, 1:2]) / focal[:, None])[:, None, :].expand(-1, size, -1)
        y = ((at[None] - camera[:, 2:3]) / focal[:, None])[:, :, None].expand(-1, -1, size)
        v = F.normalize(torch.stack([-x, y, torch.ones_like(x)], dim=-1), dim=-1)
        turn = camera[:, 5:].reshape(-1, 3, 3)
        out = SimpleNamespace(
            normal=normal, depth=depth[..., 0], position=position, mask=data["mask"][..., 0], rays=v, turn=turn,
            far=1 + depth[..., 0] * (unit / middle)[:, None, None],
        )  # fmt: skip
        return _mirrored(out) if flip else out

    def shoot(self, view: SimpleNamespace, light: Light, errors: Errors, jitter: Tensor | None = None) -> Photo:
        """Dress, light and photograph; `jitter` (B,) in 0…1 thins or widens the mask that is given."""
        count, height, width = view.mask.shape
        inside = view.mask.reshape(-1).nonzero()[:, 0]
        owner = inside // (height * width)
        v = view.rays.reshape(-1, 3)[inside]
        bare, position = (image.reshape(-1, 3)[inside] for image in (view.normal, view.position))
        surface = materials.dress(self.library, bare, position, view.turn, owner, count)
        normal = frames.to_ray_frame(surface.normal, v)
        normal = F.normalize(torch.cat([normal[:, :2], normal[:, 2:].clamp(min=0.02)], dim=1), dim=1)
        place = -v * (view.far.reshape(-1)[inside] / v[:, 2])[:, None]
        to_light = light.position[owner] - place
        squared = (to_light * to_light).sum(dim=1)
        to_light = frames.to_ray_frame(to_light / squared.sqrt()[:, None], v)
        specular, irradiance = surface.specular, light.strength[owner] / squared
        stokes, body = (
            shade.stokes(normal, surface.diffuse, part, surface.roughness, surface.ior, to_light, irradiance)
            for part in (specular, torch.zeros_like(specular))
        )
        highlight = 1 - (body[0].sum(dim=1) + 1e-4) / (stokes[0].sum(dim=1) + 1e-4)

        def image(flat: Tensor) -> Tensor:
            out = flat.new_zeros(count * height * width, flat.shape[1])
            return out.index_copy(0, inside, flat).reshape(count, height, width, -1)

        truth = {
            "normal": image(normal), "depth": view.depth[..., None], "diffuse": image(surface.diffuse),
            "specular": image(specular), "roughness": image(surface.roughness[:, None]),
            "highlight": image(highlight[:, None]),
        }  # fmt: skip
        scene = torch.stack([image(part) for part in stokes])
        given = view.mask if jitter is None else _redrawn(view.mask, jitter)
        at = given.reshape(-1).nonzero()[:, 0]
        measured, covariance, clipped = photograph(
            scene, truth["diffuse"], truth["normal"][..., 2], view.mask, view.rays, at, errors
        )
        return Photo(measured, covariance, clipped, at, given, view.rays, view.mask, truth)


def batch(photo: Photo) -> Batch:
    """What the network is given of photographs, and what it should say."""
    return Batch(
        channels=channels(photo),
        mask=photo.given & photo.mask,
        **{name: value.permute(0, 3, 1, 2) for name, value in photo.truth.items()},
    )


def channels(photo: Photo) -> Tensor:
    """What `stages/cues.py` makes of the measured pixels, (B, N, H, W), 0 elsewhere; channels last in memory."""
    count, height, width = photo.rays.shape[:3]
    ratio, sigma, dolp, normalized = cues.polarization(photo.stokes, photo.covariance)
    clipped, at = photo.clipped, photo.at
    row = SimpleNamespace(  # all pixels as one row
        radiance=photo.stokes[0][None], ratio=ratio[:, None], ratio_sigma=sigma[None], dolp=dolp[None],
        normalized_stokes=normalized[:, None], rays=photo.rays.reshape(1, -1, 3)[:, at],
        mask=torch.ones_like(clipped)[None], quality=(clipped.to(torch.uint8) * int(Quality.CLIPPED))[None],
    )  # fmt: skip
    flat = cues.channels(row)[:, 0].T  # (M, N)
    out = flat.new_zeros(count * height * width, flat.shape[1]).index_copy(0, at, flat)
    return out.reshape(count, height, width, -1).permute(0, 3, 1, 2)


def _mirrored(view: SimpleNamespace) -> SimpleNamespace:
    """Each half of the time: left for right, top for bottom, x for y; one draw for the whole batch."""
    out = view.__dict__.copy()
    images = ("normal", "depth", "position", "mask", "rays", "far")
    for operation in range(3):
        if torch.rand(()) < 0.5:
            continue
        change = torch.eye(3, device=view.normal.device)
        if operation < 2:
            change[operation, operation] = -1
            for name in images:
                out[name] = out[name].flip(2 - operation)
        else:  # transposing the array takes (x, y up) to (−y, −x)
            change[:2, :2] = torch.tensor([[0.0, -1.0], [-1.0, 0.0]])
            for name in images:
                out[name] = out[name].transpose(1, 2)
        for name in ("normal", "rays"):
            out[name] = out[name] @ change.T
        out["turn"] = change @ out["turn"]
    return SimpleNamespace(**out)


def _redrawn(mask: Tensor, jitter: Tensor) -> Tensor:
    """A third of the masks one pixel wider, a third one pixel thinner."""
    solid = mask[:, None].float()
    wider = F.max_pool2d(solid, 3, 1, 1)[:, 0] > 0.5
    thinner = -F.max_pool2d(-solid, 3, 1, 1)[:, 0] > 0.5
    part = jitter[:, None, None]
    return torch.where(part < 0.33, wider, torch.where(part < 0.66, thinner, mask))
