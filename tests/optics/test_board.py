"""The board to print is the one that OpenCV detects, and its world frame is right-handed."""

import cv2
import numpy as np
import pytest

from polcap.optics import board as boards
from polcap.optics.board import BOARDS, Board

SIZES = pytest.mark.parametrize("board", BOARDS.values(), ids=list(BOARDS))


def drawn(board: Board, px_per_cell: int = 10) -> np.ndarray:
    """The board by `is_ink`, seen from above, with a white margin of two cells."""
    cell = board.square_m / boards.CELLS
    at = (np.arange(-2 * px_per_cell, (boards.SQUARES * boards.CELLS + 2) * px_per_cell) + 0.5) / px_per_cell * cell
    x, z = np.meshgrid(at - board.side_m / 2, at - board.side_m / 2)
    return np.where(boards.is_ink(board, x, z), 0, 255).astype(np.uint8)


@SIZES
def test_opencv_finds_all_corners_of_the_ring_where_they_are_said_to_be(board: Board) -> None:
    found, ids, _, _ = cv2.aruco.CharucoDetector(boards.charuco(board)).detectBoard(drawn(board))
    numbers, place = boards.corners(board)
    where = dict(zip(ids.ravel().tolist(), found.reshape(-1, 2), strict=True))
    assert len(numbers) == 24
    assert set(numbers.tolist()) <= set(where)
    cell = board.square_m / boards.CELLS
    for number, (x, y, z) in zip(numbers.tolist(), place.tolist(), strict=True):
        seen = (where[number] + 0.5) / 10 * cell - 2 * cell - board.side_m / 2
        assert y == 0
        assert seen == pytest.approx([x, z], abs=0.05 * cell)  # half a pixel


def test_boards_of_other_sizes_have_other_markers() -> None:
    ids = [np.asarray(boards.charuco(board).getIds()).ravel() for board in BOARDS.values()]
    assert len(np.unique(np.concatenate(ids))) == sum(map(len, ids))


@SIZES
def test_the_print_fits_on_its_page(board: Board) -> None:
    assert board.side_m < board.page_m[0] - 0.008  # printers leave a margin of 4 mm
