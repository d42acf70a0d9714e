"""Plots of report.html as data; the templates in `parts.html` draw them in the colors of the page's theme."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from polcap.chart_values import ChartReference, PatchColors
from polcap.image_values import Floats
from polcap.optics.color import srgb_eight_bits
from polcap.report.labels import number
from polcap.report.map_figures import css_colors
from polcap.stage_values import Alignment, Gains

_CHANNELS = {"red": "#e0434c", "green": "#2f9e4d", "blue": "#3f78e0"}  # legible on light and dark pages
_BLUE = _CHANNELS["blue"]


@dataclass(frozen=True)
class Mark:
    """One mark (dot, ring, cross or bar) at a value on the axis of a `RowPlot`."""

    place: float  # 0…1 along the axis
    title: str  # shown under the pointer, or next to a bar
    shape: Literal["dot", "ring", "cross", "bar"] = "dot"
    color: str = _BLUE
    error: float = 0.0  # 1σ, share of the axis
    down_px: int = 0  # offset below the row's line


@dataclass(frozen=True)
class RowPlot:
    """A plot with named rows of marks over one common axis."""

    title: str
    note: str
    ticks: list[tuple[float, str]]  # place 0…1 and text
    rows: list[tuple[str, list[Mark]]]  # by name; names may repeat
    row_px: int


def exposures(measured: list[list[float]], stated: list[list[float | None]], names: Sequence[str]) -> RowPlot:
    """Plot of the exposure of each frame in stops: measured in the pixels (dot), stated by the camera (ring)."""
    known = np.log2([value for rows in (measured, stated) for row in rows for value in row if value])
    low, high = np.floor(known.min() - 0.3), np.ceil(known.max() + 0.3)
    rows: list[tuple[str, list[Mark]]] = []
    for name, values, stated_values in zip(names, measured, stated):
        marks: list[Mark] = []
        rows.append((name, marks))
        for frame, (value, by_camera) in enumerate(zip(values, stated_values), 1):
            if by_camera:
                title = f"{name}, frame {frame}: stated {number(by_camera)} ×"
                marks.append(Mark((np.log2(by_camera) - low) / (high - low), title, "ring"))
            if value:
                title = f"{name}, frame {frame}: {number(value)} ×"
                marks.append(Mark((np.log2(value) - low) / (high - low), title))
    stops = range(int(low), int(high) + 1)
    ticks = [((stop - low) / (high - low), "0" if stop == 0 else f"{stop:+d}") for stop in stops]
    note = "in stops; measured in the pixels (dots) and stated by the camera (rings)"
    return RowPlot("Exposures", note, ticks, rows, 34)


def gains(found: Gains, names: Sequence[str]) -> RowPlot:
    """Plot of the light of each shot relative to the first, per channel, with 1σ.

    Crosses are the same gains measured on the object itself.
    """
    changes = np.concatenate([(found.gain - 1).ravel(), np.nan_to_num(found.anchor - 1).ravel()])
    span = max(0.005, 1.15 * float(np.abs(changes).max()))
    rows: list[tuple[str, list[Mark]]] = []
    for name, gain, sigma, anchor in zip(names, found.gain, found.sigma, found.anchor):
        marks: list[Mark] = []
        rows.append((name, marks))
        for channel, (word, color) in enumerate(_CHANNELS.items()):
            title, down = f"{name}, {word}: {gain[channel]:.4f} ± {sigma[channel]:.4f}", 11 * (channel - 1)
            place, error = 0.5 + (gain[channel] - 1) / (2 * span), sigma[channel] / (2 * span)
            marks.append(Mark(place, title, color=color, error=error, down_px=down))
            if np.isfinite(anchor[channel]):
                place = 0.5 + (anchor[channel] - 1) / (2 * span)
                marks.append(Mark(place, f"{name}, {word}: {anchor[channel]:.4f}", "cross", color, down_px=down))
    shares = (-1, -0.5, 0, 0.5, 1)
    ticks = [(0.5 + share / 2, f"{100 * share * span:+.1f} %" if share else "equal") for share in shares]
    note = f"relative to the first; dots: from {found.source}; crosses: from pixels that face the camera"
    return RowPlot("Light of the shots", note, ticks, rows, 46)


def timings(seconds: Mapping[str, float]) -> RowPlot:
    """Plot of computing times: one bar per stage."""
    most = max([*seconds.values(), 1e-3])
    rows = [(name, [Mark(spent / most, f"{spent:.2f} s", "bar")]) for name, spent in seconds.items()]
    return RowPlot("Time", "computing time of each stage", [], rows, 22)


def shifts(found: Alignment, names: Sequence[str]) -> dict[str, Any]:
    """Plot of the image shift of each shot relative to the first: a line per shot, 1σ as a circle."""
    moved, sigmas = found.transform[:, :2, 2], np.where(np.isfinite(found.residual_px), found.residual_px, 0)
    span = max(0.5, 1.2 * float(np.abs(moved).max() + sigmas.max()))
    shots = [
        {
            "name": name,
            "right": float(x / span),
            "down": float(y / span),
            "error": float(sigma / span),
            "title": f"{name}: {x:+.2f}, {y:+.2f} px ± {sigma:.3f}",
        }
        for name, (x, y), sigma in zip(names, moved, sigmas)
    ]
    note = "relative to the first, in pixels of the merged picture; circles are 1σ"
    title = "Shift of the shots"
    return {"title": title, "note": note, "shots": shots, "span": f"{number(span, 2)} px", "color": _BLUE}


def chart(reference: ChartReference, measured: Floats, fit: PatchColors, figures: Mapping[str, Any]) -> dict[str, Any]:
    """Plot of the 24 chart patches: the reference color, the photographed one (24, 3), linear Rec.709, and ΔE."""
    source = "your measured" if figures["reference_sha256"] else "the maker's"
    note = f"outside: {source} color; inside: the photographed color; below: ΔE2000, mean "
    note += f"{number(figures['delta_e_mean'], 2)}, 90th percentile {number(figures['delta_e_90'], 2)}"
    if figures["predicted_mean"] is not None:
        note += f" ({number(figures['predicted_mean'], 2)} when each patch is left out of the fit)"
    colors = (css_colors(srgb_eight_bits(linear)) for linear in (reference.rec709, measured))
    errors = ["left out" if np.isnan(error) else f"{error:.1f}" for error in fit.delta_e]
    patches = [
        {"name": name, "reference": outer, "measured": inner, "error": error}
        for name, outer, inner, error in zip(reference.patches, *colors, errors)
    ]
    return {"title": "Chart", "note": note, "patches": patches}
