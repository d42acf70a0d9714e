"""The board of `polcap board` as SVG and PDF at true scale, with a ruler to check the print.

Both are drawn from one list of black rectangles and lines of text, in millimetres from the top left of the page.

References
----------
ISO 32000-1:2008 (PDF 1.7), §7.5 and §8.5; W3C, Scalable Vector Graphics 1.1.
"""

from dataclasses import dataclass
from html import escape

import numpy as np

from polcap.image_values import Bools
from polcap.optics import board as boards
from polcap.optics.board import Board

RULER_MM = 100
_POINT_MM = 25.4 / 72
_TEXT_MM = 3.2  # height of the letters' body
_FREE_MM = 4.0  # between board, ruler and text
_MARKS_MM = 10.0, 7.0, 4.0  # length of the ruler's marks: every 10 mm, 5 mm and 1 mm

Box = tuple[float, float, float, float]  # left, top, width, height, mm


@dataclass(frozen=True)
class _Page:
    width: float  # mm
    height: float  # mm
    boxes: list[Box]  # black, of the board
    ruler: list[Box]  # black
    texts: list[tuple[float, float, str]]  # left, baseline, mm


def svg(board: Board) -> str:
    """The page as an SVG document; its unit is the millimetre."""
    page = _page(board)
    size = f'width="{page.width:g}mm" height="{page.height:g}mm" viewBox="0 0 {page.width:g} {page.height:g}"'
    board_path, ruler_path = (
        "".join(f"M{x:.4f} {y:.4f}h{w:.4f}v{h:.4f}h{-w:.4f}z" for x, y, w, h in boxes)
        for boxes in (page.boxes, page.ruler)
    )
    lines = "\n".join(
        f'<text x="{x:.4f}" y="{y:.4f}" font-family="Helvetica, Arial, sans-serif" font-size="{_TEXT_MM}">'
        f"{escape(text)}</text>"
        for x, y, text in page.texts
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size}>\n<rect width="100%" height="100%" fill="white"/>\n'
        f'<path shape-rendering="crispEdges" d="{board_path}"/>\n<path d="{ruler_path}"/>\n{lines}\n</svg>\n'
    )


def pdf(board: Board) -> bytes:
    """The page as a PDF document of one page."""
    page = _page(board)

    def points(*lengths: float) -> str:
        return " ".join(f"{length / _POINT_MM:.4f}" for length in lengths)

    drawn = [f"{points(x, page.height - y - h, w, h)} re" for x, y, w, h in page.boxes + page.ruler]
    written = [
        f"BT /F {points(_TEXT_MM)} Tf {points(x, page.height - y)} Td ({_pdf_text(text)}) Tj ET"
        for x, y, text in page.texts
    ]
    content = "\n".join(["0 g", *drawn, "f", *written])
    return _pdf_file(
        [
            "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
            "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {points(page.width, page.height)}] /Contents 4 0 R "
            "/Resources << /Font << /F 5 0 R >> >> >>",
            f"<< /Length {len(content.encode('latin-1'))} >>\nstream\n{content}\nendstream",
            "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        ]
    )


def _pdf_text(text: str) -> str:
    """Escape a text for a string of a PDF."""
    return text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _pdf_file(objects: list[str]) -> bytes:
    """A PDF file of numbered objects, the first of which is the catalog."""
    out, starts = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, start=1):
        starts.append(len(out))
        out += f"{number} 0 obj\n{body}\nendobj\n".encode("latin-1")
    table = "".join(f"{start:010d} 00000 n \n" for start in starts)
    count, table_start = len(objects) + 1, len(out)
    tail = f"trailer\n<< /Size {count} /Root 1 0 R >>\nstartxref\n{table_start}\n%%EOF\n"
    return out + f"xref\n0 {count}\n0000000000 65535 f \n{table}{tail}".encode("latin-1")


def _page(board: Board) -> _Page:
    """The page in mm: black boxes, lines of text, and the ruler."""
    width, height = (1000 * side for side in board.page_m)
    side = 1000 * board.side_m
    margin = (width - side) / 2
    cell = side / (boards.SQUARES * boards.CELLS)
    boxes = [
        (margin + cell * column, margin + cell * row, cell * wide, cell * tall)
        for row, column, tall, wide in _rectangles(boards.ink(board))
    ]
    top = margin + side + _FREE_MM
    texts = [
        f"polcap board {board.name}: print at 100 %, without fitting to the page, on matt paper.",
        f"Check: the ruler is {RULER_MM} mm long, the board {side:g} mm wide.",
        "Glue it onto a flat plate, cut along its outer edge, and stand the object in the black middle.",
    ]
    first = top + _MARKS_MM[0] + _FREE_MM + _TEXT_MM
    lines = [(margin, first + 1.5 * _TEXT_MM * k, text) for k, text in enumerate(texts)]
    return _Page(width, height, boxes, _ruler(margin, top), lines)


def _ruler(left: float, top: float) -> list[Box]:
    """Marks at every millimetre; the outer edges of the first and the last are `RULER_MM` from each other."""
    thick = 0.2  # mm
    long, middle, short = _MARKS_MM
    marks = [
        (left + k * (RULER_MM - thick) / RULER_MM, top, thick, long if k % 10 == 0 else middle if k % 5 == 0 else short)
        for k in range(RULER_MM + 1)
    ]
    return [(left, top, float(RULER_MM), thick), *marks]


def _rectangles(black: Bools) -> list[tuple[int, int, int, int]]:
    """Rectangles (row, column, rows, columns) that cover the black cells once; equal runs of rows are joined."""
    begun: dict[tuple[int, int], int] = {}  # first and end column of a run, and the row where it begins
    finished = []
    for row, cells in enumerate([*black, np.zeros(black.shape[1], bool)]):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], cells, [0]])))
        runs = {(int(first), int(last)) for first, last in edges.reshape(-1, 2)}
        for run in [run for run in begun if run not in runs]:
            start = begun.pop(run)
            finished.append((start, run[0], row - start, run[1] - run[0]))
        for run in runs - begun.keys():
            begun[run] = row
    return sorted(finished)
