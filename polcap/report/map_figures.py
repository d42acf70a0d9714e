"""HTML figures of maps: picture, color key and caption; the pointer shows the values."""

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
from polcap.report.keys import ColorKey
from polcap.report.page_data import PageMaps, Rerendering

_BORDER_PX = 4  # colors continue beyond the outline, because textures are interpolated


def maps(small: PageMaps, metric: bool) -> Iterator[str]:
    """Section with the maps of a result."""
    found, inside = small.maps, small.maps.mask
    depth = small.depth * (1000.0 if metric else 1.0)
    yield (
        '<h2>Maps</h2><p class="hint">Move the pointer over a map to read the values of all maps at that pixel.</p>'
        '<div class="grid" id="maps">'
    )
    yield normal("normal", "Normal", found.normal, inside)
    yield _color("diffuse", "Diffuse albedo", "ρ_d, linear: red, green, blue", found.diffuse, inside, 1.0)
    yield _color("specular", "Specular albedo F0", "linear: red, green, blue", found.specular, inside, keys.F0.high)
    scalars: list[tuple[str, str, str, Floats, ColorKey]] = [
        ("roughness", "Roughness", "perceptual: 0 is a mirror, 1 is matt", found.roughness, keys.ROUGHNESS),
        (
            "depth",
            "Depth",
            "distance along the optical axis",
            depth,
            keys.depth(depth[inside & np.isfinite(depth)], metric),
        ),
        ("error", "Expected error of the normal", "smaller is better; 3° is very good", found.confidence, keys.ERROR),
        ("dolp", "Degree of linear polarization", "share of the light", small.dolp, keys.DOLP),
        ("aolp", "Angle of linear polarization", "from image right, counter-clockwise", small.aolp, keys.AOLP),
    ]
    for name, title, note, value, key in scalars:
        yield scalar(name, title, note, value, inside, key)
    yield "</div>"


def rerendered(small: PageMaps, rendering: Rerendering, about: Mapping[str, Any]) -> Iterator[str]:
    """Section with the difference between each photograph and its re-rendering."""
    yield (
        "<h2>Photographs minus re-rendering</h2><p>The maps are rendered under the light and polarizer angles of the "
        "photographs and subtracted from them. Gray: both agree. Red: the photograph is brighter, for example from "
        "light reflected between parts of the object, or from a highlight that the maps lack. Blue: the rendering is "
        'brighter, for example in shadows.</p><div class="grid">'
    )
    inside = small.maps.mask
    rms = about["figures"].get("rerendering", {}).get("rms") or rendering.rms(inside)
    shots = zip(small.angle, rendering.measured, rendering.predicted, rms)
    for number, (angle, measured, predicted, difference) in enumerate(shots, 1):
        yield scalar(
            f"difference-{number}",  # not by angle: two shots may share one
            f"Polarizer at {np.degrees(angle):g}°",
            "" if difference is None else f"rms {labels.number(100 * difference, 2)} % of white",
            100 * (measured - predicted),
            inside,
            keys.DIFFERENCE,
        )
    yield "</div>"


def scalar(name: str, title: str, note: str, value: Floats, inside: NDArray[np.bool_], key: ColorKey) -> str:
    """Figure of a map of numbers."""
    about = {
        "kind": "scalar", "low": key.low, "high": key.high, "power": key.power, "palette": key.palette,
        "unit": key.unit, "digits": key.digits,
    }  # fmt: skip
    image = html.indexed(key.level(value, inside), keys.colors(key.palette))
    legend = f'<div class="key">{plots.wheel()}<span>the hue shows the angle; it repeats after 180°</span></div>'
    return _figure(name, title, note, about, image, legend if key.palette == "wheel" else bar(key))


def bar(key: ColorKey) -> str:
    """Color bar with ticks."""
    stops = keys.colors(key.palette)[:: keys.LEVELS // 17]
    paint = ",".join(plots.hexed(color) for color in stops)
    ticks = "".join(
        f'<span style="left:{100 * key.place(tick):.1f}%">{labels.number(tick, 3)}{key.unit}</span>'
        for tick in key.ticks
    )
    return f'<div class="bar" style="background:linear-gradient(90deg,{paint})"></div><div class="ticks">{ticks}</div>'


def normal(name: str, title: str, vectors: Floats, inside: NDArray[np.bool_]) -> str:
    """Figure of a map of normals."""
    filled = _extend(np.rint(255 * (vectors / 2 + 0.5)).astype(np.uint8), inside)
    legend = (
        f'<div class="key"><img width="72" height="72" alt="" src="{html.lossless(plots.ball())}">'
        "<span>the colors of a ball: red is right, green is up, blue is toward the camera</span></div>"
    )
    about = {"kind": "normal", "unit": "", "digits": 2}
    return _figure(name, title, "x right, y up, z toward the camera", about, html.lossless(filled), legend)


def _color(name: str, title: str, note: str, linear: Floats, inside: NDArray[np.bool_], top: float) -> str:
    about = {"kind": "color", "top": top, "unit": "", "digits": 2 if top == 1 else 3}
    image = html.jpeg(_extend(srgb_eight_bits(linear / top), inside), whole_color=True)
    ramp = ",".join(f"rgb({v},{v},{v})" for v in srgb_eight_bits(np.linspace(0, 1, 17)).tolist())
    ticks = "".join(
        f'<span style="left:{100 * share:g}%">{labels.number(top * share)}</span>' for share in (0, 0.25, 0.5, 0.75, 1)
    )
    legend = f'<div class="bar" style="background:linear-gradient(90deg,{ramp})"></div><div class="ticks">{ticks}</div>'
    return _figure(name, title, note, about, image, legend)


def _figure(name: str, title: str, note: str, about: Mapping[str, Any], image: str, legend: str) -> str:
    return (
        f'<figure class="map" id="map-{name}" data-map="{escape(json.dumps(about))}"><div class="picture">'
        f'<img alt="{escape(title)}" src="{image}"><div class="cross"></div></div>{legend}'
        f"<figcaption><b>{escape(title)}</b> <output></output><br><span>{escape(note)}</span></figcaption></figure>"
    )


def _extend(picture: NDArray[np.uint8], inside: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Continue a picture a few pixels beyond the object; black farther out."""
    if not inside.any():
        return np.zeros_like(picture)
    outside = np.where(inside, np.uint8(0), np.uint8(1))
    distance, nearest = cv2.distanceTransformWithLabels(outside, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    color_of = np.zeros((int(nearest.max()) + 1, picture.shape[-1]), np.uint8)
    color_of[nearest[inside]] = picture[inside]
    return np.where((distance <= _BORDER_PX)[..., None], color_of[nearest], np.uint8(0))
