"""Map figures of report.html: picture, color scale and caption; the pointer shows the values."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.formats import html
from polcap.image_values import Bools, Floats
from polcap.optics import outline
from polcap.optics.color import srgb_eight_bits
from polcap.optics.morphology import dilate
from polcap.optics.outline import fill_outward
from polcap.quality.rerendering import Rerendering
from polcap.report import keys
from polcap.report.keys import ColorKey
from polcap.report.labels import number
from polcap.report.page_data import PageMaps

_BORDER_PX = 4  # colors continue so far beyond the outline, because textures are interpolated
_WHEEL_STEPS = 72  # colors of a color wheel
_BAR_STEPS = 17  # colors of a color bar
_PROBED = ("low", "high", "power", "palette", "unit", "digits")  # fields of a color key for probe.js


@dataclass(frozen=True)
class MapFigure:
    """A map as the template `parts.html` draws it: with a color bar, a color wheel or the ball of normals."""

    name: str
    title: str
    note: str
    image: str  # data URL
    probe: dict[str, Any]  # from colors back to numbers, for probe.js
    colors: tuple[str, ...] = ()  # CSS colors of bar or wheel
    ticks: tuple[tuple[float, str], ...] = ()  # place 0…1 and text; none: a wheel
    ball: str = ""  # data URL
    outline: str = ""  # data URL, opaque on the object; it hides colors beyond the outline


def of_result(small: PageMaps, metric: bool) -> list[MapFigure]:
    """Figures of all maps of a result, for report.html."""
    found, inside = small.maps, small.maps.mask
    depth = small.depth * (1000.0 if metric else 1.0)
    depth_key = keys.depth(depth[inside & np.isfinite(depth)], metric)
    error_note = "smaller is better; 3° is very good"
    errors = [("diffuse", "diffuse albedo", found.diffuse_error), ("roughness", "roughness", found.roughness_error)]
    return [
        normal("normal", "Normal", found.normal, inside),
        albedo("diffuse", "Diffuse albedo", "ρ_d, linear: red, green, blue", found.diffuse, inside, 1.0),
        albedo("specular", "Specular albedo F0", "linear: red, green, blue", found.specular, inside, keys.F0.high),
        scalar(
            "roughness", "Roughness", "perceptual: 0 is a mirror, 1 is matt", found.roughness, inside, keys.ROUGHNESS
        ),
        scalar("depth", "Depth", "distance along the optical axis", depth, inside, depth_key),
        scalar("error", "Expected error of the normal", error_note, found.confidence, inside, keys.ERROR),
        *(
            scalar(f"{name}-error", f"Expected error of the {title}", "1σ", error, inside, keys.MATERIAL_ERROR)
            for name, title, error in errors
            if error is not None
        ),
        scalar("dolp", "Degree of linear polarization", "share of the light", small.dolp, inside, keys.DOLP),
        scalar(
            "aolp", "Angle of linear polarization", "from image right, counter-clockwise", small.aolp, inside, keys.AOLP
        ),
    ]


def differences(
    small: PageMaps, rendering: Rerendering, figures: Mapping[str, Sequence[float | None]]
) -> list[MapFigure]:
    """One figure per polarizer angle: photograph minus re-rendering. `figures` are those of `Rerendering.residuals`."""
    notes = map(_difference_note, figures["rms"], figures["outliers"])
    shots = zip(small.angle, rendering.measured, rendering.predicted, notes)
    return [
        scalar(
            f"difference-{count}",  # not by angle: two shots may share one
            f"Polarizer at {np.degrees(angle):g}°",
            note,
            100 * (measured - predicted),
            small.maps.mask,
            keys.DIFFERENCE,
        )
        for count, (angle, measured, predicted, note) in enumerate(shots, 1)
    ]


def _difference_note(rms: float | None, outliers: float | None) -> str:
    """Caption of a difference map: its rms over white, and the share of outliers; empty if no pixel was compared."""
    if rms is None or outliers is None:
        return ""
    return (
        f"rms {number(100 * rms, 2)} % of white without outliers, which are {number(100 * outliers, 2)} % of the pixels"
    )


def scalar(name: str, title: str, note: str, value: Floats, inside: Bools, key: ColorKey) -> MapFigure:
    """Figure of a map with one number per pixel."""
    probe = {"kind": "scalar", **{part: getattr(key, part) for part in _PROBED}}
    palette = keys.colors(key.palette)
    near = dilate(inside, _BORDER_PX)
    image = html.indexed(key.level(fill_outward(value[..., None], inside)[..., 0], near), palette)
    ticks = tuple((key.place(tick), f"{number(tick, 3)}{key.unit}") for tick in key.ticks)
    colors = palette[:: keys.LEVELS // _BAR_STEPS]
    if key.palette == "wheel":  # once around in 180°
        steps = [round(2 * k / _WHEEL_STEPS % 1 * keys.LEVELS) % keys.LEVELS for k in range(_WHEEL_STEPS)]
        colors, ticks = palette[steps], ()
    return MapFigure(name, title, note, image, probe, css_colors(colors), ticks, outline=matte(inside))


def normal(name: str, title: str, vectors: Floats, inside: Bools) -> MapFigure:
    """Figure of a normal map."""
    y, x = np.mgrid[1:-1:96j, -1:1:96j]
    z2 = 1 - x * x - y * y
    ball = np.dstack([_normal_colors(np.stack([x, y, np.sqrt(np.maximum(z2, 0))], -1)), np.uint8(255) * (z2 > 0)])
    return MapFigure(
        name,
        title,
        "x right, y up, z toward the camera",
        html.lossless(_extend(_normal_colors(vectors), inside)),
        {"kind": "normal", "unit": "", "digits": 2},
        ball=html.lossless(ball),
        outline=matte(inside),
    )


def css_colors(rgb: NDArray[np.uint8]) -> tuple[str, ...]:
    """Convert 8-bit sRGB colors (N, 3) to CSS colors."""
    return tuple(f"#{bytes(color).hex()}" for color in rgb)


def albedo(name: str, title: str, note: str, linear: Floats, inside: Bools, top: float) -> MapFigure:
    """Figure of a color map with values from 0 to `top`."""
    image = html.jpeg(_extend(srgb_eight_bits(linear / top), inside), whole_color=True)
    bar = srgb_eight_bits(np.linspace(0, 1, _BAR_STEPS))[:, None].repeat(3, axis=1)
    ticks = tuple((share, number(top * share)) for share in (0, 0.25, 0.5, 0.75, 1))
    probe = {"kind": "color", "top": top, "unit": "", "digits": 2 if top == 1 else 3}
    return MapFigure(name, title, note, image, probe, css_colors(bar), ticks, outline=matte(inside))


def matte(inside: Bools) -> str:
    """The object as an opaque black picture with a soft outline, a data URL."""
    opaque = np.rint(255 * outline.matte(inside)).astype(np.uint8)
    return html.lossless(np.dstack([np.zeros((*inside.shape, 3), np.uint8), opaque]))


def _normal_colors(vectors: Floats) -> NDArray[np.uint8]:
    return np.rint(255 * (vectors / 2 + 0.5)).astype(np.uint8)


def _extend(picture: NDArray[np.uint8], inside: Bools) -> NDArray[np.uint8]:
    """Continue a picture a few pixels beyond the object's outline, for smooth scaling; black farther out."""
    return np.where(dilate(inside, _BORDER_PX)[..., None], fill_outward(picture, inside), np.uint8(0))
