"""Corners of the board in the merged picture of a view, to a fraction of a pixel.

OpenCV finds the markers. They give a homography from the board to the picture. Around each corner the print is drawn
through this homography and registered to the picture in linear light. Where both do not agree, the corner is hidden.
"""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from polcap.chart_values import ColorCalibration
from polcap.errors import CaptureError
from polcap.image_values import Floats
from polcap.optics import board as boards
from polcap.optics.board import BOARDS, Board
from polcap.optics.projection import from_grid, transform_points
from polcap.stage_values import AngleStack
from polcap.stages import stage

_DETECTOR_PX = 2400  # longer side of the picture in which markers are searched
_LEAST_MARKERS = 3  # of a board; fewer may be false
_RANSAC = 0.02  # threshold of the homography's fit, over the extent of the markers
_LEAST_CORNERS = 6  # twelve coordinates for six unknowns of a pose; the surplus shows errors
_WINDOW = 0.45  # half side of the print that is compared around a corner, squares
_SAMPLES = 4  # of the print, per pixel side
_BLUR_PX = 0.5  # 1σ of the lens and the photosites together
_ROUNDS = 6  # of the registration
_MOST_SHIFT, _MOST_SHIFT_PX = 0.15, 1.5  # squares or px, whichever is more; the homography neglects distortion
_LEAST_CORRELATION = 0.85  # of picture and print around a corner
_MOST_TWINS = 2  # markers seen twice: more are a second board


@dataclass(frozen=True)
class BoardCorners:
    """Corners of one board in one view."""

    board: Board
    number: NDArray[np.int64]  # (N,) OpenCV's
    world: Floats  # (N, 3) m
    measured_px: Floats  # (N, 2) x, y in visible RAW px of the reference shot


@dataclass(frozen=True)
class BoardSearch:
    """Result of the search for a board in one view."""

    corners: BoardCorners | None  # None: there is no board
    markers: int  # that were found of one board

    @property
    def missing(self) -> str:
        """The reason why there is no board, with its remedy."""
        return (
            f"no board is visible ({self.markers} of its markers, {_LEAST_MARKERS} are needed); "
            "shoot with the object on the board of `polcap board`, sharp and lit"
        )


