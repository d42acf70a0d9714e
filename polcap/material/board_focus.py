"""Fitness of each view of the board: blur at the edges of its squares, and usable paper; unfit views are left out."""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.image_values import Floats
from polcap.material import flash_light
from polcap.material.stokes_view import PosedStokes
from polcap.optics import board as boards
from polcap.optics.board import SQUARES, Board
from polcap.stages import stage

_REACH_PX, _STEPS = 4.0, 33  # of the profile across an edge: largest distance from the edge, and samples
_EVEN = 0.11  # squares; the profile goes no farther: up to there, each side of an edge has one color
# a view is left out if its blur exceeds both: the median blur plus so many px, and so many times the median blur
_MOST_OVER, _MOST_RATIO = 0.5, 1.6


@dataclass(frozen=True)
class BoardSight:
    """Blur and usable paper of the board in each view."""

    blur: tuple[float, ...]  # (K,) 1σ in pixels of the Stokes image; NaN where no edge is visible
    paper: tuple[int, ...]  # (K,) usable points of the paper


@stage(version=2)
def measure(views: tuple[PosedStokes, ...], board: Board) -> BoardSight:
    """Blur and usable points of the paper in each view."""
    paper = tuple(len(flash_light.sample_paper(view, board).radiance) for view in views)
    return BoardSight(tuple(_blur(view, board) for view in views), paper)


def left_out(names: tuple[str, ...], sight: BoardSight) -> dict[str, str]:
    """Reasons, by name, for views with too little paper or much more blur than the others; a blur of NaN is none."""
    blur = sight.blur
    finite = [one for one in blur if np.isfinite(one)]
    middle = float(np.median(finite)) if finite else float("inf")
    limit = max(middle + _MOST_OVER, _MOST_RATIO * middle)
    few = {
        name: f"{count} points of the board's paper are usable, {flash_light.LEAST_POINTS} are needed; show the whole "
        "board, and expose so that its paper does not clip"
        for name, count in zip(names, sight.paper, strict=True)
        if count < flash_light.LEAST_POINTS
    }
    blurred = {
        name: f"it is out of focus or shaken: edges of the board are blurred by {one:.1f} px, in other views by "
        f"{middle:.1f} px"
        for name, one in zip(names, blur, strict=True)
        if one > limit
    }
    return {**blurred, **few}


def _blur(view: PosedStokes, board: Board) -> float:
    """Blur of a view, 1σ [px]: that of the derivative of its mean edge profile; NaN where no edge is visible."""
    edge, across = _edges(board)
    step = 1e-4  # m across the edge, for the scale of the picture there
    ends = [np.stack(view.pixels(edge + sign * step * across), axis=-1) for sign in (-1, 1)]
    scale = np.linalg.norm(ends[1] - ends[0], axis=-1) / (2 * step)  # px per m
    # 0.1: at nine tenths of the points the scale is larger, and the profile ends nearer than `_EVEN`
    reach = min(_REACH_PX, _EVEN * board.square_m * float(np.quantile(scale, 0.1)))  # px
    offset = np.linspace(-reach, reach, _STEPS)  # px across the edge, from ink to paper
    point = edge[:, None] + across[:, None] * (offset / scale[:, None])[..., None]
    x, y = (a.astype(np.float32) for a in view.pixels(point))
    height, width = view.stokes.mask.shape
    inside = ((x > 0) & (y > 0) & (x < width - 1) & (y < height - 1)).all(axis=1)
    if not inside.any():
        return float("nan")
    gray = np.asarray(view.stokes.stokes[0] @ flash_light.gray(view.matrix), np.float32)
    profile = cv2.remap(gray, x[inside], y[inside], cv2.INTER_LINEAR)
    low, high = profile[:, :4].mean(axis=1), profile[:, -4:].mean(axis=1)  # its ends: ink and paper
    contrast = high - low
    clear = contrast > 0.5 * np.median(contrast)  # edges that no chart hides
    edge_profile = ((profile - low[:, None]) / np.maximum(contrast, 1e-6)[:, None])[clear].mean(axis=0)
    between, slope = (offset[1:] + offset[:-1]) / 2, np.maximum(np.diff(edge_profile), 0)
    middle = (slope * between).sum() / slope.sum()
    return float(np.sqrt((slope * (between - middle) ** 2).sum() / slope.sum()))


def _edges(board: Board) -> tuple[Floats, Floats]:
    """World points (M, 3) [m] on edges of the squares, and unit vectors (M, 3) across them, from ink to paper."""
    line = (np.arange(1, SQUARES) - SQUARES / 2) * board.square_m
    along = (np.arange(8 * SQUARES) / 8 + 1 / 16 - SQUARES / 2) * board.square_m  # eight points a square
    a, b = (one.ravel() for one in np.meshgrid(line, along))
    point = np.concatenate([np.stack([a, 0 * a, b], -1), np.stack([b, 0 * a, a], -1)])
    across = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], len(a), axis=0)
    sides = [  # whether ink: at two distances [squares] before the edge, and at two behind it
        [boards.is_ink(board, *(point + share * board.square_m * across)[:, [0, 2]].T) for share in shares]
        for shares in ((-0.1, -0.02), (0.02, 0.1))
    ]
    even = (sides[0][0] == sides[0][1]) & (sides[1][0] == sides[1][1]) & (sides[0][0] != sides[1][0])
    return point[even], across[even] * np.where(sides[0][0], 1.0, -1.0)[even, None]
