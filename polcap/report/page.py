"""report.html: verdict, interactive pictures, maps, plots and tables of one result, by the template `report.html`."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import msgspec
import numpy as np

from polcap.capture_values import CatalogEntry
from polcap.config import Config
from polcap.formats import html
from polcap.formats.capture import layouts
from polcap.formats.maps import png
from polcap.mesh_values import Mesh
from polcap.optics.color import srgb_eight_bits
from polcap.quality.rerendering import Rerendering, rerender
from polcap.report import chart_colors, keys, labels, levels, map_figures, page_data, plots
from polcap.report import stage_pictures as pictures
from polcap.report.keys import Palette
from polcap.results import Results
from polcap.stages import surface

if TYPE_CHECKING:
    from jinja2 import Template

_LONGEST = 1024  # px, longest side of a map
_WIDEST = 1000  # px, of a photograph
_MOST_VERTICES = 60_000  # of the mesh preview: 0.7 MB of the page
_HEADLINE = {
    "pass": "Good to use",
    "warn": "Good to use, but check an assumption",
    "fail": "Check the result before you use it",
}
_SAME_LIGHT = (0.77, 1.3)  # range of the ratio of highlights that agree, set by hand
_SIMILAR = 0.15  # largest relative difference of pictures that agree, set by hand
_ORDER = ("fail", "warn", "pass", "not measured", "not judged")  # of the gates in their table


def write(folder: Path, about: Mapping[str, Any], results: Results) -> None:
    """Write report.html, the page of a result for people, into a result folder."""
    drawn, view = _maps(about, results)
    content = {
        **drawn,
        **_plots(about, results),
        **_tables(about),
        "metric": results.mesh.metric,
        "pictures": list(_pictures(results)),
        "levels": (levels.HEAD, levels.rows(folder)),
    }
    write_report(
        "report.html", folder, about, content, {"view": view, "mesh": _mesh_preview(results, about["settings"])}
    )


def write_report(
    template: str, folder: Path, about: Mapping[str, Any], content: Mapping[str, Any], data: Mapping[str, Any]
) -> None:
    """Write report.html of any kind of result: `content`, and the verdict, gates, catalog and asset of report.json.

    `about` is the content of report.json, `data` is for the scripts of the page.
    """
    headline, expected_error = verdict(about)
    name = about["capture"]["name"]
    common = {
        "about": about,
        "headline": headline,
        "expected_error": expected_error,
        "advice": advice_rows(about["gates"]),
        "gates": gate_rows(about["gates"]),
        "asset": f"asset/{name}.glb",
        "catalog": catalog(about),
    }
    render(template, folder / "report.html", f"{name}: polcap report", {**common, **content}, data)


def catalog(about: Mapping[str, Any]) -> dict[str, str]:
    """The facts of a result's `CatalogEntry`, "" where not stated; empty without any."""
    stated = about["capture"].get("catalog", {})
    return {key: stated.get(key, "") for key in CatalogEntry.__struct_fields__} if stated else {}


def render(
    template: str, file: Path, title: str, content: Mapping[str, Any], data: Mapping[str, Any] | None = None
) -> None:
    """Write a page from one of the HTML templates; `data` is for the scripts of the page."""
    body = _template(template).render(content, number=labels.number)
    palettes = {name: html.text(keys.colors(name).tobytes()) for name in get_args(Palette)}
    html.write(file, title, [body], {"palettes": palettes, **(data or {})})


def archived(text: str, about: Mapping[str, Any], glb: str) -> str:
    """The text of a report's page for another folder: with the catalog facts of `about`, and a link to the GLB there.

    Two templates make these parts, each between two comments with its name. Raises ValueError: a part is missing.
    """
    parts = {"catalog": {"catalog": catalog(about)}, "glb_link": {"asset": glb}}
    for name, content in parts.items():
        before, _, rest = text.partition(f"<!--{name}-->")
        _, found, after = rest.partition(f"<!--/{name}-->")
        if not found:
            raise ValueError(f"it has no part {name}")
        text = before + _template(f"{name}.html").render(content) + after
    return text


def _template(name: str) -> "Template":
    import jinja2  # not needed by most commands

    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    templates = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return templates.get_template(name)


