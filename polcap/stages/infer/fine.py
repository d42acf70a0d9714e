"""Refinement of the normals: a second, small network adds relief finer than the main network resolves.

It reads tiles of the crop at full resolution, with the estimate so far, and returns a deviation of the normals. Only
the part finer than the main network's pixels is added, so the overall shape does not change. `encode` makes the input,
also for training (`training/fine_*.py`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from polcap import parallel
from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.optics.resize import area_mean
from polcap.stage_values import Cues, Network, RunNetwork
from polcap.stages import cues as cue_channels
from polcap.stages.infer.sizes_and_positions import run_network

ENCODING = "fine 1"
Window = tuple[slice, slice]

CHANNELS = (
    *cue_channels.CHANNELS,
    "normal_x", "normal_y", "normal_z",  # by network and inversion, frame of each ray
    "smooth_x", "smooth_y", "smooth_z",  # by the main network alone
    "log_sigma",  # ln of the main network's expected error, degrees
    "roughness",
    "log_shrink",  # ln of the crop's pixels per pixel of the main network
)  # fmt: skip
SIZE_MULTIPLE = 8  # the network's height and width are multiples of this
_COARSEST = 2.0  # 1σ in the main network's pixels: it resolves structure that is coarser
_TILE, _MARGIN = 512, 32  # px, multiples of SIZE_MULTIPLE; a margin of 64 changes normals by .05° at most


@dataclass(frozen=True)
class CoarseEstimate:
    """Estimate before refinement, on the crop's grid (H, W)."""

    normal: Floats  # (H, W, 3) by network and inversion, camera frame
    smooth: Floats  # (H, W, 3) by the main network alone, camera frame
    sigma: Floats  # (H, W) expected error of `smooth`, degrees
    roughness: Floats  # (H, W)
    shrink: float  # the crop's pixels per pixel of the main network


def encode(cues: Cues, estimate: CoarseEstimate) -> Floats:
    """Input channels of the refinement network, in the order of CHANNELS, (N, H, W) float32, 0 outside the mask."""
    channels = [
        *np.moveaxis(frames.to_ray_frame(estimate.normal, cues.rays), -1, 0),
        *np.moveaxis(frames.to_ray_frame(estimate.smooth, cues.rays), -1, 0),
        np.log(np.maximum(estimate.sigma, 0.5)), estimate.roughness,  # 0.5° at least
        np.full(cues.mask.shape, np.log(estimate.shrink), np.float32),
    ]  # fmt: skip
    return np.concatenate([cue_channels.channels(cues), np.stack(channels) * cues.mask]).astype(np.float32)


def refine(cues: Cues, estimate: CoarseEstimate, network: Network, run: RunNetwork) -> Floats:
    """Normals (H, W, 3), camera frame, with fine relief added by the refinement network.

    Raises ModelError: the network was made for other channels, or returns other maps.
    """
    relief = np.zeros((*cues.mask.shape, 3), np.float32)
    tiles = list(_tiles(cues.mask))
    calls = [partial(_tile_relief, cues, estimate, inner, outer, network, run) for inner, outer in tiles]
    for (inner, _), found in zip(tiles, parallel.results(calls, network.at_once), strict=True):
        relief[inner] = found
    relief = high_pass(relief, cues.mask, estimate.shrink)
    local = frames.to_ray_frame(estimate.normal, cues.rays) + relief
    return frames.unit(frames.from_ray_frame(local, cues.rays))


def _tiles(mask: Bools) -> Iterator[tuple[Window, Window]]:
    """Divide the object into tiles for the refinement network; yields each tile without and with its margin."""
    height, width = mask.shape
    for y in range(0, height, _TILE):
        for x in range(0, width, _TILE):
            inner = np.s_[y : min(y + _TILE, height), x : min(x + _TILE, width)]
            outer = np.s_[max(0, y - _MARGIN) : y + _TILE + _MARGIN, max(0, x - _MARGIN) : x + _TILE + _MARGIN]
            if mask[inner].any():
                yield inner, outer


def _window(cues: Cues, estimate: CoarseEstimate, window: Window) -> tuple[Cues, CoarseEstimate]:
    """Cut a window out of cues and estimate: channels of the whole crop at once would fill the memory."""
    single = ("radiance", "ratio_sigma", "dolp", "rays", "mask", "quality")
    double = ("ratio", "normalized_stokes")
    cut = {name: getattr(cues, name)[window] for name in single}
    cut |= {name: getattr(cues, name)[(slice(None), *window)] for name in double}
    part = {name: getattr(estimate, name)[window] for name in ("normal", "smooth", "sigma", "roughness")}
    return replace(cues, **cut), replace(estimate, **part)


def _tile_relief(
    cues: Cues, estimate: CoarseEstimate, inner: Window, outer: Window, network: Network, run: RunNetwork
) -> Floats:
    """Run the refinement network on the window `outer`; returns the relief (h, w, 3) of the tile `inner`, ray frame."""
    relief = run_network(encode(*_window(cues, estimate, outer)), network, run, CHANNELS, {"relief": 3})["relief"]
    y, x = (within.start - around.start for within, around in zip(inner, outer))
    height, width = (within.stop - within.start for within in inner)
    return relief[y : y + height, x : x + width]


def high_pass(image: Floats, mask: Bools, shrink: float) -> Floats:
    """High-pass part of an image (H, W, 3): structure too fine for the main network; 0 outside the mask (H, W)."""
    return np.asarray((image - low_pass(image, mask, shrink)) * mask.astype(np.float32)[..., None])


def low_pass(image: Floats, mask: Bools, shrink: float) -> Floats:
    """Low-pass part of an image (H, W, 3) inside the mask (H, W): the structure that the main network resolves.

    The image is averaged down by the factor `shrink`, blurred, and interpolated back.
    """
    height, width = mask.shape
    small = max(1, round(height / shrink)), max(1, round(width / shrink))
    inside = mask.astype(np.float32)
    coarse, share = (
        cv2.GaussianBlur(area_mean(part, small), (0, 0), _COARSEST) for part in (image * inside[..., None], inside)
    )
    return np.asarray(cv2.resize(coarse / np.maximum(share, 1e-3)[..., None], (width, height)))
