"""Simulated photographs for training: traced views, random materials, flash and camera -> channels and truth.

Every step gets a new batch. Cues are computed by `stages/cues`, the same code as for captures.
"""

from dataclasses import dataclass
from functools import partial
from math import isqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from polcap.image_values import Bools, Indices, Quality
from polcap.stages import cues
from polcap.training import bounced_light, materials, traced_views
from polcap.training.bounced_light import ObjectPixels
from polcap.training.camera_errors import CameraErrors, photograph


@dataclass(frozen=True)
class Batch:
    """Training batch of the main network: input and target; pixels outside `mask` are ignored."""

    channels: Tensor  # (B, N, H, W)
    mask: Tensor  # (B, H, W) bool: on the object and in the mask that the network sees
    normal: Tensor  # (B, 3, H, W) in the frame of each ray
    depth: Tensor  # (B, 1, H, W) units of traced_views.depth_unit, mean 0
    diffuse: Tensor  # (B, 3, H, W)
    specular: Tensor  # (B, 3, H, W)
    roughness: Tensor  # (B, 1, H, W)
    highlight: Tensor  # (B, 1, H, W) share of S0 that the surface reflects
    law: Tensor  # (B, 3, H, W) fields of `body.Law`, for the rendering loss


@dataclass(frozen=True)
class SimulatedPhotographs:
    """Stokes parameters measured at the M pixels `at` of the input mask, and true maps at every pixel."""

    stokes: Tensor  # (3, M, 3)
    covariance: Tensor  # (6, M, 3)
    clipped: Tensor  # (M,) bool
    at: Tensor  # (M,) indices into B·H·W
    input_mask: Tensor  # (B, H, W) bool, the mask that the network sees
    rays: Tensor  # (B, H, W, 3)
    mask: Tensor  # (B, H, W) bool, the object
    truth: dict[str, Tensor]  # (B, H, W, ·): normal (ray frame), depth, diffuse, specular, roughness, highlight, law


@dataclass(frozen=True)
class ViewBatch:
    """Traced views of B objects at one size, before materials and light."""

    mask: Tensor  # (B, H, W) bool
    rays: Tensor  # (B, H, W, 3) camera frame, surface to camera
    turn: Tensor  # (B, 3, 3) rotation from the object's frame to the camera's
    flash: Tensor  # (B, 3) camera frame, in units of the object's distance
    pixels: ObjectPixels  # of all objects


