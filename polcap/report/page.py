"""report.html: verdict, interactive pictures, maps, plots and tables of one result."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from polcap.formats import html, shipped_data
from polcap.optics.color import srgb_eight_bits
from polcap.report import keys, labels, map_figures, mesh_preview, page_data, plots
from polcap.report import stage_pictures as pictures
from polcap.report.keys import Palette
from polcap.results import Results

_LONGEST = 1024  # px, longest side of a map
_WIDEST = 1000  # px, of a photograph
_HEADLINE = {
    "pass": "Good to use",
    "warn": "Good to use, but check an assumption",
    "fail": "Check the result before you use it",
}


def write(folder: Path, about: Mapping[str, Any], results: Results) -> None:
    """Write report.html into a result folder.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    sections = _maps(about, results)
    body = [
        *_verdict(about),
        sections["relit"],
        *_solid(sections["metric"], about),
        sections["maps"],
        *_measured(results, about, sections["angles_deg"], _chart(about, results)),
        _pictures(results),
        *_tables(about),
    ]
    data = {
        "palettes": {name: html.text(keys.colors(name).tobytes()) for name in get_args(Palette)},
        "view": sections["view"],
        "mesh": mesh_preview.packed(results.mesh),
    }
    html.write(folder / "report.html", f"{about['capture']['name']}: polcap report", body, data)


def _maps(about: Mapping[str, Any], results: Results) -> dict[str, Any]:
    """Sections drawn from the maps, and the camera of the interactive pictures."""
    radiance, maps, mesh = results.radiance, results.maps, results.mesh
    small = page_data.reduce(maps, mesh, results.cues, radiance.angle, _LONGEST)
    ior = float(about["settings"]["infer"]["ior"])
    rendered = page_data.rerender(small, ior)
    bright = page_data.exposure(small)
    size = small.maps.mask.shape[1::-1]
    photograph = page_data.photograph(radiance, results.color, small.maps.view, size)
    relit = _relit(srgb_eight_bits(bright * photograph), srgb_eight_bits(bright * rendered.scale * rendered.flashed))
    return {
        "relit": "".join(relit),
        "maps": "".join([*map_figures.maps(small, mesh.metric), *map_figures.rerendered(small, rendered, about)]),
        "metric": mesh.metric,
        "angles_deg": [float(angle) for angle in np.degrees(radiance.angle)],
        "view": {
            "size": list(size),
            "center": [float(edge) for edge in small.maps.view.center],
            "focal": float(small.maps.view.focal),
            "ior": ior,
            "exposure": bright * rendered.scale,
            "top": keys.F0.high,
        },
    }


def verdict(about: Mapping[str, Any]) -> tuple[str, str]:
    """Headline of a result, and a sentence about the expected error of its normals."""
    gates = about["gates"]
    failed = [gate for gate in gates if gate["state"] == "fail"]
    headline = _HEADLINE[about["verdict"]]
    if failed:
        headline += f": {len(failed)} of {len(gates)} checks failed"
    judged = [gate for gate in gates if gate["name"] == "normal error" and gate["value"] is not None]
    if not judged:  # the shots are out of order, or there is no object
        return headline, ""
    within = f"For half of the normals, the expected error is below {_gate_value(judged[0], 'value')}"
    because = judged[0]["says"].partition(", mostly due to: ")[2]
    return headline, f"{within}; mostly due to these checks: {because}." if because else f"{within}."


def _verdict(about: Mapping[str, Any]) -> Iterator[str]:
    headline, detail = verdict(about)
    capture, state = about["capture"], escape(about["verdict"])
    yield (
        f'<p class="kicker">{escape(capture["name"])} · {escape(capture["camera"])} · '
        f"{len(capture['shots'])} polarizer angles · {escape(about['figures']['maps']['estimator'])}</p>"
        f'<section class="verdict {state}"><h1>{escape(headline)}.</h1><p>{escape(detail)}</p>'
    )
    notable = [gate for gate in about["gates"] if gate["state"] in ("fail", "warn")]
    if notable:
        yield f"<ul>{''.join(f'<li>{_advice(gate)}</li>' for gate in notable)}</ul>"
    yield "</section>"


def _advice(gate: Mapping[str, Any]) -> str:
    """A gate that did not pass: value, limit, finding and remedy."""
    value, limit = escape(_gate_value(gate, "value")), ""
    if gate["limit"] is not None:
        limit = f" (limit {escape(_gate_value(gate, 'limit'))})"
    cost = f" This causes a normal error of about {_cost(gate)}." if _cost(gate) else ""
    finding = f"{escape(gate['says'])}.{cost}{_remedy(gate)}"
    return f"<b>{escape(gate['name'].capitalize())}</b> {value}{limit}: {finding}"


