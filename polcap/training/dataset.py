"""Batches made fresh at every step: traced views, new materials, flash and camera -> channels and truth.

The cues are computed by `stages/cues`, the same code that a capture goes through.
"""

from dataclasses import dataclass
from math import isqrt
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
from polcap.training import bounce, gbuffers, gloss, materials
from polcap.training.camera_errors import Errors, photograph

Indices = NDArray[np.integer[Any]]


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
    law: Tensor  # (B, 3, H, W) fields of `body.Law`, for the rendering loss


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
    truth: dict[str, Tensor]  # (B, H, W, ·): normal (ray frame), depth, diffuse, specular, roughness, highlight, law


@dataclass(frozen=True)
class Seen:
    """Some of the traced views at one size; M pixels of objects, one after the other."""

    mask: Tensor  # (B, H, W) bool
    rays: Tensor  # (B, H, W, 3) camera frame, surface to camera
    inside: Tensor  # (M,) indices of the object's pixels into B·H·W
    owner: Tensor  # (M,) object of each
    v: Tensor  # (M, 3) their rays
    normal: Tensor  # (M, 3) camera frame, without bumps
    position: Tensor  # (M, 3) object frame
    place: Tensor  # (M, 3) camera frame, in units of the object's distance
    depth: Tensor  # (M,) units of gbuffers.depth_unit, mean 0
    lit: Tensor  # (M,) 1 where the flash reaches
    met: Tensor  # (M, bounce.RAYS) rows among the M of the pixels that each sees, −1 for none
    open: Tensor  # (M,) share of the rays about the mirror direction that leave the object
    turn: Tensor  # (B, 3, 3) object → camera
    flash: Tensor  # (B, 3) camera frame, in units of the object's distance