class Simulator:
    """Traced views and materials on one device; draws batches from torch's global random state."""

    def __init__(
        self, views: dict[str, NDArray[Any]], library: materials.MaterialLibrary, device: torch.device,
        bounces: bool = True,
    ) -> None:  # fmt: skip
        """With `bounces`, parts of an object light each other."""
        self.library, self.device, self.bounces = library, device, bounces
        self.size = views["mask"].shape[1]
        self.camera = views["camera"]
        self.views = {
            name: views[name].reshape(-1, views[name].shape[-1]) for name in traced_views.ARRAYS
        }  # one row per pixel

    def draw_batch(self, count: int, size: int) -> Batch:
        """Photographs of `count` random objects at size² pixels (at most the cache's), with all augmentations."""
        pick = torch.randint(len(self.camera), (count,)).numpy()
        views = self.gather(pick, size, flip=True)
        strength = 0.92 + 0.16 * torch.rand(count, device=self.device)  # error of the chart's exposure
        jitter = torch.rand(count, device=self.device)
        return to_batch(self.photograph(views, strength, CameraErrors.draw(count, self.device), jitter))

    def gather(self, pick: Indices, size: int, *, flip: bool) -> ViewBatch:
        """Read cached traced views by index, subsampled to size² pixels. With `flip`, they are mirrored at random."""
        # rows y and columns x in the cached view, of the pixels of a subsampled and mirrored one
        full, area = self.size, size * size
        mirrored, change = _mirror(np.arange(area).reshape(size, size), flip)
        order = mirrored.reshape(-1)
        sampled = np.floor((np.arange(size) + 0.5) * (full / size)).astype(np.int64)
        y, x = sampled[order // size], sampled[order % size]
        # the object's pixels: M indices into B·H·W, and their object, view, and row in the cache's arrays
        mask = self.views["mask"].reshape(-1, full * full)[pick][:, y * full + x]
        inside = np.flatnonzero(mask)
        owner, at = np.divmod(inside, area)
        view = pick[owner]
        rows = (view * full + y[at]) * full + x[at]
        met, (escaped, hidden) = np.full((len(at), bounced_light.RAYS), -1), np.zeros((2, len(at)), np.float32)
        if self.bounces:
            met, escaped, hidden = self._seen_pixels(view, y[at], x[at], order, mask, owner)

        def tensor(array: NDArray[Any]) -> Tensor:
            return torch.from_numpy(array).to(self.device)

        def read(name: str) -> Tensor:
            return tensor(self.views[name].take(rows, axis=0)).float()

        camera, mirror, owners = tensor(self.camera[pick]), tensor(change), tensor(owner)  # as in `open_cache`
        focal, distance, unit = camera[:, 0, None], camera[:, 3], camera[:, 4]
        right, down = ((tensor(a).float() - camera[:, k : k + 1]) / focal for a, k in ((x, 1), (y, 2)))
        rays = F.normalize(torch.stack([-right, down, torch.ones_like(down)], dim=-1), dim=-1) @ mirror.T
        v, depth = rays.reshape(-1, 3)[tensor(inside)], read("depth")[:, 0]
        z = 1 + depth * (unit / distance)[owners]  # in units of the object's distance
        pixels = ObjectPixels(
            index=tensor(inside), owner=owners, v=v, normal=read("normal") @ mirror.T, position=read("position"),
            place=-v * (z / v[:, 2])[:, None], depth=depth, lit=read("lit")[:, 0], met=tensor(met),
            open=tensor(escaped), hidden=tensor(hidden),
        )  # fmt: skip
        return ViewBatch(
            mask=tensor(mask).reshape(-1, size, size),
            rays=rays.reshape(-1, size, size, 3),
            turn=mirror @ camera[:, 5:14].reshape(-1, 3, 3),
            flash=F.pad(camera[:, 14:16], (0, 1)) @ mirror.T,
            pixels=pixels,
        )

    def _seen_pixels(
        self, view: Indices, y: Indices, x: Indices, order: Indices, mask: Bools, owner: Indices
    ) -> tuple[Indices, NDArray[np.float32], NDArray[np.float32]]:
        """The fields `met`, `open` and `hidden` of `ObjectPixels` for pixels (y, x) of the cached views `view`.

        `order` are the pixels that remain after subsampling, `mask` (B, H·W) their masks, `owner` the object of each.
        """
        full, area = self.size, len(order)
        size, coarse = isqrt(area), full // bounced_light.COARSE
        new_place = np.full(2**16, -1, np.int64)  # in the thinned and mirrored view, for each value of `met`
        thinned = np.arange(full) * size // full
        new_place[: full * full] = np.argsort(order)[(thinned[:, None] * size + thinned).reshape(-1)]
        new_place[[bounced_light.NOWHERE, bounced_light.ESCAPED]] = -1
        number = np.where(mask.reshape(-1), np.cumsum(mask) - 1, -1)  # of each pixel among those of all objects
        cell = (view * coarse + y // bounced_light.COARSE) * coarse + x // bounced_light.COARSE
        hit = self.views["met"].take(cell, axis=0)  # (M, RAYS) pixel of the cache that each bounced ray meets
        place, escaped = new_place[hit], hit == bounced_light.ESCAPED
        met = np.where(place >= 0, number[place + owner[:, None] * area], -1)
        share = escaped[:, -bounced_light.SHARP :].mean(axis=1, dtype=np.float32)
        return met, share, 1 - escaped.mean(axis=1, dtype=np.float32)

    def photograph(
        self, views: ViewBatch, strength: Tensor, errors: CameraErrors, jitter: Tensor | None = None
    ) -> SimulatedPhotographs:
        """Draw materials for traced views, simulate the flash light and measure it with a camera.

        strength (B,): S0 of a white plane that faces the flash at the object's distance. jitter (B,): as for
        `_jitter_mask`, which varies the input mask.
        """
        pixels = views.pixels
        own = pixels.owner
        surface = materials.draw_surface(
            self.library, pixels.normal, pixels.position, views.turn, own, hidden=pixels.hidden
        )
        to_flash = views.flash[own] - pixels.place
        normal, body, specular = materials.reflect(surface, pixels.v, to_flash, pixels.lit * strength[own])
        stokes = body + specular
        highlight = 1 - (body[0].sum(dim=1) + 1e-4) / (stokes[0].sum(dim=1) + 1e-4)
        image = partial(_image, at=pixels.index, shape=views.mask.shape)
        truth = {
            "normal": image(normal), "depth": image(pixels.depth[:, None]), "diffuse": image(surface.diffuse),
            "specular": image(surface.specular), "roughness": image(surface.roughness[:, None]),
            "highlight": image(highlight[:, None]),
            "law": image(torch.stack([surface.law.rough, surface.law.local, surface.law.dolp_factor], dim=1)),
        }  # fmt: skip
        indirect = bounced_light.bounced_stokes(pixels, normal, surface, body[0])
        indirect = indirect + bounced_light.mirrored_surroundings(pixels, views.flash, normal, surface, strength)
        indirect = torch.stack([image(part) for part in indirect])
        scene = torch.stack([image(part) for part in stokes]) + bounced_light.smooth(indirect, views.mask)
        input_mask = views.mask if jitter is None else _jitter_mask(views.mask, jitter)
        at = input_mask.reshape(-1).nonzero()[:, 0]
        measured, covariance, clipped = photograph(scene, truth["diffuse"], views.mask, views.rays, at, errors)
        return SimulatedPhotographs(measured, covariance, clipped, at, input_mask, views.rays, views.mask, truth)


def to_batch(photo: SimulatedPhotographs) -> Batch:
    """Convert simulated photographs to a training batch (channels and true maps) of the main network."""
    return Batch(
        channels=channels(photo),
        mask=photo.input_mask & photo.mask,
        **{name: value.permute(0, 3, 1, 2) for name, value in photo.truth.items()},
    )


def channels(photo: SimulatedPhotographs) -> Tensor:
    """Cue channels (B, N, H, W) of simulated photographs by `stages/cues`, 0 outside the input mask; channels last."""
    ratio, sigma, dolp, normalized = cues.polarization(photo.stokes, photo.covariance)
    clipped, at = photo.clipped, photo.at
    row = SimpleNamespace(  # all pixels as one image row
        radiance=photo.stokes[0][None], ratio=ratio[:, None], ratio_sigma=sigma[None], dolp=dolp[None],
        normalized_stokes=normalized[:, None], rays=photo.rays.reshape(1, -1, 3)[:, at],
        mask=torch.ones_like(clipped)[None], quality=(clipped.to(torch.uint8) * int(Quality.CLIPPED))[None],
    )  # fmt: skip
    flat = cues.channels(row)[:, 0].T  # (M, N)
    return _image(flat, at, photo.mask.shape).permute(0, 3, 1, 2)


def _image(flat: Tensor, at: Tensor, shape: torch.Size) -> Tensor:
    """Images (B, H, W, ·) of this shape (B, H, W) with values (M, ·) at the indices `at` (M,), 0 elsewhere."""
    return flat.new_zeros(shape.numel(), flat.shape[1]).index_copy(0, at, flat).reshape(*shape, -1)


def _mirror(pixels: Indices, flip: bool) -> tuple[Indices, NDArray[np.float32]]:
    """Mirror pixel indices (H, W) at random about x, y, diagonal; also the matrix (3, 3) that mirrors vectors."""
    change = np.eye(3, dtype=np.float32)
    for axis in range(3):
        if not flip or torch.rand(()) < 0.5:
            continue
        if axis < 2:
            pixels, change[axis] = np.flip(pixels, 1 - axis), -change[axis]
        else:  # transposing the array takes (x, y up) to (−y, −x)
            pixels, change[:2] = pixels.T, -change[1::-1]
    return pixels, change


def _jitter_mask(mask: Tensor, jitter: Tensor) -> Tensor:
    """Vary masks (B, H, W) by random numbers (B,) 0…1: a third become one pixel wider, a third one pixel thinner."""
    solid = mask[:, None].float()
    wider = F.max_pool2d(solid, 3, 1, 1)[:, 0] > 0.5
    thinner = -F.max_pool2d(-solid, 3, 1, 1)[:, 0] > 0.5
    choice = jitter[:, None, None]
    return torch.where(choice < 0.33, wider, torch.where(choice < 0.66, thinner, mask))
