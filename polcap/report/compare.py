"""Comparison of two results: changes of the object, differing figures and settings, and a page of both."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.errors import DecodeError
from polcap.formats import html
from polcap.formats.maps import maps_folder
from polcap.image_values import Bools
from polcap.optics.color import luminance, srgb_eight_bits
from polcap.optics.reduction import ObjectReduction
from polcap.report import changes, keys, labels, map_figures, page
from polcap.report.changes import Changes
from polcap.report.keys import ColorKey
from polcap.report.map_figures import MapFigure
from polcap.stage_values import SurfaceMaps

_LONGEST = 640  # px, longest side of a map
_KEYS = {
    "color": ColorKey(0, 20, "", (0, 2, 5, 10, 20), "inferno", power=2, digits=1),
    "normal": keys.ERROR,
    "roughness": ColorKey(-0.2, 0.2, "", (-0.2, -0.1, 0, 0.1, 0.2), "balance", digits=3),
}
_OVER_DOUBT = ColorKey(0, 10, "", (0, 2.5, 5, 7.5, 10), "inferno", digits=1)
_NAMES = {"color": ("Color, ΔE2000", ""), "normal": ("Normal", "°"), "roughness": ("Roughness", "")}
HEAD = ("", "Median difference", "99th percentile", "Doubt, median", "Changed share of the object")
Row = tuple[str, Any, Any]  # name, value in the first result, value in the second


def rows(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[Row]:
    """Figures and settings that differ between two reports, each named part.section.name with both values."""
    first, second = _flatten(one), _flatten(other)
    names = dict.fromkeys([*first, *second])
    return [(name, first.get(name), second.get(name)) for name in names if first.get(name) != second.get(name)]


def label_row(row: Row) -> tuple[str, str, str]:
    """A differing figure for a page: label, and both values with units, as text."""
    kind, _, name = row[0].partition(".")
    title = f"{labels.part(name.partition('.')[0])}: {labels.label(name)}" if kind == "figures" else name
    return title, labels.text(name, row[1]), labels.text(name, row[2])


def write(
    file: Path, folders: tuple[Path, Path], abouts: tuple[Mapping[str, Any], Mapping[str, Any]]
) -> tuple[str, list[tuple[str, ...]]]:
    """Write a page on the differences of two results; returns its sentence, and the rows of its table `HEAD`."""
    names = _names(folders)
    results = []
    for name, about in zip(names, abouts):
        headline, expected_error = page.verdict(about)
        heading = {"name": name, "verdict": about["verdict"], "headline": headline, "expected_error": expected_error}
        facts = " · ".join(fact for fact in page.catalog(about).values() if fact)
        results.append({**heading, "catalog": facts, "gates": page.gate_rows(about["gates"])})
    found = rows(*abouts)
    maps = _maps(folders, names)
    content = {
        "results": results,
        **maps,
        "head": HEAD,
        "differences": [
            (f"{kind} that differ", [label_row(row) for row in found if row[0].startswith(kind.lower())])
            for kind in ("Figures", "Settings")
        ],
    }
    page.render("compare.html", file, f"{names[0]} and {names[1]}: polcap", content)
    return maps["sentence"], maps["rows"]


def _names(folders: tuple[Path, Path]) -> tuple[str, str]:
    """Short names of two result folders: the shortest ends of their paths that differ."""
    parts = [folder.resolve().parts for folder in folders]
    for count in range(1, max(map(len, parts)) + 1):
        one, other = ("/".join(path[-count:]) for path in parts)
        if one != other:
            return one, other
    return "first", "second"


def _maps(folders: tuple[Path, Path], names: tuple[str, str]) -> dict[str, Any]:
    """Differences between the maps of two results: sentences, table, and figures by title."""
    nothing: dict[str, Any] = {"notes": [], "rows": [], "slider": (), "maps": []}
    try:
        one, other = (maps_folder.read(folder / "maps") for folder in folders)
    except DecodeError as error:
        return {"sentence": f"No maps to compare: {error}", **nothing}
    first, second = (ObjectReduction(maps.mask, _LONGEST).maps(maps) for maps in (one, other))
    found = changes.measure(first, second)
    if not found.usable:
        text = "The two results show different objects or sides, or one camera was turned about its axis"
        return {"sentence": f"{text}: their pictures cannot be laid on each other.", **nothing}
    return {
        "sentence": sentence(found),
        "notes": _notes(found),
        "rows": _table(found),
        "slider": tuple(html.jpeg(_picture(maps, found.both)) for maps in (first, found.other)),
        "maps": _figures(names, first, found),
    }


def sentence(found: Changes) -> str:
    """One sentence on the changes beyond the doubt."""
    changed = [_change(name, one) for name, one in found.differences.items() if one.changed.any()]
    if changed:
        return f"Changed beyond the doubt: {', '.join(changed)} of the object."
    color, normal, rough = (labels.number(one.median, 2) for one in found.differences.values())
    agree = f"colors agree to ΔE2000 {color}, normals to {normal}°, roughness to {rough} (medians)"
    return f"Nothing changed beyond the doubt: {agree}."


def _change(name: str, difference: changes.Difference) -> str:
    """Text on a changed quantity: median size of the change, and share of the object."""
    size = float(np.median(difference.value[difference.changed]))
    share = f"on {labels.number(100 * difference.share, 2)} %"
    if name == "roughness":
        return f"roughness by {size:+.2f} {share}"
    return f"color by ΔE2000 {size:.1f} {share}" if name == "color" else f"normals by {size:.1f}° {share}"


def _notes(found: Changes) -> list[str]:
    """Sentences on the registration of the second result onto the first."""
    notes = [f"{100 * found.share:.0f} % of the object is compared; the pictures correlate by {found.correlation:.2f}."]
    if found.turn_deg > 1:
        notes.append(f"The camera turned by {found.turn_deg:.1f}° about the object; the normals are turned back.")
    if abs(found.gain - 1) > 0.02:
        notes.append(f"Albedo of the second result × {found.gain:.2f}: the scales of both are known no better.")
    return notes


def _table(found: Changes) -> list[tuple[str, ...]]:
    """Rows of the table of differences: median, 99 % quantile, doubt, changed share."""
    rows = []
    for name, one in found.differences.items():
        title, unit = _NAMES[name]
        large, middle = (float(np.quantile(np.abs(one.value[found.both]), q)) for q in (0.99, 0.5))
        doubt = float(np.median(one.doubt[found.both]))
        numbers = (f"{labels.number(value, 2)}{unit}" for value in (middle, large, doubt))
        rows.append((title, *numbers, f"{labels.number(100 * one.share, 2)} %"))
    return rows


def _picture(maps: SurfaceMaps, both: Bools) -> NDArray[np.uint8]:
    """The object under a lamp at the upper right, as 8-bit sRGB."""
    return srgb_eight_bits(np.clip(maps.diffuse * (changes.shading(maps) * both)[..., None], 0, 1))


def _figures(names: tuple[str, str], first: SurfaceMaps, found: Changes) -> list[tuple[str, list[MapFigure]]]:
    """Figures of each quantity: both results, their difference, and the difference over the doubt."""
    draw: dict[str, Callable[[str, str, SurfaceMaps], MapFigure]] = {
        "color": lambda at, name, maps: map_figures.scalar(
            at, name, "luminance of the diffuse albedo", luminance(maps.diffuse), found.both, keys.ALBEDO
        ),
        "normal": lambda at, name, maps: map_figures.normal(at, name, maps.normal, found.both),
        "roughness": lambda at, name, maps: map_figures.scalar(
            at, name, "", maps.roughness, found.both, keys.ROUGHNESS
        ),
    }
    sections = []
    for kind, one in found.differences.items():
        title, unit = _NAMES[kind]
        note = f"{names[1]} minus {names[0]}" if kind == "roughness" else f"median {labels.number(one.median, 2)}{unit}"
        over, limit = np.abs(one.value) / one.doubt, f"over {changes.LIMIT:g} in a region: changed"
        figures = [
            draw[kind](f"{kind}-0", names[0], first),
            draw[kind](f"{kind}-1", names[1], found.other),
            map_figures.scalar(f"{kind}-difference", "Change", note, one.value, found.both, _KEYS[kind]),
            map_figures.scalar(f"{kind}-doubt", "Change over doubt", limit, over, found.both, _OVER_DOUBT),
        ]
        sections.append((title, figures))
    return sections


def _flatten(about: Mapping[str, Any]) -> dict[str, Any]:
    """Figures and settings of a report in one dictionary by full name (part.section.name)."""
    return {
        f"{part}.{section}.{name}": value
        for part in ("figures", "settings")
        for section, values in about[part].items()
        for name, value in values.items()
    }
