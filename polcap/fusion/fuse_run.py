"""Fuses a session: processes its views, runs the path, writes maps, asset, animation, report and verdict."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polcap import __version__
from polcap import report as reports
from polcap.errors import SettingError
from polcap.formats.capture import folder_names
from polcap.formats.export import encoders, provenance
from polcap.fusion import fused_maps, fused_page, joining, object_pictures
from polcap.fusion import session as sessions
from polcap.fusion.baking import AtlasMaps
from polcap.fusion.closed_mesh import is_closed
from polcap.fusion.fused_maps import FusedSource
from polcap.fusion.fusion_path import FusionResults, FusionSettings, path
from polcap.fusion.session import Notify, ProcessedSession, SessionInput
from polcap.pipeline import asset_export, result_folder
from polcap.pipeline.asset_export import ExportRequest
from polcap.pipeline.cache import Progress, StageCache
from polcap.pipeline.run import timings
from polcap.quality import gates
from polcap.quality.gate import Gate, State
from polcap.report import animation

_LODS = 2  # coarser levels, each with a quarter of the triangles
_SIDE = 480  # px of an animation's frame
# limits of the gates
_MOST_RESIDUAL_PX = 0.5  # of a view's corners; a flat, sharp board leaves 0.1 to 0.2
_MOST_FEATURE_PX = 2.0  # of a view's features, on maps of half the size; sharp ones leave 0.6 to 1
_MOST_NORMAL_DEG = 20.0  # median angle between a view's normals and the mesh; single views err by 6 to 9°
_LEAST_SEEN = 0.85  # share of the surface; what stands on the board is never seen
_FEW_VIEWS = 8


def fuse(
    session_input: SessionInput, settings: FusionSettings, out: Path, notify: Notify, progress: Progress
) -> dict[str, Any]:
    """Fuse the views below a folder into the result folder `out`; returns the content of report.json.

    Raises InputError: anything at fault with the user's input.
    """
    session = sessions.read(session_input)  # first: a folder without views stays as it is
    with result_folder.locked(out):
        processed = sessions.process(session, session_input, notify)
        cache = StageCache(out, progress)
        with cache.memory_explained(processed.views[0].mask.size):
            results = path(processed.views, settings, cache)
        results = replace(results, maps=_with_albedo_scale(results.maps, processed))
        cache.begin("write")
        name = session_input.folder.resolve().name
        about = document(name, processed, settings, results, timings(out))
        write(out, about, results)
        cache.end()
        return about


def export(out: Path, *requests: ExportRequest) -> list[Path]:
    """Write the asset of a fused result again for each request, from maps/ and report.json; returns the files."""
    for request in requests:
        asset_export.check(request)
        for flag in {"exr", "iiif"} & set(asset_export.effective(request).formats):
            raise SettingError(
                f"--{flag} is for results of one view, not for a fused object; "
                "leave it out (and --preset archive), and use maps/"
            )
        if "displacement" in request.extras:
            raise SettingError("--extra displacement is for results of one view: a closed mesh has none; leave it out")
    about = reports.read(out)
    with result_folder.locked(out):
        source = fused_maps.read(out / "maps")
        exports = (asset_export.write(out, about, one, asset_export.levels(source, one)) for one in requests)
        return [file for files in exports for file in files]


def _with_albedo_scale(maps: AtlasMaps, processed: ProcessedSession) -> AtlasMaps:
    """The maps with the doubt of their scale: the median of the views', which share the chart and its errors."""
    stated = [report["figures"]["chart"]["scale_doubt"] for report in processed.reports.values()]
    known = [float(one) for one in stated if one is not None]
    return replace(maps, albedo_sigma=float(np.median(known)) if known else None)


