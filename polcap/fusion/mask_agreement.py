"""Finds views whose masks contradict the others: a wrong mask, or an object that slid on the board.

The points that lie inside the masks of all views form the visual hull. Where a part of a mask is not covered by the
hull, another mask, or the pose of the object, must be wrong.

References
----------
Laurentini, The visual hull concept for silhouette-based image understanding, IEEE TPAMI 1994.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from polcap.errors import CaptureError
from polcap.fusion.poses import LEAST_VIEWS
from polcap.fusion.values import FusionView
from polcap.images import Bools, Floats
from polcap.optics import projection

_GRID = 80  # points along the longest side of the object's box
_COARSE = 40  # the same, to find this box
_MOST_UNCOVERED = 0.01  # of a mask's area; masks whose outlines err by one cell of the grid leave 0.000
_MOST_LEFT_OUT = 1 / 3  # of the views; where more contradict, nobody knows which are right


def agreeing(views: Sequence[FusionView]) -> tuple[list[FusionView], dict[str, str]]:
    """The views whose masks agree, and the reasons, by name, why the others are left out.

    Raises
    ------
    CaptureError
        More than a third of the views contradict the others, or fewer than three are left.
    """
    used = list(views)
    left_out: dict[str, str] = {}
    points, step = _points(used)
    inside = np.stack([_inside(view, points, step) for view in used])  # (N, P)
    while True:
        shares = _uncovered(used, inside, points, step)
        if max(shares) <= _MOST_UNCOVERED:
            return used, left_out
        worst = _contradicting(used, inside, points, step)
        view = used.pop(worst)
        inside = np.delete(inside, worst, axis=0)
        left_out[view.name] = (
            f"its mask and those of the other views differ by {100 * max(shares):.0f} % of their area, the limit is "
            f"{100 * _MOST_UNCOVERED:g} %: the mask is wrong, or the object moved on the board; look at its mask.png, "
            "and shoot the view again"
        )
        if len(left_out) > _MOST_LEFT_OUT * len(views) or len(used) < LEAST_VIEWS:
            raise CaptureError(
                f"the masks of {len(left_out)} of {len(views)} views contradict the others ({', '.join(left_out)}): "
                "the object moved on the board between the views, or masks are wrong; look at each mask.png, fix the "
                "object to the board, and shoot again"
            )


def _contradicting(views: list[FusionView], inside: Bools, points: Floats, step: float) -> int:
    """The view without which the others agree best."""
    rest = []
    for k in range(len(views)):
        others = [view for j, view in enumerate(views) if j != k]
        rest.append(sum(_uncovered(others, np.delete(inside, k, axis=0), points, step)))
    return int(np.argmin(rest))


def _points(views: Sequence[FusionView]) -> tuple[Floats, float]:
    """Grid points (P, 3) [m] around the object, and their spacing [m]."""
    reach = max(_extent(view) for view in views)
    low, high = np.array([-reach, -0.2 * reach, -reach]), np.array([reach, 2 * reach, reach])
    points, step = _grid(low, high, _COARSE)
    seen = np.mean([_inside(view, points, step) for view in views], axis=0)
    there = points[seen >= max(0.5, 0.8 * seen.max())]
    return _grid(there.min(axis=0) - step, there.max(axis=0) + step, _GRID)


def _grid(low: Floats, high: Floats, count: int) -> tuple[Floats, float]:
    step = float((high - low).max() / count)
    axes = [np.arange(first, last + step, step) for first, last in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), step


def _extent(view: FusionView) -> float:
    """Longer side of a mask at the board's distance [m]."""
    row, column = np.nonzero(view.mask)
    pixels = max(np.ptp(row), np.ptp(column)) if len(row) else 0
    return float(pixels) * _distance(view) / view.view.focal


def _distance(view: FusionView) -> float:
    """Distance of the board's middle along the optical axis [m]."""
    return float(-view.pose.translation[2])


def _project(view: FusionView, points: Floats) -> Floats:
    return projection.project(view.view, points @ view.pose.rotation.T + view.pose.translation)


def _inside(view: FusionView, points: Floats, step: float) -> Bools:
    """Points (P,) whose cells touch the mask; outside the picture there is no object."""
    reach = max(round(0.9 * step * view.view.focal / _distance(view)), 1)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    framed = np.pad(view.mask.astype(np.uint8), reach + 1)
    grown = cv2.dilate(framed, disc)
    x, y = np.rint(_project(view, points) + reach + 1).astype(int).T
    height, width = grown.shape
    within = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    return np.asarray(within & (grown[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)] > 0))


def _uncovered(views: Sequence[FusionView], inside: Bools, points: Floats, step: float) -> list[float]:
    """Share of each view's mask that the hull does not cover, on a grid as coarse as the hull's."""
    hull = points[inside.all(axis=0)]
    shares = []
    for view in views:
        coarse = max(step * view.view.focal / _distance(view), 1.0)
        height, width = (int(np.ceil(side / coarse)) for side in view.mask.shape)
        mask = cv2.resize(view.mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.5
        x, y = np.rint((_project(view, hull) + 0.5) / coarse - 0.5).astype(int).T
        within = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        covered = np.zeros((height, width), np.uint8)
        covered[y[within], x[within]] = 1
        covered = cv2.dilate(covered, np.ones((3, 3), np.uint8))
        shares.append(float((mask & (covered == 0)).sum() / max(mask.sum(), 1)))
    return shares
