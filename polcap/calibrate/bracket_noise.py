"""A sensor's noise at each ISO from exposure brackets of any still scene, without flat frames.

Two exposures h₁ and h₂ of one scene have the ratio r, so in d = h₂ − r h₁ the scene cancels and noise remains:
var d / (1 + r²) lies on the sensor's noise line at the signal (h₂ + r² h₁) / (1 + r²). Second differences remove slow
changes. In tiles with edges, registration errors and aliasing add variance, which is fitted together with the line.

References
----------
Janesick, Photon Transfer, SPIE 2007, ch. 5; Foi et al., Practical Poissonian-Gaussian noise modeling, IEEE TIP 2008.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polcap.calibrate import photon_transfer
from polcap.calibrate.calibration_photographs import CLIP, Photograph, photographs_in
from polcap.calibration_values import NoiseLine
from polcap.errors import CaptureError
from polcap.formats.capture import folder_names
from polcap.image_values import Bools, Floats
from polcap.optics import robust
from polcap.stages.hdr import bracket, exposure, noise, planes
from polcap.stages.hdr.planes import Signals

_PARTS = 16  # of the picture, for the jackknife
_LEAST_TILES = 80
_MOST_PX = 1.5e6  # measured pixels of a pair; a merge uses half of them
_LEAST_RATIO = 1.2  # of two exposures; closer ones are not used
_MOST_SHIFT_PX = 40.0  # more: the frames show different scenes


@dataclass(frozen=True)
class BracketTiles:
    """Signal and noise variance of T tiles in a pair of frames of one bracket."""

    level: Floats  # (T, C) signal
    variance: Floats  # (T, C) at that signal
    edges: Floats  # (T, C) variance that a shift of the pair by one pixel would add
    part: NDArray[np.int_]  # (T,) of the picture


def brackets(folder: Path) -> list[list[Photograph]]:
    """Photographs of every calibration bracket, darkest first: `bracket/` itself and each of its sub-folders.

    Raises CaptureError if there is none.
    """
    children = folder_names.children(folder)
    folders = [path for path in children if path.is_dir()]
    folders += [folder] if len(folders) < len(children) else []
    if not folders:
        raise CaptureError(f"{folder}: holds no bracket; put the exposures of one still scene into it")
    found = [photographs_in(place) for place in folders]
    return [sorted(one, key=lambda shot: shot.exif.relative_exposure or 0.0) for one in found]


def measure(brackets: list[list[Photograph]]) -> tuple[NoiseLine, ...]:
    """Measure the noise line (variance over signal) of every ISO that has two exposures in one bracket.

    Raises CaptureError if no two frames of a bracket share an ISO, if they moved, or the scene has one brightness.
    """
    tiles: dict[float, list[BracketTiles]] = {}
    sites: Floats = np.ones(3)
    moved = 0
    for first, second in (pair for frames in brackets for pair in pairwise(frames)):
        iso = first.setting[0]
        if iso != second.setting[0]:
            continue
        one, two = first.image(), second.image()
        a, b = planes.signals(one, CLIP), planes.signals(two, CLIP)
        if a.shape != b.shape:
            raise CaptureError(f"{second.path}: has another size than {first.path.name}; keep one camera per bracket")
        pyramids = bracket.brightness_pyramid(a), bracket.brightness_pyramid(b)
        if bracket.measure_motion(str(second.path), *pyramids, _MOST_SHIFT_PX) is not None:
            moved += 1
            continue
        sites = photon_transfer.photosites(one, a.shape[0])
        if (pair_tiles := _pair(a, b)) is not None:
            tiles.setdefault(iso, []).append(pair_tiles)
    folder = brackets[0][0].path.parent
    if not tiles:
        reason = f"the camera moved between {moved} of them" if moved else "no two well exposed frames share an ISO"
        raise CaptureError(
            f"{folder}: the noise cannot be measured from this bracket ({reason}); lock camera and ISO, and step the "
            "exposure time"
        )
    return tuple(_line(iso, pairs, sites, folder) for iso, pairs in sorted(tiles.items()))


def _pair(a: Signals, b: Signals) -> BracketTiles | None:
    """Measure signal and variance in tiles of two frames, darker `a` and brighter `b`; None for similar exposures."""
    ratio = exposure.of_tiles(*exposure.common_tiles(a, b))
    if ratio is None or not np.all(np.maximum(ratio, 1 / ratio) > _LEAST_RATIO):
        return None
    r = ratio.astype(np.float32)[:, None, None]
    weight = 1 / (1 + r * r)

    def maps(one: Floats, two: Floats) -> tuple[Floats, ...]:
        level, differences = noise.inner(two + r * r * one), noise.second_differences(two - r * one)
        return level * weight, differences**2 * weight, noise.squared_gradients(two) * weight

    level, variance, edges = noise.tile_columns((a, b), maps, _MOST_PX)
    part = np.arange(len(level)) * _PARTS // max(len(level), 1)
    good = np.isfinite(level).all(axis=1)
    return BracketTiles(level[good], variance[good], edges[good], part[good])


def _line(iso: float, pairs: list[BracketTiles], sites: Floats, folder: Path) -> NoiseLine:
    """Noise line of an ISO from all pairs of its frames. Raises CaptureError: they show too few tiles."""
    level, variance, edges = (
        np.concatenate([getattr(pair, name) for pair in pairs]) for name in ("level", "variance", "edges")
    )
    part = np.concatenate([pair.part for pair in pairs])
    if len(level) < _LEAST_TILES or level.max() < 2 * max(float(level.min()), 1e-3):
        raise CaptureError(
            f"{folder}: the bracket at ISO {iso:g} shows {len(level)} usable tiles, {_LEAST_TILES} of different "
            "brightness are needed; photograph something with light and dark parts that fills the picture"
        )
    fits = [_fit(level[:, c], variance[:, c], edges[:, c], part) for c in range(level.shape[1])]
    (slope, floor), (slope_sigma, floor_sigma) = np.array(fits).transpose(1, 2, 0)
    return photon_transfer.noise_line(iso, (slope, slope_sigma), (floor, floor_sigma), sites, "bracket")


def _fit(level: Floats, variance: Floats, edges: Floats, part: NDArray[np.int_]) -> tuple[Floats, Floats]:
    """Fit one channel's noise line: slope and floor (2,), and 1σ from the scatter between parts of the picture."""
    least = 0.05 * float(np.median(variance))  # limits the weights of dark tiles

    def line(chosen: Bools) -> Floats:
        fit = robust.fit_noise_line(
            level[chosen], variance[chosen], noise.FREEDOM, least=least, edges=edges[chosen], outliers=True
        )
        return np.array([fit.slope, fit.floor])

    return line(part >= 0), robust.jackknife(np.array([line(part != one) for one in np.unique(part)]))
