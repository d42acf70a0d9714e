"""Corners of the board in the merged picture of a view, to a fraction of a pixel.

OpenCV finds the markers. They give a homography from the board to the picture, which places every corner; corners
whose squares look as printed are then located in linear light.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.errors import CaptureError
from polcap.images import AngleStack, ColorCalibration, Floats
from polcap.optics import board as boards
from polcap.optics.board import BOARDS, Board
from polcap.optics.projection import transform_points

_DETECTOR_PX = 2400  # longer side of the picture in which markers are searched
_LEAST_MARKERS = 3  # of a board; fewer may be false
_LEAST_CORNERS = 6  # a pose has six unknowns, and each corner two coordinates; the rest shows errors
_WINDOW = 0.8 / boards.CELLS  # half side of a corner's search window, in squares: it ends within the markers' margin
_MOST_WINDOW_PX = 12
_MOST_MOVED = 0.12  # squares; from the homography's prediction, which neglects distortion
_LEAST_CONTRAST = 2.5  # of paper over ink beside a corner
_MOST_TWINS = 2  # markers seen twice: more are a second board


@dataclass(frozen=True)
class BoardCorners:
    """Corners of one board in one view."""

    board: Board
    number: NDArray[np.int64]  # (N,) OpenCV's
    world: Floats  # (N, 3) m
    seen: Floats  # (N, 2) x, y in visible RAW px of the reference shot


def gray_picture(radiance: AngleStack, color: ColorCalibration) -> tuple[Floats, float]:
    """Picture (H, W) in which the board is gray, linear, and its RAW pixels per pixel.

    These are the white-balanced photosites of the reference shot where it has them, else the mean of all shots.
    """
    white = np.linalg.inv(np.asarray(color.matrix, np.float64)) @ np.ones(3)  # in camera channels
    if radiance.mosaic is None:
        mean = np.mean(radiance.value, axis=0) / white.astype(np.float32)
        return np.asarray(mean.mean(axis=-1), np.float32), radiance.view.scale
    sites = np.asarray(radiance.mosaic.value, np.float32)
    gain = (1 / white).astype(np.float32)[radiance.mosaic.cfa]  # (2, 2)
    return sites * np.tile(gain, (sites.shape[0] // 2, sites.shape[1] // 2)), radiance.view.scale / 2


def detect(radiance: AngleStack, color: ColorCalibration, name: str) -> BoardCorners:
    """Detect the board in a view called `name`.

    Raises
    ------
    CaptureError
        No board is visible, too little of it, or two boards are.
    """
    picture, scale = gray_picture(radiance, color)
    markers = _markers(picture)
    board = _one_board(markers, name)
    known = np.asarray(boards.charuco(board).getIds()).ravel().tolist()
    plan = np.asarray(boards.charuco(board).getObjPoints())[..., :2]  # (M, 4, 2) m, from the top left
    pairs = [(plan[known.index(number)], quad) for number, quad in markers if number in known]
    flat, seen = (np.concatenate(side).astype(np.float64) for side in zip(*pairs, strict=True))
    place, _ = cv2.findHomography(flat, seen, cv2.RANSAC, 0.02 * float(np.ptp(seen, axis=0).max()))
    if place is None:
        raise CaptureError(f"{name}: the board's markers contradict each other; show a flat board")
    number, world = boards.corners(board)
    corner = world[:, [0, 2]] + board.side_m / 2
    moved = _located(picture, place, corner, board.square_m)
    good = np.isfinite(moved).all(axis=1)
    if good.sum() < _LEAST_CORNERS:
        raise CaptureError(
            f"{name}: {good.sum()} of {len(number)} corners of the board are visible, {_LEAST_CORNERS} are needed; "
            "let object and chart hide less of the board, and show it sharp"
        )
    return BoardCorners(board, number[good], world[good], scale * moved[good] + (scale - 1) / 2)


def _markers(picture: Floats) -> list[tuple[int, Floats]]:
    """Numbers of all markers in a linear picture, with their corners (4, 2) px."""
    bright = max(float(np.quantile(picture, 0.98)), 1e-6)
    gray = np.asarray(255 * np.clip(picture / bright, 0, 1) ** (1 / 2.2), np.uint8)
    zoom = _DETECTOR_PX / max(gray.shape)
    how = cv2.INTER_AREA if zoom < 1 else cv2.INTER_CUBIC
    sized = cv2.resize(gray, None, fx=zoom, fy=zoom, interpolation=how)
    detector = cv2.aruco.ArucoDetector(boards.dictionary())
    quads, numbers, _ = detector.detectMarkers(sized)
    if numbers is None:
        return []
    found = np.asarray(quads, np.float64).reshape(-1, 4, 2)
    return list(zip(np.ravel(numbers).tolist(), (found + 0.5) / zoom - 0.5, strict=True))


def _one_board(markers: list[tuple[int, Floats]], name: str) -> Board:
    """The board that the markers belong to. Raises CaptureError for none or several."""
    numbers = [number for number, _ in markers]
    twins = len(numbers) - len(set(numbers))
    seen = {
        board.name: len(set(numbers) & set(np.ravel(boards.charuco(board).getIds()).tolist()))
        for board in BOARDS.values()
    }
    there = [size for size, count in seen.items() if count >= _LEAST_MARKERS]
    if not there:
        raise CaptureError(
            f"{name}: no board is visible ({max(seen.values())} of its markers, {_LEAST_MARKERS} are needed); "
            "shoot with the object on the board of `polcap board`, sharp and lit"
        )
    if len(there) > 1 or twins > _MOST_TWINS:
        which = " and ".join(there) if len(there) > 1 else f"{twins} markers twice"
        raise CaptureError(f"{name}: two boards are visible ({which}); leave one in the picture")
    return BOARDS[there[0]]


def _located(picture: Floats, place: Floats, corner: Floats, square: float) -> Floats:
    """Corners (N, 2) px for flat positions `corner` (N, 2) m; NaN where the print around a corner is not visible."""
    out = np.full(corner.shape, np.nan)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    steps = square * np.array([[1.0, 0], [0, 1], [1, 1], [1, -1]])
    height, width = picture.shape
    for k, at in enumerate(corner):
        start = transform_points(place, at)
        reach = np.abs(transform_points(place, at + _WINDOW * steps) - start)
        least = np.abs(reach[:2]).max(axis=1).min()  # of the shorter side of a square
        half = int(np.clip(least, 2, _MOST_WINDOW_PX))
        if not (2 * half < start[0] < width - 2 * half and 2 * half < start[1] < height - 2 * half):
            continue
        guess = start.astype(np.float32).reshape(1, 1, 2)
        moved = cv2.cornerSubPix(picture, guess, (half, half), (-1, -1), stop).reshape(2).astype(np.float64)
        if np.linalg.norm(moved - start) > max(_MOST_MOVED / _WINDOW * least, 1.5):
            continue
        if _looks_printed(picture, transform_points(place, at + 0.5 * _WINDOW * _DIAGONALS * square) + moved - start):
            out[k] = moved
    return out


_DIAGONALS = np.array([[1.0, 1], [-1, -1], [1, -1], [-1, 1]])  # two squares of one color, then two of the other


def _looks_printed(picture: Floats, beside: Floats) -> bool:
    """Whether points (4, 2) px in the squares around a corner are two of paper and two of ink."""
    point = beside.astype(np.float32)
    value = cv2.remap(picture, point[:, 0], point[:, 1], cv2.INTER_LINEAR).ravel()
    first, second = sorted((value[:2], value[2:]), key=lambda pair: float(pair.mean()))
    return bool(second.min() > _LEAST_CONTRAST * max(first.max(), 1e-6) and second.max() < 2 * second.min())
