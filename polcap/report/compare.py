"""Comparison of two results: differing figures and settings, and a page that shows both."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, get_args

import numpy as np

from polcap.errors import DecodeError
from polcap.formats import html
from polcap.formats.maps import maps_folder
from polcap.images import Floats
from polcap.report import keys, labels, map_figures, page
from polcap.report.keys import Palette
from polcap.report.reduction import ObjectReduction

_LONGEST = 640  # px, longest side of a map
_DIFFERENCE = keys.ColorKey(-0.2, 0.2, "", (-0.2, -0.1, 0, 0.1, 0.2), "balance", digits=3)
Row = tuple[str, Any, Any]  # name, value in the first result, value in the second


def rows(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[Row]:
    """Figures and settings that differ between two reports, named part.section.name."""
    found = []
    for part in ("figures", "settings"):
        first, second = _flat(one[part]), _flat(other[part])
        for name in dict.fromkeys([*first, *second]):
            if first.get(name) != second.get(name):
                found.append((f"{part}.{name}", first.get(name), second.get(name)))
    return found


def labelled(row: Row) -> tuple[str, str, str]:
    """A row with label, numbers and units in words."""
    kind, _, name = row[0].partition(".")
    title = f"{labels.part(name.partition('.')[0])}: {labels.label(name)}" if kind == "figures" else name
    return title, labels.text(name, row[1]), labels.text(name, row[2])


def write(file: Path, folders: tuple[Path, Path], abouts: tuple[Mapping[str, Any], Mapping[str, Any]]) -> None:
    """Write a page that shows two results next to each other.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    names = _names(folders)
    body = [
        *_verdicts(abouts, names),
        *_maps(folders, names),
        *_differences(rows(*abouts), names),
        *_gates(abouts, names),
    ]
    data = {"palettes": {name: html.text(keys.colors(name).tobytes()) for name in get_args(Palette)}}
    html.write(file, f"{names[0]} and {names[1]}: polcap", body, data)


def _names(folders: tuple[Path, Path]) -> tuple[str, str]:
    """The shortest ends of two paths that differ."""
    parts = [folder.resolve().parts for folder in folders]
    for count in range(1, max(map(len, parts)) + 1):
        one, other = ("/".join(path[-count:]) for path in parts)
        if one != other:
            return one, other
    return "first", "second"


def _verdicts(abouts: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Iterator[str]:
    yield f"<p class='kicker'>two results</p><h1>{escape(names[0])} and {escape(names[1])}</h1><div class='pair wide'>"
    for about, name in zip(abouts, names, strict=True):
        headline, detail = page.verdict(about)
        yield (
            f'<section class="verdict {escape(about["verdict"])}"><p class="kicker">{escape(name)}</p>'
            f"<p><b>{escape(headline)}.</b></p><p>{escape(detail)}</p></section>"
        )
    yield "</div>"


def _maps(folders: Sequence[Path], names: Sequence[str]) -> Iterator[str]:
    try:
        stored = [maps_folder.read(folder / "maps").maps for folder in folders]
    except DecodeError as error:
        yield f"<p class='note'>No maps to compare: {escape(str(error))}</p>"
        return
    small = [ObjectReduction(maps.mask, _LONGEST).maps(maps) for maps in stored]
    same = stored[0].mask.shape == stored[1].mask.shape
    both = small[0].mask & small[1].mask if same else np.zeros((1, 1), bool)
    yield "<h2>Maps</h2><p class='hint'>Move the pointer over a map to read the values of all maps at that place.</p>"
    yield "" if same else "<p class='note'>The crops differ in size, so no differences are drawn.</p>"
    yield "<h3>Normal</h3><div class='grid'>"
    for place, (maps, name) in enumerate(zip(small, names, strict=True)):
        yield map_figures.normal(f"normal-{place}", name, maps.normal, maps.mask)
    if same:
        difference = _degrees(small[0].normal, small[1].normal)
        note = f"median {labels.number(float(np.median(difference[both])), 2)}°" if both.any() else ""
        yield map_figures.scalar("normal-difference", "Angle between the normals", note, difference, both, keys.ERROR)
    yield "</div>"
    scalars = (
        ("roughness", "Roughness", keys.ROUGHNESS, [maps.roughness for maps in small]),
        ("error", "Expected error of the normal", keys.ERROR, [maps.confidence for maps in small]),
        ("diffuse", "Diffuse albedo, mean of the channels", keys.ALBEDO, [maps.diffuse.mean(-1) for maps in small]),
    )
    for kind, title, key, values in scalars:
        yield f"<h3>{title}</h3><div class='grid'>"
        for place, (maps, name) in enumerate(zip(small, names, strict=True)):
            yield map_figures.scalar(f"{kind}-{place}", name, "", values[place], maps.mask, key)
        if same and kind != "error":
            note = f"{names[1]} minus {names[0]}"
            yield map_figures.scalar(f"{kind}-difference", "Difference", note, values[1] - values[0], both, _DIFFERENCE)
        yield "</div>"


def _degrees(one: Floats, other: Floats) -> Floats:
    return np.asarray(np.degrees(np.arccos(np.clip(np.sum(one * other, axis=-1), -1, 1))))


def _differences(found: Sequence[Row], names: Sequence[str]) -> Iterator[str]:
    for kind, title in (("figures", "Figures that differ"), ("settings", "Settings that differ")):
        lines = [labelled(row) for row in found if row[0].startswith(kind)]
        yield f"<h2>{title}</h2>"
        yield f"<div class='scroll'>{html.table(('', *names), lines)}</div>" if lines else "<p>None.</p>"


def _gates(abouts: Sequence[Mapping[str, Any]], names: Sequence[str]) -> Iterator[str]:
    for about, name in zip(abouts, names, strict=True):
        yield f"<h2>Checks: {escape(name)}</h2>{page.gates(about['gates'])}"


def _flat(tree: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    return {f"{section}.{name}": value for section, part in tree.items() for name, value in part.items()}
