"""In: exposure brackets of anything that stood still. Out: a sensor's noise at each ISO, without flat frames.

Two exposures of one scene, h₂ = r h₁ but for noise, leave d = h₂ − r h₁, in which the scene drops out however rich it
is: var d / (1 + r²) lies on the sensor's line at the signal (h₂ + r² h₁) / (1 + r²). Second differences take out what
changes slowly besides; where a tile has edges, what registration and aliasing leave there is fitted beside the line.

References
----------
Janesick, Photon Transfer, SPIE 2007, ch. 5; Foi et al., Practical Poissonian-Gaussian noise modeling, IEEE TIP 2008.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polcap.calibrate import photon_transfer
from polcap.calibrate.photographs import CLIP, Photograph, listed
from polcap.errors import CaptureError
from polcap.formats.capture import layouts
from polcap.images import Floats, NoiseLine
from polcap.stages.hdr import exposure, frame_motion, noise, planes
from polcap.stages.hdr.planes import Signals

_PARTS = 16  # of the picture, whose scatter is the doubt
_LEAST_TILES = 80
_MOST_PX = 1.5e6  # looked at per pair; twice what a merge needs
_LEAST_RATIO = 1.2  # of two exposures; nearer ones are pairs for `flat/`
_MOST_SHIFT_PX = 40.0  # beyond which two frames are not one scene
_TRIM = 5.0  # σ beyond which a tile shows something that moved


@dataclass(frozen=True)
class _Tiles:
    """What the tiles of a pair say, T of them."""

    level: Floats  # (T, C) signal that their noise belongs to
    variance: Floats  # (T, C)
    edges: Floats  # (T, C) mean squared gradient, as the same pair would leave it were it shifted by a pixel
    part: NDArray[np.int_]  # (T,) of the picture


def _rooms(folder: Path) -> list[Path]:
    """`bracket/` itself where it holds photographs, and each of its sub-folders: one bracket each."""
    there = layouts.children(folder)
    inner = [path for path in there if path.is_dir()]
    return [folder, *inner] if len(inner) < len(there) else inner


def brackets(folder: Path) -> list[list[Photograph]]:
    """The photographs of every bracket, darkest first.

    Raises
    ------
    CaptureError
        There is none.
    """
    found = [listed(place) for place in _rooms(folder)]
    if not found:
        raise CaptureError(f"{folder}: holds no bracket; put the exposures of one still scene into it")
    return [sorted(one, key=lambda shot: shot.exif.relative_exposure or 0.0) for one in found]


def measure(taken: list[list[Photograph]]) -> tuple[NoiseLine, ...]:
    """The line of every ISO that has two exposures of one bracket.

    Raises
    ------
    CaptureError
        No two frames of a bracket have one ISO, or they moved, or what they show is all of one brightness.
    """
    found: dict[float, list[_Tiles]] = {}
    sites: Floats = np.ones(3)
    moved = 0
    for bracket in taken:
        for first, second in pairwise(bracket):
            if first.setting[0] != second.setting[0]:
                continue
            one, two = first.image(), second.image()
            a, b = planes.signals(one, CLIP), planes.signals(two, CLIP)
            if a.shape != b.shape:
                raise CaptureError(
                    f"{second.path}: has another size than {first.path.name}; keep one camera per bracket"
                )
            views = frame_motion.view(a), frame_motion.view(b)
            if frame_motion.moved(str(second.path), *views, _MOST_SHIFT_PX) is not None:
                moved += 1
                continue
            sites = photon_transfer.photosites(one, a.shape[0])
            found.setdefault(first.setting[0], []).extend(_pair(a, b))
    if not any(len(tiles) for tiles in found.values()):
        where = taken[0][0].path.parent
        why = f"the camera moved between {moved} of them" if moved else "no two well exposed frames share an ISO"
        raise CaptureError(
            f"{where}: the bracket tells no noise ({why}); lock camera and ISO, and step the exposure time"
        )
    return tuple(_line(iso, tiles, sites, taken[0][0]) for iso, tiles in sorted(found.items()) if tiles)


def _pair(a: Signals, b: Signals) -> Iterator[_Tiles]:
    """What two frames say, brighter or darker; nothing where they share too little."""
    told = exposure.ratio(a, b)
    if told is None or not np.all(np.maximum(told.value, 1 / told.value) > _LEAST_RATIO):
        return
    r = told.value.astype(np.float32)[:, None, None]
    weight = (1 / (1 + told.value**2)).astype(np.float32)[:, None, None]
    columns: tuple[list[Floats], ...] = ([], [], [])
    for rows in noise.strips(a.usable.shape[0], a.usable.shape[1], _MOST_PX):
        one, two = a.rows(rows), b.rows(rows)
        whole = noise.usable_tiles(a.usable[rows] & b.usable[rows])
        rough = noise.roughness(two - r * one)
        gx, gy = two[:, 1:-1, 2:] - two[:, 1:-1, :-2], two[:, 2:, 1:-1] - two[:, :-2, 1:-1]
        maps = ((two + r * r * one)[:, 1:-1, 1:-1] * weight, rough * rough * weight, (gx * gx + gy * gy) / 4 * weight)
        for column, values in zip(columns, maps):
            column.append(noise.tiles(values, whole))
    level, variance, edges = (np.concatenate(column).astype(np.float64) for column in columns)
    part = np.arange(len(level)) * _PARTS // max(len(level), 1)
    good = np.isfinite(level).all(axis=1)
    yield _Tiles(level[good], variance[good], edges[good], part[good])


def _line(iso: float, tiles: list[_Tiles], sites: Floats, where: Photograph) -> NoiseLine:
    level, variance, edges = (
        np.concatenate([getattr(t, name) for t in tiles]) for name in ("level", "variance", "edges")
    )
    part = np.concatenate([t.part for t in tiles])
    bright = level.max(initial=0.0) if len(level) else 0.0
    if len(level) < _LEAST_TILES or bright < 2 * max(float(level.min()), 1e-3):
        raise CaptureError(
            f"{where.path.parent}: the bracket at ISO {iso:g} shows {len(level)} usable tiles, {_LEAST_TILES} of "
            "unlike brightness are needed; photograph something with light and dark parts that fills the picture"
        )
    solved = [_solved(level[:, c], variance[:, c], edges[:, c], part) for c in range(level.shape[1])]
    slope, floor, slope_sigma, floor_sigma = np.array(solved).T
    return photon_transfer.as_line(iso, (slope, slope_sigma), (floor, floor_sigma), sites, "bracket")


def _solved(
    level: Floats, variance: Floats, edges: Floats, part: NDArray[np.int_]
) -> tuple[float, float, float, float]:
    """Slope, height and their 1σ, the scatter of the picture's parts (jackknife)."""
    start = _fitted(level, variance, edges)
    model = _model(start, level, edges)
    sane = np.abs(variance / model - 1) < _TRIM * np.sqrt(2 / noise.FREEDOM)
    level, variance, edges, part = level[sane], variance[sane], edges[sane], part[sane]
    slope, floor, _ = _fitted(level, variance, edges)
    each = [_fitted(level[part != p], variance[part != p], edges[part != p])[:2] for p in np.unique(part)]
    spread = np.std(each, axis=0) * np.sqrt(len(each) - 1)
    return float(slope), float(floor), float(spread[0]), float(spread[1])


def _fitted(level: Floats, variance: Floats, edges: Floats) -> Floats:
    """(3,) of variance = slope · level + floor + k · edges by relative least squares."""
    matrix = np.stack([level, np.ones_like(level), edges], axis=1)
    model = np.full_like(variance, float(np.median(variance)))
    found: Floats = np.zeros(3)
    least = 0.05 * float(np.median(variance))
    for _ in range(8):
        weighted = matrix / np.maximum(model, least)[:, None]
        right = variance / np.maximum(model, least)
        scale = np.linalg.norm(weighted, axis=0)
        found = np.linalg.lstsq(weighted / scale, right, rcond=None)[0] / scale
        model = _model(found, level, edges)
    return found


def _model(found: Floats, level: Floats, edges: Floats) -> Floats:
    return np.asarray(np.maximum(found[0] * level + found[1] + found[2] * edges, 1e-12))
