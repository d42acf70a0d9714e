"""Draws sheets: several pictures with captions and color keys in one picture."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.optics.resize import area_mean
from polcap.report.keys import ColorKey

Picture = NDArray[np.uint8]
WIDTH = 640  # px of one tile
_HEAD, _FOOT, _GAP = 44, 58, 12  # px: heights above and below a picture, space between tiles
_TEXT, _SOFT_TEXT, _GROUND = (235, 237, 240), (160, 166, 176), (24, 26, 29)
_LETTERS = cv2.FontFace("sans")


@dataclass(frozen=True)
class Tile:
    """A picture (h, w, 3) with its caption and its color key or a note."""

    picture: Picture
    caption: str
    key: ColorKey | None = None
    note: str = ""  # shown where there is no key


def sheet(tiles: list[Tile]) -> Picture:
    """Arrange tiles in one picture, three in a row, each with its caption above and its color key below."""
    framed = [_frame(tile) for tile in tiles]
    rows = []
    for start in range(0, len(framed), 3):
        row = framed[start : start + 3]
        height = max(tile.shape[0] for tile in row)
        strip = np.full((height, min(3, len(framed)) * (WIDTH + _GAP) - _GAP, 3), _GROUND, np.uint8)
        for place, tile in enumerate(row):
            left = place * (WIDTH + _GAP)
            strip[: tile.shape[0], left : left + WIDTH] = tile
        rows.append(strip)
    return np.vstack(rows)


def write(picture: Picture, words: str, at: tuple[int, int], paint: tuple[int, int, int], size: int = 20) -> None:
    """Write text of `size` px on a picture; `at` (x, y) is the left end of the baseline, `paint` the color."""
    cv2.putText(picture, words, at, paint, _LETTERS, size, 400)


def _frame(tile: Tile) -> Picture:
    """Draw a tile: picture, caption, and the color bar with ticks or the note."""
    height = max(1, round(tile.picture.shape[0] * WIDTH / tile.picture.shape[1]))
    framed = np.full((_HEAD + height + _FOOT, WIDTH, 3), _GROUND, np.uint8)
    write(framed, tile.caption, (2, 30), _TEXT, 22)
    if tile.picture.shape[1] > WIDTH:
        framed[_HEAD:-_FOOT] = area_mean(tile.picture, (height, WIDTH))
    else:
        framed[_HEAD:-_FOOT] = cv2.resize(tile.picture, (WIDTH, height), interpolation=cv2.INTER_NEAREST)
    foot = framed[-_FOOT:]
    if tile.key is None:
        write(foot, tile.note, (2, 24), _SOFT_TEXT, 17)
        return framed
    foot[8:20] = tile.key.bar(WIDTH, 12)
    for tick in tile.key.ticks:
        words = f"{tick:.3g}{tile.key.unit}"
        wide = cv2.getTextSize((WIDTH, 60), words, (0, 0), _LETTERS, 17, 400)[2]
        place = round(tile.key.place(tick) * (WIDTH - 1))
        foot[20:24, min(place, WIDTH - 2)] = _SOFT_TEXT
        write(foot, words, (int(np.clip(place - wide // 2, 0, WIDTH - wide)), 42), _SOFT_TEXT, 17)
    return framed
