"""Writes a page as one HTML file that needs no other file and no network.

page.css      style of every page
law.glsl      the shading of `optics/shade.py` for the graphics card
probe.js      shows the values under the pointer
relight.js    lights the maps from the pointer's direction
"""

import gzip
import json
from base64 import b64encode
from collections.abc import Iterable, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.formats import atomic
from polcap.formats.maps import png

_JPEG_QUALITY = 88, 94  # with color at half and at full resolution
_SCRIPTS = ("probe.js", "relight.js")


def write(path: str | Path, title: str, body: Iterable[str], data: Mapping[str, Any]) -> None:
    """Write a page of HTML fragments with escaped texts; its scripts read `data` as JSON."""
    here = files(__name__)
    style = here.joinpath("page.css").read_text("utf-8")
    scripts = "\n".join(here.joinpath(name).read_text("utf-8") for name in _SCRIPTS)
    page_data = {**data, "law": here.joinpath("law.glsl").read_text("utf-8")}
    atomic.write(
        path,
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{escape(title)}</title><link rel=icon href=data:,>\n<style>\n{style}</style>\n<main>\n"
        + "\n".join(body)
        + f'\n</main>\n<script type="application/json" id="data">{_json(page_data)}</script>'
        f"\n<script>\n{scripts}</script>\n</html>\n",
    )


def jpeg(picture: NDArray[np.uint8], whole_color: bool = False) -> str:
    """Encode a picture (H, W, 3) sRGB as a data URL of a JPEG; `whole_color` stores chroma at full resolution."""
    ratio = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444 if whole_color else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY[whole_color], cv2.IMWRITE_JPEG_SAMPLING_FACTOR, ratio]
    _, encoded = cv2.imencode(".jpg", picture[..., ::-1], options)
    return _address("image/jpeg", encoded.tobytes())


def lossless(picture: NDArray[np.uint8]) -> str:
    """Encode a picture (H, W, 3) or (H, W, 4) as a data URL of a PNG."""
    return _address("image/png", png.encode(picture))


def indexed(level: NDArray[np.uint8], colors: NDArray[np.uint8]) -> str:
    """Encode levels (H, W) with a palette (255, 3) as a data URL of a PNG; level 0 is transparent."""
    return _address("image/png", png.indexed(level, colors))


def packed(array: NDArray[Any]) -> str:
    """Encode an array of any shape as base64 text of its gzipped little-endian bytes, for a page's scripts."""
    solid = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
    return text(gzip.compress(solid.tobytes(), 6, mtime=0))


def text(content: bytes) -> str:
    """Encode bytes as base64 text."""
    return b64encode(content).decode()


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{text(content)}"


def _json(data: Mapping[str, Any]) -> str:
    """Encode data as JSON for an HTML script element, which must not contain <."""
    return json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
