"""Comparison of two results: differing figures and settings, and a page that shows both."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from polcap.errors import DecodeError
from polcap.formats.maps import maps_folder
from polcap.report import keys, labels, map_figures, page
from polcap.report.map_figures import MapFigure
from polcap.report.reduction import ObjectReduction

_LONGEST = 640  # px, longest side of a map
_DIFFERENCE = keys.ColorKey(-0.2, 0.2, "", (-0.2, -0.1, 0, 0.1, 0.2), "balance", digits=3)
Row = tuple[str, Any, Any]  # name, value in the first result, value in the second


def rows(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[Row]:
    """Figures and settings that differ between two reports, each named part.section.name with both values."""
    first, second = _flat(one), _flat(other)
    names = dict.fromkeys([*first, *second])
    return [(name, first.get(name), second.get(name)) for name in names if first.get(name) != second.get(name)]


def label_row(row: Row) -> tuple[str, str, str]:
    """A differing figure for a page: label, and both values with units, as text."""
    kind, _, name = row[0].partition(".")
    title = f"{labels.part(name.partition('.')[0])}: {labels.label(name)}" if kind == "figures" else name
    return title, labels.text(name, row[1]), labels.text(name, row[2])


def write(file: Path, folders: tuple[Path, Path], abouts: tuple[Mapping[str, Any], Mapping[str, Any]]) -> None:
    """Write a page that shows two results next to each other."""
    names = _names(folders)
    results = []
    for name, about in zip(names, abouts):
        headline, expected_error = page.verdict(about)
        heading = {"name": name, "verdict": about["verdict"], "headline": headline, "expected_error": expected_error}
        results.append({**heading, "gates": page.gate_rows(about["gates"])})
    found = rows(*abouts)
    content = {
        "results": results,
        **_maps(folders, names),
        "differences": [
            (f"{kind} that differ", [label_row(row) for row in found if row[0].startswith(kind.lower())])
            for kind in ("Figures", "Settings")
        ],
    }
    page.render("compare.html", file, f"{names[0]} and {names[1]}: polcap", content)


def _names(folders: tuple[Path, Path]) -> tuple[str, str]:
    """Short names of two result folders: the shortest ends of their paths that differ."""
    parts = [folder.resolve().parts for folder in folders]
    for count in range(1, max(map(len, parts)) + 1):
        one, other = ("/".join(path[-count:]) for path in parts)
        if one != other:
            return one, other
    return "first", "second"


def _maps(folders: Sequence[Path], names: Sequence[str]) -> dict[str, Any]:
    """Figures of the maps of two results by title, with difference maps where the crops have the same size."""
    try:
        stored = [maps_folder.read(folder / "maps") for folder in folders]
    except DecodeError as error:
        return {"fault": str(error)}
    small = [ObjectReduction(maps.mask, _LONGEST).maps(maps) for maps in stored]
    same = stored[0].mask.shape == stored[1].mask.shape
    both = small[0].mask & small[1].mask if same else np.zeros((1, 1), bool)
    normals = [
        map_figures.normal(f"normal-{place}", name, maps.normal, maps.mask)
        for place, (maps, name) in enumerate(zip(small, names))
    ]
    if same:
        cosine = np.sum(small[0].normal * small[1].normal, axis=-1)
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        note = f"median {labels.number(float(np.median(angle[both])), 2)}°" if both.any() else ""
        normals.append(
            map_figures.scalar("normal-difference", "Angle between the normals", note, angle, both, keys.ERROR)
        )
    sections: list[tuple[str, list[MapFigure]]] = [("Normal", normals)]
    for kind, title, key, values in (
        ("roughness", "Roughness", keys.ROUGHNESS, [maps.roughness for maps in small]),
        ("error", "Expected error of the normal", keys.ERROR, [maps.confidence for maps in small]),
        ("diffuse", "Diffuse albedo, mean of the channels", keys.ALBEDO, [maps.diffuse.mean(-1) for maps in small]),
    ):
        figures = [
            map_figures.scalar(f"{kind}-{place}", name, "", values[place], small[place].mask, key)
            for place, name in enumerate(names)
        ]
        if same and kind != "error":
            note, change = f"{names[1]} minus {names[0]}", values[1] - values[0]
            figures.append(map_figures.scalar(f"{kind}-difference", "Difference", note, change, both, _DIFFERENCE))
        sections.append((title, figures))
    return {"fault": "", "same_size": same, "maps": sections}


def _flat(about: Mapping[str, Any]) -> dict[str, Any]:
    """Figures and settings of a report in one dictionary by full name (part.section.name)."""
    return {
        f"{part}.{section}.{name}": value
        for part in ("figures", "settings")
        for section, values in about[part].items()
        for name, value in values.items()
    }