class Simulator:
    """Views and materials on one device; draws batches from torch's global random state."""

    def __init__(self, views: dict[str, NDArray[Any]], library: materials.Library, device: torch.device) -> None:
        self.library, self.device = library, device
        self.size = views["mask"].shape[1]
        self.camera = views["camera"]
        self.views = {name: views[name].reshape(-1, views[name].shape[-1]) for name in gbuffers.ARRAYS}  # a row a pixel

    def draw(self, count: int, size: int) -> Batch:
        """`count` random objects at size² pixels (≤ the cache's), with every augmentation."""
        pick = torch.randint(len(self.camera), (count,)).numpy()
        seen = self.look(pick, size, flip=True)
        strength = 0.92 + 0.16 * torch.rand(count, device=self.device)  # what the chart leaves open
        jitter = torch.rand(count, device=self.device)
        return batch(self.shoot(seen, strength, Errors.draw(count, self.device), jitter))

    def look(self, pick: NDArray[np.integer[Any]], size: int, *, flip: bool) -> Seen:
        """Some of the traced views, thinned out to size² pixels and, with `flip`, mirrored at random."""
        full, area = self.size, size * size
        pixels, change = _mirrored(np.arange(area).reshape(size, size), flip)
        order = pixels.reshape(-1)  # the thinned pixels in their new places
        where = np.floor((np.arange(size) + 0.5) * (full / size)).astype(np.int64)  # pixels that stay
        y, x = where[order // size], where[order % size]
        mask = self.views["mask"].reshape(-1, full * full)[pick][:, y * full + x]
        inside = np.flatnonzero(mask)
        owner, at = np.divmod(inside, area)
        first = pick[owner]  # view of each pixel
        met, escaped = self._met(first, y[at], x[at], order, mask, owner)
        kept = (first * full + y[at]) * full + x[at]

        def tensor(array: NDArray[Any]) -> Tensor:
            return torch.from_numpy(array).to(self.device)

        def taken(name: str) -> Tensor:
            return tensor(self.views[name].take(kept, axis=0)).float()

        camera, mirror, rows = tensor(self.camera[pick]), tensor(change), tensor(owner)
        focal, middle, unit = camera[:, 0, None], camera[:, 3], camera[:, 4]
        right, low = ((tensor(a).float() - camera[:, k : k + 1]) / focal for a, k in ((x, 1), (y, 2)))
        rays = F.normalize(torch.stack([-right, low, torch.ones_like(low)], dim=-1), dim=-1) @ mirror.T
        v, depth = rays.reshape(-1, 3)[tensor(inside)], taken("depth")[:, 0]
        far = 1 + depth * (unit / middle)[rows]
        return Seen(
            mask=tensor(mask).reshape(-1, size, size), rays=rays.reshape(-1, size, size, 3), inside=tensor(inside),
            owner=rows, v=v, normal=taken("normal") @ mirror.T, position=taken("position"),
            place=-v * (far / v[:, 2])[:, None], depth=depth, lit=taken("lit")[:, 0], met=tensor(met),
            open=tensor(escaped), turn=mirror @ camera[:, 5:14].reshape(-1, 3, 3),
            flash=F.pad(camera[:, 14:16], (0, 1)) @ mirror.T,
        )  # fmt: skip

    def _met(
        self, first: Indices, y: Indices, x: Indices, order: Indices, mask: NDArray[np.bool_], owner: Indices
    ) -> tuple[Indices, NDArray[np.float32]]:
        """Seen.met and Seen.open of pixels (y, x) of views `first`.

        Their thinned pixels lie in `order`, with masks (B, H·W).
        """
        full, area = self.size, len(order)
        size, coarse = isqrt(area), full // bounce.COARSE
        there = np.full(2**16, -1, np.int64)  # place in the thinned and mirrored view of each pixel of the cache
        thinned = np.arange(full) * size // full
        there[: full * full] = np.argsort(order)[(thinned[:, None] * size + thinned).reshape(-1)]
        there[[bounce.NOWHERE, bounce.ESCAPED]] = -1
        row = np.where(mask.reshape(-1), np.cumsum(mask) - 1, -1)
        cell = (first * coarse + y // bounce.COARSE) * coarse + x // bounce.COARSE
        found = self.views["met"].take(cell, axis=0)  # (M, RAYS)
        to, escaped = there[found], found[:, -bounce.SHARP :] == bounce.ESCAPED
        return np.where(to >= 0, row[to + owner[:, None] * area], -1), escaped.mean(axis=1, dtype=np.float32)

    def shoot(
        self,
        seen: Seen,
        strength: Tensor,
        errors: Errors,
        jitter: Tensor | None = None,
        smooth_share: float = gloss.SMOOTH_SHARE,
    ) -> Photo:
        """Dress, light and photograph.

        strength (B,) S0 of a white plane facing the flash at the object's distance; `jitter` (B,) in 0…1 thins or
        widens the mask that is given; smooth_share of objects with the smooth law of the body.
        """
        count, height, width = seen.mask.shape
        surface = materials.dress(self.library, seen.normal, seen.position, seen.turn, seen.owner, count, smooth_share)
        normal = frames.lifted(frames.to_ray_frame(surface.normal, seen.v))
        to_flash = seen.flash[seen.owner] - seen.place
        squared = (to_flash * to_flash).sum(dim=1)
        to_flash = frames.to_ray_frame(to_flash / squared.sqrt()[:, None], seen.v)
        irradiance = seen.lit * strength[seen.owner] / squared
        nothing, lit = torch.zeros_like(surface.specular), (surface.roughness, surface.ior, to_flash, irradiance)
        body = shade.stokes(normal, surface.diffuse, nothing, *lit, surface.law)
        stokes = body + shade.stokes(normal, nothing, surface.specular, *lit)
        highlight = 1 - (body[0].sum(dim=1) + 1e-4) / (stokes[0].sum(dim=1) + 1e-4)

        def image(flat: Tensor) -> Tensor:
            out = flat.new_zeros(count * height * width, flat.shape[1])
            return out.index_copy(0, seen.inside, flat).reshape(count, height, width, -1)

        truth = {
            "normal": image(normal), "depth": image(seen.depth[:, None]), "diffuse": image(surface.diffuse),
            "specular": image(surface.specular), "roughness": image(surface.roughness[:, None]),
            "highlight": image(highlight[:, None]),
            "law": image(torch.stack([surface.law.rough, surface.law.local, surface.law.dolp_factor], dim=1)),
        }  # fmt: skip
        arriving = bounce.arriving(seen, normal, surface, body[0])
        arriving = arriving + bounce.surroundings(seen, normal, surface, strength)
        bounced = torch.stack([image(part) for part in arriving])
        scene = torch.stack([image(part) for part in stokes]) + bounce.smooth(bounced, seen.mask)
        given = seen.mask if jitter is None else _redrawn(seen.mask, jitter)
        at = given.reshape(-1).nonzero()[:, 0]
        measured, covariance, clipped = photograph(scene, truth["diffuse"], seen.mask, seen.rays, at, errors)
        return Photo(measured, covariance, clipped, at, given, seen.rays, seen.mask, truth)


def batch(photo: Photo) -> Batch:
    """What the network is given of photographs, and what it should say."""
    return Batch(
        channels=channels(photo),
        mask=photo.given & photo.mask,
        **{name: value.permute(0, 3, 1, 2) for name, value in photo.truth.items()},
    )


def channels(photo: Photo) -> Tensor:
    """What `stages/cues` makes of the measured pixels, (B, N, H, W), 0 elsewhere; channels last in memory."""
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


def _mirrored(pixels: Indices, flip: bool) -> tuple[Indices, NDArray[np.float32]]:
    """Each half of the time: left for right, top for bottom, x for y; and what that does to vectors, (3, 3)."""
    change = np.eye(3, dtype=np.float32)
    for axis in range(3):
        if not flip or torch.rand(()) < 0.5:
            continue
        if axis < 2:
            pixels, change[axis] = np.flip(pixels, 1 - axis), -change[axis]
        else:  # transposing the array takes (x, y up) to (−y, −x)
            pixels, change[:2] = pixels.T, -change[1::-1]
    return pixels, change


def _redrawn(mask: Tensor, jitter: Tensor) -> Tensor:
    """A third of the masks one pixel wider, a third one pixel thinner."""
    solid = mask[:, None].float()
    wider = F.max_pool2d(solid, 3, 1, 1)[:, 0] > 0.5
    thinner = -F.max_pool2d(-solid, 3, 1, 1)[:, 0] > 0.5
    part = jitter[:, None, None]
    return torch.where(part < 0.33, wider, torch.where(part < 0.66, thinner, mask))