def document(
    name: str,
    processed: ProcessedSession,
    settings: FusionSettings,
    results: FusionResults,
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """The content of report.json: facts, figures by view, gates; `seconds` are those of the stages."""
    rows = _rows(processed, results)
    judged = list(_gates(processed, results, rows))
    reports, camera = processed.reports, processed.poses.camera
    first = next(iter(reports.values()))
    shots = [
        {**shot, "frames": [{**frame, "file": f"{view}/{frame['file']}"} for frame in shot["frames"]]}
        for view, report in reports.items()
        for shot in report["capture"]["shots"]
    ]
    return {
        "polcap": __version__,
        "versions": provenance.versions(),
        "verdict": gates.verdict(judged),
        "capture": {**first["capture"], "name": name, "shots": shots},
        "gates": msgspec.to_builtins(judged),
        "figures": {
            "views": {row["name"]: row for row in rows},
            "left_out": dict(processed.left_out),
            "sets": {one.folder: one.shared for one in results.joined},
            "camera": asdict(camera),
            "mesh": {
                "metric": processed.poses.metric,
                "triangles": len(results.atlas.mesh.faces),
                "extent": np.ptp(results.mesh.vertices, axis=0).tolist(),
                "closed": _closed(results),
                "seen": _seen(results),
            },
        },
        "timings": dict(seconds),
        "model": first["model"],
        "keys": {**results.keys, **{f"{view} infer": report["keys"]["infer"] for view, report in reports.items()}},
        "settings": {**first["settings"], "fusion": msgspec.to_builtins(settings)},
    }


def _rows(processed: ProcessedSession, results: FusionResults) -> list[dict[str, Any]]:
    """Figures of each view."""
    rows = []
    for one in results.comparison.views:
        posed = processed.poses.views[one.name]
        rows.append(
            {
                "name": one.name,
                "corners": posed.corners,
                "reprojection_px": posed.residual_px,
                "pose_sigma_deg": posed.sigma_deg,
                "normal_deg": one.normal_deg,
                "residual": one.residual,
                "verdict": _verdict(processed.reports[one.name]),
            }
        )
    return rows


def _verdict(about: Mapping[str, Any]) -> str:
    """Verdict on a view by its report.json without its albedo scale, which the view with the chart gives to all."""
    states = {gate["state"] for gate in about["gates"] if gate["name"] != "albedo scale"}
    return next((state for state in ("fail", "warn") if state in states), "pass")


def _seen(results: FusionResults) -> float:
    """Share of the surface that a view saw."""
    return float(results.maps.seen[results.atlas.covered].mean())


def _closed(results: FusionResults) -> bool:
    """Whether every edge of the mesh, as it is written, belongs to two triangles."""
    return is_closed(fused_maps.closed(results.atlas.mesh))


def _gates(processed: ProcessedSession, results: FusionResults, rows: Sequence[Mapping[str, Any]]) -> Iterator[Gate]:
    yield _views_gate([view.name for view in processed.views], processed.left_out)
    worst = max(rows, key=lambda row: row["reprojection_px"])
    value = worst["reprojection_px"]
    what, limit, remedy = (
        ("The board's corners", _MOST_RESIDUAL_PX, "Keep the board flat, and focus and zoom unchanged")
        if processed.poses.board
        else ("Features of the object", _MOST_FEATURE_PX, "Turn the object on a flat table, focus and zoom unchanged")
    )
    message = f"{what} are within {value:.2f} px (rms) in every view; the worst is {worst['name']}"
    state: State = "pass" if value <= limit else "fail"
    yield Gate("poses", state, value, limit, message, "" if state == "pass" else remedy, unit="px")
    yield _agreement_gate(rows)
    for one in results.joined:
        message = f"The first set confirms {one.shared:.0%} of the surface of {one.folder}"
        yield Gate(f"join {one.folder}", "pass", one.shared, joining.LEAST_SHARED, message)
    seen, state, remedy = _seen(results), "pass", ""
    if seen < _LEAST_SEEN:
        few = len(processed.views) < _FEW_VIEWS
        state, remedy = "warn", "Shoot more views" if few else "Take a second ring of views from higher up"
    yield Gate("seen", state, seen, _LEAST_SEEN, f"Views saw {seen:.0%} of the surface; the rest is filled", remedy)
    whole = _closed(results)
    message = "Every edge of the mesh belongs to two triangles" if whole else "The mesh has open edges"
    yield Gate("closed", "pass" if whole else "fail", None, None, message, "" if whole else "Report this as a bug")


def _views_gate(names: Sequence[str], left_out: Mapping[str, str]) -> Gate:
    """Gate on the number of used views, which names those that are left out, and numbers that no folder has."""
    used, missing = len(names), folder_names.missing_views([*names, *left_out])
    absent = f"; no folder {folder_names.few_names(missing)}" if missing else ""
    if left_out:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        message = f"{len(left_out)} of {used + len(left_out)} views are left out: {reasons}{absent}"
        return Gate("views", "warn", used, _FEW_VIEWS, message, "Shoot these views again, or delete them", unit="")
    if used < _FEW_VIEWS:
        message = f"{used} views are few: parts between them are guessed from outlines{absent}"
        return Gate("views", "warn", used, _FEW_VIEWS, message, "Shoot 12 views or more", unit="")
    return Gate("views", "pass", used, _FEW_VIEWS, f"All {used} views are used{absent}", unit="")


def _agreement_gate(rows: Sequence[Mapping[str, Any]]) -> Gate:
    """Gate on the views whose normals contradict the fused mesh, as after a swap of polarizer angles."""
    worst = max(rows, key=lambda row: row["normal_deg"])
    value, bad = worst["normal_deg"], [row["name"] for row in rows if row["normal_deg"] > _MOST_NORMAL_DEG]
    if bad:
        message = f"The normals of {', '.join(bad)} contradict the mesh, by {value:.0f}° in the worst view"
        remedy = f"Check the polarizer angles of {', '.join(bad)}, or delete them and fuse again"
        return Gate("agreement", "fail", value, _MOST_NORMAL_DEG, message, remedy, unit="°")
    message = f"Normals of all views are within {value:.0f}° of the mesh (median); the worst is {worst['name']}"
    return Gate("agreement", "pass", value, _MOST_NORMAL_DEG, message, unit="°")


def write(out: Path, about: dict[str, Any], results: FusionResults) -> None:
    """Write maps/, asset/, the turntable and the report of a fused result; StorageError."""
    fused_maps.write(out / "maps", results.atlas, results.maps)
    source: FusedSource = fused_maps.read(out / "maps")  # as stored, so that `polcap export` makes the same bytes
    request = ExportRequest(lod=_LODS if source.triangles > 16 * 4**_LODS else 0)
    asset_export.write(out, about, request, asset_export.levels(source, request))
    turning = object_pictures.around(results.atlas, results.maps, object_pictures.FRAMES, _SIDE)
    encoders.animate(out / "asset" / "turntable", turning, animation.SECONDS)
    fused_page.write(out, about, results)