def _cost(gate: Mapping[str, Any]) -> str:
    """Normal error that the finding causes; empty below one degree."""
    return f"{gate['cost_deg']:.0f}°" if (gate.get("cost_deg") or 0) >= 1 else ""


def _remedy(gate: Mapping[str, Any]) -> str:
    return f" <b>{escape(gate['remedy'])}.</b>" if gate.get("remedy") and gate["state"] != "pass" else ""


def _gate_value(gate: Mapping[str, Any], name: str) -> str:
    value, unit = gate[name], gate.get("unit", "")
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        shown = labels.number(100 * value if unit == "%" else value)
        return f"{shown}{unit}" if unit == "°" else f"{shown} {unit}".rstrip()
    if value is None:
        return "not measured" if name == "value" and gate["state"] != "pass" else ""
    return str(value)


def _relit(photograph: NDArray[np.uint8], flashed: NDArray[np.uint8]) -> Iterator[str]:
    yield (
        '<h2>Photograph and relit object</h2><p class="hint">Move the pointer over the right picture, or use the arrow '
        "keys, to move the light. At first the light is the photograph's flash, so both pictures should agree.</p>"
        f'<div class="pair"><figure><div class="picture"><img alt="The reference photograph" '
        f'src="{html.jpeg(photograph)}"></div><figcaption><b>Photograph</b> <span>first angle, calibrated colors</span>'
        '</figcaption></figure><figure><div class="picture" id="relit"><img alt="The maps under the flash" '
        f'src="{html.jpeg(flashed)}"><canvas id="relight" tabindex="0" aria-label="The maps under a light that '
        'the pointer moves"></canvas></div><figcaption><b>Relit</b> <span>rendered from the maps</span></figcaption>'
        '</figure></div><p class="note needs-gl" hidden>This '
        "browser has no WebGL: the picture shows the maps under the flash only."
        "</p>"
    )


def _solid(metric: bool, about: Mapping[str, Any]) -> Iterator[str]:
    asset = f"asset/{about['capture']['name']}.glb"
    scale = "Lengths are in metres." if metric else "Lengths are relative, because the scale is unknown."
    modes = ("Material", "Clay", "Normals")
    buttons = "".join(
        f'<button data-mode="{mode}" aria-pressed="{str(mode == 0).lower()}">{name}</button>'
        for mode, name in enumerate(modes)
    )
    yield (
        '<section class="needs-pointer"><h2>The surface</h2><p class="hint">Drag to turn it; use the wheel or two '
        f'fingers to zoom. Parts that the camera did not see are missing. {scale} Full mesh: <a href="{escape(asset)}">'
        f'{escape(asset)}</a>.</p><div class="buttons">{buttons}</div><div class="picture">'
        '<canvas id="solid" tabindex="0" aria-label="The surface in three dimensions"></canvas></div></section>'
    )


def _chart(about: Mapping[str, Any], results: Results) -> str:
    """Plot of the measured and the maker's chart colors; empty without a chart."""
    color = results.color
    measured = page_data.patches(results.radiance, color)
    if measured is None or color.patches is None:
        return ""
    known = shipped_data.colorchecker(about["settings"]["whitebalance"]["chart"])
    reference = next((one for one in known.editions if one.name == color.patches.edition), known)
    drawing = plots.chart(
        srgb_eight_bits(reference.rec709), srgb_eight_bits(measured), color.patches.delta_e, reference.patches
    )
    figures = about["figures"]["chart"]
    mean, ahead = labels.number(figures["delta_e_mean"], 2), figures["predicted_mean"]
    note = f"outside: the maker's color; inside: the photographed color; below: ΔE2000, mean {mean}"
    note += "" if ahead is None else f" ({labels.number(ahead, 2)} when each patch is left out of the fit)"
    return _plot("Chart", note, drawing)


def _measured(results: Results, about: Mapping[str, Any], angles: Sequence[float], chart: str) -> Iterator[str]:
    """Section of plots; `angles` in degrees, `chart` as HTML."""
    gains, moved = results.selfcal.gains, results.alignment
    yield "<h2>How it was measured</h2><div class='grid'>" + chart
    merge = about["figures"]["merge"]
    yield _plot(
        "Exposures",
        "measured in the pixels (dots) and stated by the camera (rings)",
        plots.exposures(merge["exposure_ratio"], merge["exif_ratio"], angles),
    )
    yield _plot(
        "Light of the shots",
        f"relative to the first; dots: from {gains.source}; crosses: from pixels that face the camera",
        plots.gains(gains.gain, gains.sigma, gains.anchor, angles),
    )
    yield _plot(
        "Shift of the shots",
        "relative to the first, in pixels of the merged picture; circles are 1σ",
        plots.shifts(moved.transform, moved.residual_px, angles),
    )
    if about.get("timings"):
        yield _plot("Time", "computing time of each stage", plots.timings(about["timings"]))
    yield "</div>"


