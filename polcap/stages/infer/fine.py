"""The fine pass: relief that the network, which sees the object small, could not see.

A second, small network looks at tiles of the crop at its own pixels, beside what is known by then, and says how the
normals deviate. Of its answer only what is finer than the first network sees is kept, so that shape stays as it was.
Training (`training/fine_*.py`) makes its channels by `encode` too.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.errors import ModelError
from polcap.images import Cues, Floats, Network, RunNetwork
from polcap.optics import frames
from polcap.optics.resize import area_mean
from polcap.stages import cues as seen

ENCODING = "fine 1"
GUESSED = (
    "normal_x", "normal_y", "normal_z",  # joined so far, frame of each ray
    "smooth_x", "smooth_y", "smooth_z",  # the first network's alone
    "log_sigma",  # ln of the first network's expected error, degrees
    "roughness",
    "log_shrink",  # ln of how many pixels one is that the first network sees
)  # fmt: skip
CHANNELS = (*seen.CHANNELS, *GUESSED)
SIZE_MULTIPLE = 8
COARSEST = 2.0  # pixels that the first network sees, 1σ: what is coarser is not the fine pass's to tell
_TILE, _MARGIN = 512, 64  # px, multiples of SIZE_MULTIPLE; the network looks 62 px far


@dataclass(frozen=True)
class Guess:
    """What is known before the fine pass, on the crop's grid (H, W)."""

    normal: Floats  # (H, W, 3) joined, camera frame
    smooth: Floats  # (H, W, 3) the first network's alone, camera frame
    sigma: Floats  # (H, W) its expected error, degrees
    roughness: Floats  # (H, W)
    shrink: float  # px of the crop that it saw as one


def encode(cues: Cues, guess: Guess) -> Floats:
    """The fine network's input, CHANNELS in order, (N, H, W) float32, 0 outside the mask."""
    plane = np.full(cues.mask.shape, np.log(guess.shrink))
    guessed = [
        *np.moveaxis(frames.to_ray_frame(guess.normal, cues.rays), -1, 0),
        *np.moveaxis(frames.to_ray_frame(guess.smooth, cues.rays), -1, 0),
        np.log(np.maximum(guess.sigma, 0.5)), guess.roughness, plane,
    ]  # fmt: skip
    return np.concatenate([seen.channels(cues), np.stack(guessed) * cues.mask]).astype(np.float32)


def refined(cues: Cues, guess: Guess, network: Network, run: RunNetwork) -> Floats:
    """Normals (H, W, 3), camera frame, with the fine network's relief.

    Raises
    ------
    ModelError
        The network was made for other channels, or gives something else.
    """
    if network.channels != CHANNELS:
        raise ModelError(f"fine model {network.digest[:8]} expects other channels; use the one of this version")
    relief = np.zeros((*cues.mask.shape, 3), np.float32)
    tiles = list(_tiles(cues.mask))
    looks = [partial(_answer, cues, guess, inner, outer, network, run) for inner, outer in tiles]
    for (inner, _), found in zip(tiles, parallel.results(looks, network.at_once), strict=True):
        relief[inner] = found
    relief = finer(relief, cues.mask, guess.shrink)
    local = frames.to_ray_frame(guess.normal, cues.rays) + relief
    moved = frames.from_ray_frame(local, cues.rays)
    return np.asarray(moved / np.maximum((frames.dot(moved, moved) ** 0.5)[..., None], 1e-6))


def finer(image: Floats, mask: NDArray[np.bool_], shrink: float) -> Floats:
    """An image (H, W, 3) without what is coarser than COARSEST, 0 outside the mask."""
    height, width = mask.shape
    small = max(1, round(height / shrink)), max(1, round(width / shrink))
    inside = mask.astype(np.float32)
    coarse, share = (
        cv2.GaussianBlur(area_mean(part, small), (0, 0), COARSEST) for part in (image * inside[..., None], inside)
    )
    back = cv2.resize(coarse / np.maximum(share, 1e-3)[..., None], (width, height))
    return np.asarray((image - back) * inside[..., None])


Window = tuple[slice, slice]


def _tiles(mask: NDArray[np.bool_]) -> Iterator[tuple[Window, Window]]:
    """Tiles that show the object, and the same with a margin, cut at the picture's edge."""
    height, width = mask.shape
    for y in range(0, height, _TILE):
        for x in range(0, width, _TILE):
            inner = np.s_[y : min(y + _TILE, height), x : min(x + _TILE, width)]
            outer = np.s_[max(0, y - _MARGIN) : y + _TILE + _MARGIN, max(0, x - _MARGIN) : x + _TILE + _MARGIN]
            if mask[inner].any():
                yield inner, outer


def _part(cues: Cues, guess: Guess, window: Window) -> tuple[Cues, Guess]:
    """What `encode` takes of a window, so that no channels of the whole crop are ever held."""
    single = ("radiance", "ratio_sigma", "dolp", "rays", "mask", "quality")
    double = ("ratio", "normalized_stokes")
    shown = {name: getattr(cues, name)[window] for name in single}
    shown |= {name: getattr(cues, name)[(slice(None), *window)] for name in double}
    known = {name: getattr(guess, name)[window] for name in ("normal", "smooth", "sigma", "roughness")}
    return replace(cues, **shown), replace(guess, **known)


def _answer(cues: Cues, guess: Guess, inner: Window, outer: Window, network: Network, run: RunNetwork) -> Floats:
    """Deviation of the normals (h, w, 3) of the tile `inner`, ray frame, by what `outer` shows."""
    picture = encode(*_part(cues, guess, outer))
    _, height, width = picture.shape
    more = ((0, 0), (0, -height % SIZE_MULTIPLE), (0, -width % SIZE_MULTIPLE))
    relief = run(network, np.pad(picture, more)[None]).get("relief")
    if relief is None or relief.shape[1] != 3:
        raise ModelError(f"fine model {network.digest[:8]} makes no relief; use the one of this version")
    y, x = (within.start - around.start for within, around in zip(inner, outer))
    high, wide = (within.stop - within.start for within in inner)
    return np.moveaxis(relief[0, :, y : y + high, x : x + wide], 0, -1)
