"""In: maps of a result, reduced for a screen. Out: the report's figures of them, with keys, which the pointer reads."""

import json
from collections.abc import Iterator, Mapping
from html import escape
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.formats import html
from polcap.images import Floats
from polcap.optics.color import srgb_eight_bits
from polcap.report import keys, labels, plots
from polcap.report.keys import Key
from polcap.report.shown import Rerendered, Shown

_RIM = 4  # px that normals go on past the outline, for a texture's filter


def maps(small: Shown, metric: bool) -> Iterator[str]:
    """The section with the maps of a result, each readable under the pointer."""
    found, inside = small.maps, small.maps.mask
    depth = small.depth * (1000.0 if metric else 1.0)
    yield (
        '<h2>Maps</h2><p class="hint">The pointer over one map reads all of them at that pixel.</p>'
        '<div class="grid" id="maps">'
    )
    yield normal("normal", "Normal", found.normal, inside)
    yield _color("diffuse", "Diffuse albedo", "ρ_d, linear: red, green, blue", found.diffuse, inside, 1.0)
    yield _color("specular", "Specular albedo F0", "linear: red, green, blue", found.specular, inside, keys.F0.high)
    scalars: list[tuple[str, str, str, Floats, Key]] = [
        ("roughness", "Roughness", "perceptual: 0 a mirror, 1 matt", found.roughness, keys.ROUGHNESS),
        (
            "depth",
            "Depth",
            "distance along the optical axis",
            depth,
            keys.depth(depth[inside & np.isfinite(depth)], metric),
        ),
        ("error", "Expected error of the normal", "what to trust: 3° is very good", found.confidence, keys.ERROR),
        ("dolp", "Degree of linear polarization", "share of the light", small.dolp, keys.DOLP),
        ("aolp", "Angle of linear polarization", "from image right, counter-clockwise", small.aolp, keys.AOLP),
    ]
    for name, title, says, value, key in scalars:
        yield scalar(name, title, says, value, inside, key)
    yield "</div>"


def rerendered(small: Shown, again: Rerendered, about: Mapping[str, Any]) -> Iterator[str]:
    """The section with each photograph less what the maps predict of it."""
    yield (
        "<h2>Photographs less their re-rendering</h2><p>The maps, lit as the photographs were, seen through the same "
        "polarizer angles. Grey is agreement; red is where the photograph is brighter: light between parts of the "
        'object, a highlight that the maps lack; blue where the maps are brighter: shadows.</p><div class="grid">'
    )
    inside = small.maps.mask
    rms = about["figures"].get("rerendering", {}).get("rms") or again.rms(inside)
    shots = zip(small.angle, again.measured, again.predicted, rms)
    for number, (angle, measured, predicted, difference) in enumerate(shots, 1):
        yield scalar(
            f"difference-{number}",  # two shots may have the same angle
            f"Polarizer at {np.degrees(angle):g}°",
            "" if difference is None else f"rms {labels.number(100 * difference, 2)} % of white",
            100 * (measured - predicted),
            inside,
            keys.DIFFERENCE,
        )
    yield "</div>"


def scalar(name: str, title: str, says: str, value: Floats, inside: NDArray[np.bool_], key: Key) -> str:
    """A map of numbers with its key; the pointer reads it."""
    about = {
        "kind": "scalar", "low": key.low, "high": key.high, "power": key.power, "palette": key.palette,
        "unit": key.unit, "digits": key.digits,
    }  # fmt: skip
    image = html.indexed(key.level(value, inside), keys.colors(key.palette))
    legend = f'<div class="key">{plots.wheel()}<span>hue: the angle, the same after half a turn</span></div>'
    return _figure(name, title, says, about, image, legend if key.palette == "wheel" else bar(key))


def bar(key: Key) -> str:
    """A color bar with its ticks."""
    stops = keys.colors(key.palette)[:: keys.LEVELS // 17]
    paint = ",".join(plots.hexed(color) for color in stops)
    ticks = "".join(
        f'<span style="left:{100 * key.place(tick):.1f}%">{labels.number(tick, 3)}{key.unit}</span>'
        for tick in key.ticks
    )
    return f'<div class="bar" style="background:linear-gradient(90deg,{paint})"></div><div class="ticks">{ticks}</div>'


def normal(name: str, title: str, vectors: Floats, inside: NDArray[np.bool_]) -> str:
    """A map of normals with its key; the pointer reads it."""
    filled = _outwards(np.rint(255 * (vectors / 2 + 0.5)).astype(np.uint8), inside)
    legend = (
        f'<div class="key"><img width="72" height="72" alt="" src="{html.lossless(plots.ball())}">'
        "<span>colors of a ball: red right, green up, blue toward the camera</span></div>"
    )
    about = {"kind": "normal", "unit": "", "digits": 2}
    return _figure(name, title, "x right, y up, z toward the camera", about, html.lossless(filled), legend)


def _color(name: str, title: str, says: str, linear: Floats, inside: NDArray[np.bool_], top: float) -> str:
    about = {"kind": "color", "top": top, "unit": "", "digits": 2 if top == 1 else 3}
    image = html.jpeg(_outwards(srgb_eight_bits(linear / top), inside), whole_color=True)
    grey = ",".join(f"rgb({v},{v},{v})" for v in srgb_eight_bits(np.linspace(0, 1, 17)).tolist())
    ticks = "".join(
        f'<span style="left:{100 * share:g}%">{labels.number(top * share)}</span>' for share in (0, 0.25, 0.5, 0.75, 1)
    )
    legend = f'<div class="bar" style="background:linear-gradient(90deg,{grey})"></div><div class="ticks">{ticks}</div>'
    return _figure(name, title, says, about, image, legend)


def _figure(name: str, title: str, says: str, about: Mapping[str, Any], image: str, legend: str) -> str:
    return (
        f'<figure class="map" id="map-{name}" data-map="{escape(json.dumps(about))}"><div class="picture">'
        f'<img alt="{escape(title)}" src="{image}"><div class="cross"></div></div>{legend}'
        f"<figcaption><b>{escape(title)}</b> <output></output><br><span>{escape(says)}</span></figcaption></figure>"
    )


def _outwards(picture: NDArray[np.uint8], inside: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A picture that goes on a few pixels past the object, and is dark beyond."""
    if not inside.any():
        return np.zeros_like(picture)
    outside = np.where(inside, np.uint8(0), np.uint8(1))
    distance, nearest = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    color_of = np.zeros((int(nearest.max()) + 1, picture.shape[-1]), np.uint8)
    color_of[nearest[inside]] = picture[inside]
    return np.where((distance <= _RIM)[..., None], color_of[nearest], np.uint8(0))
