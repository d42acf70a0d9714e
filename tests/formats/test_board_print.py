"""The printed board has its true size, and OpenCV finds its corners."""

import re

import cv2
import numpy as np
import pytest

from polcap.formats import board_print
from polcap.optics import board as boards
from polcap.optics.board import BOARDS, Board

CELL_PX = 8
SIZES = pytest.mark.parametrize("board", BOARDS.values(), ids=list(BOARDS))


def svg_boxes(document: str) -> np.ndarray:
    """Black boxes (N, 4) left, top, width, height, mm."""
    found = re.findall(r"M([\d.]+) ([\d.]+)h([\d.]+)v([\d.]+)h", document)
    return np.array(found, float)


def pdf_boxes(document: bytes) -> np.ndarray:
    height = float(re.findall(rb"MediaBox \[0 0 [\d.]+ ([\d.]+)\]", document)[0])
    x, y, w, h = np.array(re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", document), float).T
    return np.stack([x, height - y - h, w, h], axis=1) * 25.4 / 72


def painted(boxes: np.ndarray, board: Board) -> np.ndarray:
    """The board with a white margin of five cells, each cell `CELL_PX` wide."""
    margin = 500 * (board.page_m[0] - board.side_m)  # mm
    cell = 1000 * board.square_m / boards.CELLS
    page = np.full([(boards.SQUARES * boards.CELLS + 10) * CELL_PX] * 2, 255, np.uint8)
    for x, y, w, h in (boxes - [margin, margin, 0, 0]) / cell * CELL_PX + [5 * CELL_PX, 5 * CELL_PX, 0, 0]:
        page[round(y) : round(y + h), round(x) : round(x + w)] = 0
    return page[: 69 * CELL_PX]  # without the ruler


@SIZES
@pytest.mark.parametrize("kind", ["svg", "pdf"])
def test_distances_of_corners_on_the_page_are_those_of_the_board(board: Board, kind: str) -> None:
    boxes = svg_boxes(board_print.svg(board)) if kind == "svg" else pdf_boxes(board_print.pdf(board))
    found, ids, _, _ = cv2.aruco.CharucoDetector(boards.charuco(board)).detectBoard(painted(boxes, board))
    numbers, place = boards.corners(board)
    where = dict(zip(ids.ravel().tolist(), found.reshape(-1, 2), strict=True))
    seen = np.array([where[number] for number in numbers.tolist()])  # px
    cell = board.square_m / boards.CELLS
    wanted = (place[:, [0, 2]] + board.side_m / 2) / cell * CELL_PX
    assert seen + 0.5 - 5 * CELL_PX == pytest.approx(wanted, abs=0.3)


def test_the_ruler_is_as_long_as_stated() -> None:
    boxes = svg_boxes(board_print.svg(BOARDS["A4"]))
    marks = boxes[np.isclose(boxes[:, 2], 0.2)]
    assert len(marks) == board_print.RULER_MM + 1
    assert (marks[:, 0] + marks[:, 2]).max() - marks[:, 0].min() == pytest.approx(board_print.RULER_MM, abs=1e-3)


def test_the_pdf_is_well_formed() -> None:
    document = board_print.pdf(BOARDS["A3"])
    where = int(re.findall(rb"startxref\n(\d+)", document)[0])
    assert document[where : where + 4] == b"xref"
    for number, start in enumerate(re.findall(rb"(\d{10}) 00000 n", document), start=1):
        assert document[int(start) :].startswith(b"%d 0 obj" % number)
    length = int(re.findall(rb"/Length (\d+)", document)[0])
    stream = document.partition(b"stream\n")[2][:length]
    assert document.partition(b"stream\n")[2][length:].startswith(b"\nendstream")
    assert stream.startswith(b"0 g")


@SIZES
def test_everything_is_on_the_page(board: Board) -> None:
    boxes = svg_boxes(board_print.svg(board))
    assert (boxes[:, 0] + boxes[:, 2]).max() < 1000 * board.page_m[0] - 4
    assert (boxes[:, 1] + boxes[:, 3]).max() < 1000 * board.page_m[1] - 4
