"""Fuses a session: processes its views, runs the path, writes maps, asset, animation, report and verdict."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polcap import report
from polcap.errors import SettingError
from polcap.formats.export import encoders
from polcap.formats.export.texture_set import Extra
from polcap.fusion import closed_mesh, fused_maps, fused_page, object_pictures, session_views
from polcap.fusion import session as sessions
from polcap.fusion.baking import AtlasMaps
from polcap.fusion.comparison import ViewAgreement
from polcap.fusion.each_view import Notify
from polcap.fusion.fusion_path import FusionResults, SessionConfig, path
from polcap.fusion.session import ProcessedSession
from polcap.fusion.session_views import SessionInput
from polcap.pipeline import asset_export, export_request
from polcap.pipeline.cache import Progress
from polcap.pipeline.export_request import ExportRequest
from polcap.pipeline.run import timings
from polcap.quality import fused_object
from polcap.quality.advice import advise
from polcap.quality.fused_object import SeenSurface
from polcap.quality.gate_values import Gate
from polcap.quality.limits import FusedGateLimits
from polcap.report import animation

OF_ONE_VIEW: tuple[Extra, ...] = ("displacement", "curvature", "cavity")  # extra textures that a fused object lacks
_LODS = 2  # coarser levels of detail, each with a quarter of the triangles
_SIDE = 480  # px of an animation's frame


def fuse(session_input: SessionInput[SessionConfig], out: Path, notify: Notify, progress: Progress) -> dict[str, Any]:
    """Fuse the views below a folder into the result folder `out`; returns the content of report.json.

    Raises InputError: anything at fault with the user's input.
    """
    config = session_input.config
    config.check()
    with session_views.opened(session_input, out, progress) as (session, cache):
        processed = sessions.process(session, session_input, cache, notify)  # maps and poses of the views
        with cache.memory_explained(math.prod(session.capture.size_px)):
            results = path(processed.views, config.fusion, cache)  # closed mesh, atlas, textures
        results = replace(results, maps=_with_albedo_scale(results.maps, processed))
        cache.begin("write")
        about = _document(session_input.folder.resolve().name, processed, config, results, timings(out))
        _write(out, about, results, config)
        cache.end()
        return about


def _with_albedo_scale(maps: AtlasMaps, processed: ProcessedSession) -> AtlasMaps:
    """The maps with the 1σ of the albedo scale: the median over the views, for all share the errors of one chart."""
    sigmas = [about["figures"]["chart"]["scale_doubt"] for about in processed.reports.values()]
    known = [sigma for sigma in sigmas if sigma is not None]
    return replace(maps, albedo_sigma=float(np.median(known)) if known else None)


def _document(
    name: str,
    processed: ProcessedSession,
    config: SessionConfig,
    results: FusionResults,
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """The content of report.json: facts, figures by view, gates; `seconds` are those of the stages."""
    reports = processed.reports
    seen = SeenSurface.measure(results.maps.seen[results.atlas.covered], results.atlas.normal[:, 1])
    figures = _figures(processed, results, seen)
    judged = advise(list(_gates(processed, seen, figures, config.fusion.gates)))
    others = {
        "figures": figures,
        "timings": dict(seconds),
        "model": next(iter(reports.values()))["model"],
        "keys": {**results.keys, **{f"{view} infer": one["keys"]["infer"] for view, one in reports.items()}},
        "settings": msgspec.to_builtins(config),
    }
    return report.session_document(name, {view: one["capture"] for view, one in reports.items()}, judged, others)


def _view_figures(processed: ProcessedSession, compared: ViewAgreement) -> dict[str, Any]:
    """Figures of one view: its pose, and its agreement with the fused object."""
    posed = processed.poses.views[compared.name]
    return {
        "name": compared.name,
        "corners": posed.corners,
        "reprojection_px": posed.residual_px,
        "pose_sigma_deg": posed.sigma_deg,
        "normal_deg": compared.normal_deg,
        "residual": compared.residual,
        "verdict": _verdict(processed.reports[compared.name]),
    }


def _verdict(about: Mapping[str, Any]) -> str:
    """Verdict on a view by the gates in its report.json, except `albedo scale`, which all views share."""
    states = {gate["state"] for gate in about["gates"] if gate["name"] != "albedo scale"}
    return next((state for state in ("fail", "warn") if state in states), "pass")


def _gates(
    processed: ProcessedSession, seen: SeenSurface, figures: Mapping[str, Any], limits: FusedGateLimits
) -> Iterator[Gate]:
    """The gates of a fused object, in the order of the report."""
    views = figures["views"]
    yield fused_object.views(list(processed.reports), processed.left_out, limits)
    by_board = processed.poses.board is not None
    yield fused_object.poses({name: view["reprojection_px"] for name, view in views.items()}, by_board, limits)
    yield fused_object.agreement({name: view["normal_deg"] for name, view in views.items()}, limits)
    for set_name, shared in figures["sets"].items():
        yield fused_object.join(set_name, shared, limits)
    yield fused_object.seen(seen, len(processed.reports), limits)
    yield fused_object.closed(figures["mesh"]["closed"])


def _figures(processed: ProcessedSession, results: FusionResults, seen: SeenSurface) -> dict[str, Any]:
    """Figures of the views, the sets of views, the camera and the mesh."""
    return {
        "views": {one.name: _view_figures(processed, one) for one in results.comparison.views},
        "left_out": dict(processed.left_out),
        "sets": {one.folder: one.shared for one in results.joined},
        "camera": asdict(processed.poses.camera),
        "mesh": {
            "metric": processed.poses.metric,
            "triangles": len(results.atlas.mesh.faces),
            "texture_px": results.maps.mask.shape[0],
            "texels_per_mm": 0.001 / results.atlas.texel if processed.poses.metric else None,
            "extent": np.ptp(results.mesh.vertices, axis=0).tolist(),
            "closed": closed_mesh.is_closed(fused_maps.weld(results.atlas.mesh)),  # as it is written
            "seen": seen.seen,
        },
    }


def _write(out: Path, about: dict[str, Any], results: FusionResults, config: SessionConfig) -> None:
    """Write maps/, asset/, the turntable and the report of a fused result."""
    fused_maps.write(out / "maps", results.atlas, results.maps, about["keys"])
    source = fused_maps.read(out / "maps", config.asset)  # as stored, so that `polcap export` makes the same bytes
    levels = _LODS if source.triangles > closed_mesh.FEWEST * 4**_LODS else 0
    asset_export.write(out, about, ExportRequest(lod=levels), source)
    turning = object_pictures.draw_around(results.atlas, results.maps, object_pictures.FRAMES, _SIDE)
    encoders.animate(out / "asset" / "turntable", turning, animation.SECONDS)
    fused_page.write(out, about, results)


def export(out: Path, *requests: ExportRequest) -> list[Path]:
    """Write the asset of a fused result again for each request, from maps/ and report.json; returns the files."""
    requests = tuple(export_request.without(request, OF_ONE_VIEW) for request in requests)
    for request in requests:
        export_request.check(request)
        for flag in {"exr", "iiif", "sfp"} & set(export_request.effective(request).formats):
            message = f"--{flag} is for results of one view, not for a fused object; leave it out, and use maps/"
            raise SettingError(message)
    return asset_export.again(out, requests, SessionConfig, lambda maps, of: fused_maps.read(maps, of.asset))