def gray_picture(radiance: AngleStack, color: ColorCalibration) -> tuple[Floats, float]:
    """Linear gray picture (H, W), and the width of its pixels in RAW pixels.

    Its values are the white-balanced photosites of the reference shot if known, else means of all shots and colors.
    """
    white = np.linalg.inv(np.asarray(color.matrix, np.float64)) @ np.ones(3)  # in camera channels
    if radiance.mosaic is None:
        mean = np.mean(radiance.value, axis=0) / white.astype(np.float32)
        return np.asarray(mean.mean(axis=-1), np.float32), radiance.view.scale
    sites = np.asarray(radiance.mosaic.value, np.float32)
    gain = (1 / white).astype(np.float32)[radiance.mosaic.cfa]  # (2, 2)
    return sites * np.tile(gain, (sites.shape[0] // 2, sites.shape[1] // 2)), radiance.view.scale / 2


@stage(version=1)
def detect(radiance: AngleStack, color: ColorCalibration) -> BoardSearch:
    """Search the board in a view.

    Raises CaptureError: too little of the board is visible, or two boards are.
    """
    picture, scale = gray_picture(radiance, color)
    markers = _find_markers(picture)
    board, count = _choose_board(markers)
    if board is None:
        return BoardSearch(None, count)
    known = np.asarray(boards.charuco(board).getIds()).ravel().tolist()
    plan = np.asarray(boards.charuco(board).getObjPoints())[..., :2]  # (M, 4, 2) m, from the top left
    pairs = [(plan[known.index(number)], quad) for number, quad in markers if number in known]
    flat, measured = (np.concatenate(side).astype(np.float64) for side in zip(*pairs, strict=True))
    homography, _ = cv2.findHomography(flat, measured, cv2.RANSAC, _RANSAC * float(np.ptp(measured, axis=0).max()))
    if homography is None:
        raise CaptureError("the board's markers contradict each other; show a flat board")
    number, world = boards.corners(board)
    pixel = _locate(picture, homography, board)
    good = np.isfinite(pixel).all(axis=1)
    if good.sum() < _LEAST_CORNERS:
        raise CaptureError(
            f"{good.sum()} of {len(number)} corners of the board are visible, {_LEAST_CORNERS} are needed; "
            "let object and chart hide less of the board, and show it sharp"
        )
    return BoardSearch(BoardCorners(board, number[good], world[good], from_grid(pixel[good], scale)), count)


def _find_markers(picture: Floats) -> list[tuple[int, Floats]]:
    """Numbers of all markers in a linear picture, with their corners (4, 2) px; OpenCV searches a gray 8-bit copy."""
    white = max(float(np.quantile(picture, 0.98)), 1e-6)  # highlights are brighter
    encoded = np.asarray(255 * np.clip(picture / white, 0, 1) ** (1 / 2.2), np.uint8)  # with a display's gamma
    zoom = _DETECTOR_PX / max(encoded.shape)
    method = cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC
    resized = cv2.resize(encoded, None, fx=zoom, fy=zoom, interpolation=method)
    quads, numbers, _ = cv2.aruco.ArucoDetector(boards.dictionary()).detectMarkers(resized)
    if numbers is None:
        return []
    corners = (np.asarray(quads, np.float64).reshape(-1, 4, 2) + 0.5) / zoom - 0.5  # pixel centers are whole numbers
    return list(zip(np.ravel(numbers).tolist(), corners, strict=True))


def _choose_board(markers: list[tuple[int, Floats]]) -> tuple[Board | None, int]:
    """The board of the markers, or None, and the number of its markers. Raises CaptureError: several boards."""
    numbers = [number for number, _ in markers]
    twins = len(numbers) - len(set(numbers))
    seen = {
        board.name: len(set(numbers) & set(np.ravel(boards.charuco(board).getIds()).tolist()))
        for board in BOARDS.values()
    }
    sizes = [size for size, count in seen.items() if count >= _LEAST_MARKERS]
    if len(sizes) > 1 or twins > _MOST_TWINS:
        which = " and ".join(sizes) if len(sizes) > 1 else f"{twins} markers twice"
        raise CaptureError(f"two boards are visible ({which}); leave one in the picture")
    return (BOARDS[sizes[0]] if sizes else None), max(seen.values())


def _locate(picture: Floats, homography: Floats, board: Board) -> Floats:
    """Corners (N, 2) px of the board; NaN where the print around a corner is not visible.

    Around each corner the print is drawn through the homography, and shifted until it fits (Gauss-Newton).
    """
    _, world = boards.corners(board)
    out = np.full((len(world), 2), np.nan)
    for k, corner in enumerate(world[:, [0, 2]]):
        flat = corner + board.side_m / 2
        x, y, drawn = _draw(homography, flat, board)
        if min(x.min(), y.min()) < 0 or x.max() > picture.shape[1] - 1 or y.max() > picture.shape[0] - 1:
            continue
        shift, correlation = _register(picture, x, y, drawn)
        limit = np.maximum(_MOST_SHIFT * (np.array([np.ptp(x), np.ptp(y)]) / (2 * _WINDOW)), _MOST_SHIFT_PX)
        if correlation > _LEAST_CORRELATION and (np.abs(shift) < limit).all():
            out[k] = transform_points(homography, flat) + shift
    return out


def _draw(homography: Floats, flat: Floats, board: Board) -> tuple[Floats, Floats, Floats]:
    """Pixels x, y (h, w) around a point (2,) [m] from the print's top left, and the share of paper (h, w) there."""
    corners = _WINDOW * board.square_m * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    around = transform_points(homography, flat + corners)
    low, high = np.floor(around.min(axis=0)), np.ceil(around.max(axis=0))
    x, y = np.meshgrid(*(np.arange(first, last + 1) for first, last in zip(low, high, strict=True)))
    back = np.linalg.inv(homography)
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    drawn: Floats = np.zeros(x.shape)
    for dx, dy in itertools.product(steps, steps):
        point = transform_points(back, np.stack([x + dx, y + dy], axis=-1)) - board.side_m / 2
        drawn += ~boards.is_ink(board, point[..., 0], point[..., 1]) / _SAMPLES**2
    return x, y, gaussian_filter(drawn, _BLUR_PX)


def _register(picture: Floats, x: Floats, y: Floats, drawn: Floats) -> tuple[Floats, float]:
    """Shift (2,) px of the picture against the print `drawn` (h, w) at pixels x, y, and their correlation.

    Each round fits the shifted picture by a · drawn + b · gradient + c; then the shift is off by b / a.
    """
    down, across = np.gradient(drawn)
    terms = np.stack([drawn, across, down, np.ones_like(drawn)], axis=-1).reshape(-1, 4)
    shift: Floats = np.zeros(2)
    for _ in range(_ROUNDS):
        pixel = (x + shift[0]).astype(np.float32), (y + shift[1]).astype(np.float32)
        seen = cv2.remap(picture, *pixel, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel()
        weight = np.linalg.lstsq(terms, seen, rcond=None)[0]
        if weight[0] <= 1e-6 * np.abs(seen).max():  # no print is here
            return shift, 0.0
        shift = shift + np.clip(-weight[1:3] / weight[0], -2, 2)  # px a round, at most
    return shift, float(np.corrcoef(seen, terms[:, 0])[0, 1])
