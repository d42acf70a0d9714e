"""Geometry of the board under an object that is shot from all sides: a ring of ChArUco squares around a black middle.

The board is square. Its world frame has the origin in the middle, x to the right and z down the printed page, and y
up out of the page, metres. Each size has its own markers, so that a picture shows which one it is.

References
----------
Garrido-Jurado et al., Automatic generation and detection of highly reliable fiducial markers under occlusion, Pattern
Recognition 2014; OpenCV's aruco module.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats

SQUARES, RING = 8, 2  # squares along a side; width of the ring
CELLS = 8  # along a square: a marker of 4 × 4 bits, its frame of one bit, and a margin of one bit
_MARKERS = SQUARES**2 // 2  # of a board without a hole


@dataclass(frozen=True)
class Board:
    """Size and markers of one board."""

    name: str
    square_m: float  # side of a square
    first_marker: int  # the board's markers have this number and the following ones
    page_m: tuple[float, float]  # width, height of the paper

    @property
    def side_m(self) -> float:
        """Side of the printed square."""
        return SQUARES * self.square_m


BOARDS = {
    board.name: board
    for board in (
        Board("A4", 0.024, 0, (0.210, 0.297)),
        Board("A3", 0.034, _MARKERS, (0.297, 0.420)),
        Board("A2", 0.048, 2 * _MARKERS, (0.420, 0.594)),
    )
}


def dictionary() -> cv2.aruco.Dictionary:
    """The markers of all boards."""
    return cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)


def charuco(board: Board) -> cv2.aruco.CharucoBoard:
    """OpenCV's description of the board, as if it had no black middle."""
    ids = np.arange(board.first_marker, board.first_marker + _MARKERS)
    marker_m = board.square_m * (CELLS - 2) / CELLS
    return cv2.aruco.CharucoBoard((SQUARES, SQUARES), board.square_m, marker_m, dictionary(), ids)


@lru_cache
def ink(board: Board) -> Bools:
    """Cells of the board that are printed black, (64, 64), row by row from the top left of the page."""
    picture = charuco(board).generateImage((SQUARES * CELLS, SQUARES * CELLS), marginSize=0)
    black = np.asarray(picture) < 128
    hole = slice(RING * CELLS, (SQUARES - RING) * CELLS)
    black[hole, hole] = True
    return black


def corners(board: Board) -> tuple[NDArray[np.int64], Floats]:
    """Inner corners whose four squares are printed: OpenCV's numbers (24,), and world coordinates (24, 3) [m]."""
    at = np.arange(1, SQUARES)
    row, column = (grid.ravel() for grid in np.meshgrid(at, at, indexing="ij"))
    outer = np.maximum(np.abs(row - SQUARES / 2), np.abs(column - SQUARES / 2)) > SQUARES / 2 - RING
    place = (np.stack([column, 0 * row, row], axis=-1) - [SQUARES / 2, 0, SQUARES / 2]) * board.square_m
    return np.flatnonzero(outer), place[outer]


def is_ink(board: Board, x: Floats, z: Floats) -> Bools:
    """True where points x, z (N,) [m, world frame] of the board's plane are printed black."""
    cell = board.square_m / CELLS
    column, row = (np.floor(a / cell + SQUARES * CELLS / 2).astype(int) for a in (x, z))
    inside = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < SQUARES * CELLS)
    last = SQUARES * CELLS - 1
    return np.asarray(inside & ink(board)[np.clip(row, 0, last), np.clip(column, 0, last)])
