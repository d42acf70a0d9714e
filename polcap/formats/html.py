"""In: a report and its pictures. Out: one HTML file that needs nothing else, not even a network."""

from base64 import b64encode
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.formats import atomic

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1280px; margin: 2em auto; padding: 0 1em; color: #222 }
h1 { font-size: 1.5em } h2 { font-size: 1.1em; margin-top: 2em } img { max-width: 100%; background: #000 }
table { border-collapse: collapse } td, th { text-align: left; padding: .15em 1em .15em 0; vertical-align: top }
td.pass { color: #176617 } td.fail { color: #b00000; font-weight: bold } td.warn { color: #9a5b00 }
code { color: #555 } td { overflow-wrap: anywhere }
"""
_VERDICT = {
    "pass": "every gate passed",
    "warn": "every gate passed, with an assumption to check",
    "fail": "a gate failed: look before you use this asset",
}


def write(path: str | Path, report: Mapping[str, Any], pictures: Mapping[str, NDArray[np.uint8]]) -> None:
    """Write a report page; pictures (H, W, 3) sRGB are embedded under their names.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    with atomic.path(path) as temporary:
        temporary.write_text("\n".join(_page(report, pictures)), encoding="utf-8")


def _page(report: Mapping[str, Any], pictures: Mapping[str, NDArray[np.uint8]]) -> Iterator[str]:
    name = escape(str(report["capture"]["name"]))
    yield f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{name}: polcap report</title>'
    yield f"<style>{_STYLE}</style><h1>{name}: {_VERDICT[report['verdict']]}</h1>"
    yield "<table><tr><th>gate</th><th></th><th>value</th><th>limit</th><th></th></tr>"
    for gate in report["gates"]:
        state = escape(gate["state"])
        yield (
            f'<tr><td>{escape(gate["name"])}</td><td class="{state}">{state}</td><td>{_text(gate["value"])}</td>'
            f"<td>{_text(gate['limit'])}</td><td>{escape(gate['says'])}</td></tr>"
        )
    yield "</table>"
    for title, picture in pictures.items():
        yield f'<h2>{escape(title)}</h2><img alt="{escape(title)}" src="{_embedded(picture)}">'
    for title, values in {"capture": report["capture"], **report["figures"]}.items():
        yield f"<h2>{escape(title)}</h2><table>"
        for key, value in values.items():
            yield f"<tr><td>{escape(key.replace('_', ' '))}</td><td><code>{_text(value)}</code></td></tr>"
        yield "</table>"
    yield f"<p>polcap {escape(str(report['polcap']))}; every figure and setting: report.json</p></html>"


def _text(value: Any) -> str:
    if value is None:
        return "–"
    return escape(f"{value:.4g}" if isinstance(value, float) else str(value))


def _embedded(picture: NDArray[np.uint8]) -> str:
    _, encoded = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    return f"data:image/jpeg;base64,{b64encode(encoded.tobytes()).decode()}"