def _plot(title: str, note: str, drawing: str) -> str:
    return f"<figure>{drawing}<figcaption><b>{escape(title)}</b><br><span>{escape(note)}</span></figcaption></figure>"


def _pictures(results: Results) -> str:
    radiance, color = results.radiance, results.color
    notable: Sequence[tuple[str, str, NDArray[np.uint8]]] = (
        ("Reference shot", "with the detected chart", pictures.chart(radiance, color, _WIDEST)),
        ("Object", "darkened outside its outline", pictures.outline(radiance, color, results.object_, _WIDEST)),
        *((tile.caption, tile.note, tile.picture) for tile in pictures.registered(radiance, results.alignment)),
    )
    figures = "".join(
        f'<figure><div class="picture"><img alt="{title}" src="{html.jpeg(pictures.shrink(picture, _WIDEST))}"></div>'
        f"<figcaption><b>{title}</b><br><span>{note}</span></figcaption></figure>"
        for title, note, picture in notable
    )
    return f'<h2>Photographs as polcap read them</h2><div class="grid">{figures}</div>'


def _tables(about: Mapping[str, Any]) -> Iterator[str]:
    yield "<h2>Checks</h2>" + gates(about["gates"])
    yield "<h2>Figures</h2><div class='grid'>"
    for part, values in about["figures"].items():
        rows = [
            (labels.label(f"{part}.{name}"), labels.text(f"{part}.{name}", value)) for name, value in values.items()
        ]
        table = html.table(("", ""), rows)
        yield f'<div><h3>{escape(labels.part(part))}</h3><div class="scroll figures">{table}</div></div>'
    yield "</div><h2>Photograph files</h2>" + _shots(about["capture"])
    notes = about["capture"]["notes"]
    if notes:
        yield f"<ul>{''.join(f'<li>{escape(note)}</li>' for note in notes)}</ul>"
    settings = (
        (f"{section}.{name}", labels.text(f"{section}.{name}", value))
        for section, values in about["settings"].items()
        for name, value in values.items()
    )
    yield f"<details><summary>Settings of this run</summary>{html.table(('setting', 'value'), settings)}</details>"
    yield f"<p class='soft'>polcap {escape(str(about['polcap']))}. report.json holds the same figures for programs.</p>"


def gates(judged: Sequence[Mapping[str, Any]]) -> str:
    """Table of the checks, failed ones first."""
    order = {"fail": 0, "warn": 1, "pass": 2, "not measured": 3}
    rows = "".join(
        f"<tr><td>{escape(gate['name'].capitalize())}</td>"
        f'<td class="{escape(gate["state"])}">{escape(gate["state"])}</td>'
        f"<td>{escape(_gate_value(gate, 'value'))}</td><td>{escape(_gate_value(gate, 'limit'))}</td>"
        f"<td>{_cost(gate)}</td><td>{escape(gate['says'])}.{_remedy(gate)}</td></tr>"
        for gate in sorted(judged, key=lambda gate: order.get(gate["state"], 4))
    )
    head = "<tr><th>Check</th><th></th><th>Value</th><th>Limit</th><th>Error</th><th>Finding</th></tr>"
    return f'<div class="scroll"><table class="checks">{head}{rows}</table></div>'


def _shots(capture: Mapping[str, Any]) -> str:
    rows = [
        (f"{labels.number(shot['angle_deg'])}°", frame["file"], _shutter(frame["exposure_time"]), frame["digest"][:12])
        for shot in capture["shots"]
        for frame in shot["frames"]
    ]
    size = " × ".join(str(edge) for edge in capture["size_px"])
    known = "" if capture["focal_known"] else " (assumed)"
    return (
        f"<p>{escape(capture['camera'])}, {size} px, focal length {labels.number(capture['focal_px'])} px{known}, "
        f"{escape(capture['layout'])} layout.</p><div class='scroll'>"
        + html.table(("angle", "file", "exposure", "digest"), rows)
        + "</div>"
    )


def _shutter(seconds: float | None) -> str:
    if not seconds:
        return "not stated"
    return f"1/{1 / seconds:.0f} s" if seconds < 0.4 else f"{labels.number(seconds)} s"