def verdict(about: Mapping[str, Any]) -> tuple[str, str]:
    """Headline of a result's verdict, and a sentence about the expected error of its normals."""
    gates = about["gates"]
    failed = [gate for gate in gates if gate["state"] == "fail"]
    headline = _HEADLINE[about["verdict"]]
    if failed:
        headline += f": {len(failed)} of {len(gates)} gates failed"
    judged = [gate for gate in gates if gate["name"] == "normal error" and gate["value"] is not None]
    if not judged:  # the shots are out of order, or there is no object
        return headline, ""
    ball = about["capture"].get("ball")
    measured = "" if ball is None else f" On your ball it was {ball['mean_deg']:.1f}° ({ball['made'][:10]})."
    within = f"For half of the normals, the expected error is below {_gate_number(judged[0], 'value')}"
    because = judged[0]["says"].partition(", mostly due to: ")[2]
    return headline, (f"{within}; mostly due to these gates: {because}." if because else f"{within}.") + measured


def gate_rows(gates: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """The quality gates as texts for a table, failed ones first."""
    return [gate_row(gate) for gate in sorted(gates, key=lambda gate: _ORDER.index(gate["state"]))]


def advice_rows(gates: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """The failed gates and warnings as texts, those with a remedy first."""
    found = [gate for gate in gates if gate["state"] in ("fail", "warn")]
    return [gate_row(gate) for gate in sorted(found, key=lambda gate: (gate["state"] != "fail", not gate["remedy"]))]


def gate_row(gate: Mapping[str, Any]) -> dict[str, str]:
    """One quality gate as texts for a table: finding, value, limit, cost and remedy.

    The cost is the normal error that the defect causes; it is empty below one degree.
    """
    return {
        "title": gate["name"].capitalize(),
        "state": gate["state"],
        "value": _gate_number(gate, "value"),
        "limit": _gate_number(gate, "limit"),
        "cost": f"{gate['cost_deg']:.0f}°" if (gate.get("cost_deg") or 0) >= 1 else "",
        "finding": gate["says"],
        "remedy": gate.get("remedy", ""),
    }


def _gate_number(gate: Mapping[str, Any], name: str) -> str:
    """Value or limit of a quality gate, with its unit."""
    value, unit = gate[name], gate.get("unit", "")
    if isinstance(value, (int, float)):
        if unit == "1":
            value, unit = 100 * value, "%"
        shown = labels.number(value)
        return f"{shown}{unit}" if unit == "°" else f"{shown} {unit}".rstrip()
    if value is None:
        return "not measured" if name == "value" and gate["state"] != "pass" else ""
    return str(value)


def _maps(about: Mapping[str, Any], results: Results) -> tuple[dict[str, Any], dict[str, Any]]:
    """Map figures of the report, and the camera data of its interactive pictures."""
    maps, ior = results.maps, float(about["settings"]["infer"]["ior"])
    small = page_data.reduce(maps, results.mesh, results.cues, results.radiance.angle, _LONGEST)
    rendered = rerender(small, ior)
    figures = about["figures"].get("rerendering") or rendered.residuals(small.maps.mask)  # an older report has none
    bright = page_data.exposure(small)
    view, size = small.maps.view, small.maps.mask.shape[1::-1]
    photograph = page_data.photograph(results.radiance, results.color, view, size)
    drawn = {
        "photograph": html.jpeg(srgb_eight_bits(bright * photograph)),
        "flashed": html.jpeg(srgb_eight_bits(bright * rendered.scale * rendered.flashed)),
        "agreement": light_agreement(rendered),
        "maps": map_figures.of_result(small, results.mesh.metric),
        "differences": map_figures.differences(small, rendered, figures),
    }
    return drawn, {
        "size": list(size),
        "center": [float(edge) for edge in view.center],
        "focal": float(view.focal),
        "ior": ior,
        "exposure": bright * rendered.scale,
        "top": keys.F0.high,
        "matte": map_figures.matte(small.maps.mask),
    }


def light_agreement(rendered: Rerendering) -> str:
    """A sentence on whether the photograph and the maps under its flash agree, and on the gloss if they do not."""
    percent, ratio = f"{100 * rendered.difference:.0f} %", rendered.highlights
    if not _SAME_LIGHT[0] < ratio < _SAME_LIGHT[1]:
        times = f"{max(ratio, 1 / max(ratio, 1e-3)):.1f} times {'brighter' if ratio > 1 else 'darker'}"
        gloss = "glossier than its maps" if ratio > 1 else "duller than its maps, or has finer relief"
        return (
            f"Both differ in the highlights: there the photograph is {times}, so the object is {gloss}. "
            f"Elsewhere they differ by {percent} (median)"
        )
    if rendered.difference > _SIMILAR:
        return f"Both differ by {percent} (median); the pictures of the differences below show where"
    return f"Both pictures agree, within {percent} (median), and in their highlights"


def _mesh_preview(results: Results, settings: Mapping[str, Any]) -> dict[str, Any]:
    """`mesh_data` of a reduced mesh."""
    chosen = msgspec.convert(settings, Config).surface
    chosen = msgspec.structs.replace(chosen, max_vertices=min(chosen.max_vertices, _MOST_VERTICES))
    return mesh_data(surface.triangulate(results.mesh.depth, results.maps, results.mesh.metric, chosen))


def mesh_data(mesh: Mesh) -> dict[str, Any]:
    """Data of a mesh for a page's interactive view: positions, texture coordinates and faces as base64 texts.

    Positions are 16-bit shares of the box `low`, `extent`: 65535 is 1. Face indices are stored as differences.
    """
    low = mesh.vertices.min(axis=0)
    extent = np.maximum(mesh.vertices.max(axis=0) - low, 1e-9)
    return {
        "position": html.packed(png.sixteen_bits((mesh.vertices - low) / extent)),
        "uv": html.packed(png.sixteen_bits(mesh.uv)),
        "faces": html.packed(np.diff(mesh.faces.astype(np.int32).ravel(), prepend=np.int32(0))),
        "low": low.tolist(),
        "extent": extent.tolist(),
    }


def _plots(about: Mapping[str, Any], results: Results) -> dict[str, Any]:
    """Plots of the measurements of a result; without a chart, no plot of chart colors."""
    names = [f"{angle:g}°" for angle in np.degrees(results.radiance.angle)]
    merge, fit = about["figures"]["merge"], results.color.patches
    chart, measured = None, page_data.patches(results.radiance, results.color)
    if measured is not None and fit is not None:
        known = chart_colors.reference(results.color, about["settings"]["whitebalance"]["chart"])
        chart = plots.chart(known, measured, fit, about["figures"]["chart"])
    return {
        "chart": chart,
        "exposures": plots.exposures(merge["exposure_ratio"], merge["exif_ratio"], names),
        "gains": plots.gains(results.selfcal.gains, names),
        "shifts": plots.shifts(results.alignment, names),
        "timings": plots.timings(about["timings"]),
    }


def _pictures(results: Results) -> Iterator[tuple[str, str, str]]:
    """Title, caption and data URL of the photographs that the report shows."""
    radiance, color = results.radiance, results.color
    outline = pictures.outline(radiance, color, results.object_, _WIDEST)
    yield "Reference shot", "with the detected chart", html.jpeg(pictures.chart(radiance, color, _WIDEST))
    yield "Object", "darkened outside its outline", html.jpeg(outline)
    for tile in pictures.registered(radiance, results.alignment):
        yield tile.caption, tile.note, html.jpeg(pictures.shrink(tile.picture, _WIDEST))


def _tables(about: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of the report's tables: figures by subject, photographs and settings."""
    rows = {part: _rows({part: values}) for part, values in about["figures"].items()}
    return {
        "figures": [
            (labels.part(part), [(labels.label(name), text) for name, text in found]) for part, found in rows.items()
        ],
        "frames": [
            (
                f"{labels.number(shot['angle_deg'])}°",
                frame["file"],
                layouts.shutter(frame["exposure_time"]),
                frame["digest"][:12],
            )
            for shot in about["capture"]["shots"]
            for frame in shot["frames"]
        ],
        "patches": [_patch_row(patch) for patch in about["patches"]],
        "settings": _rows(about["settings"]),
    }


def _patch_row(patch: Mapping[str, Any]) -> tuple[str, ...]:
    """A patch of the chart as texts: Lab measured and reference, and their differences."""
    labs = ["" if None in patch[key] else "  ".join(f"{x:.1f}" for x in patch[key]) for key in ("lab", "lab_reference")]
    names = ("delta_l", "delta_c", "delta_h", "delta_e")
    differences = ["" if patch[name] is None else f"{patch[name]:.2f}" for name in names]
    return patch["name"], *labs, *differences


def _rows(sections: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Full name, and value as text, of all figures or settings in these sections."""
    names = [(f"{section}.{name}", value) for section, values in sections.items() for name, value in values.items()]
    return [(name, labels.text(name, value)) for name, value in names]
