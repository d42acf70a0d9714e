"""Measures a flat sample: processes its views, runs the path, writes maps, asset, report and verdict."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polcap import report
from polcap.errors import SettingError
from polcap.formats.export.texture_set import Extra
from polcap.fusion import session_views
from polcap.fusion.each_view import Notify
from polcap.fusion.session_views import Session, SessionInput
from polcap.material import material_maps, material_page, material_path, material_session
from polcap.material.material_path import MaterialConfig, MaterialResults
from polcap.material.material_session import FlatSession, Region
from polcap.pipeline import asset_export, export_request
from polcap.pipeline.cache import Progress
from polcap.pipeline.export_request import ExportRequest
from polcap.pipeline.run import timings
from polcap.quality import flat_sample, several_views
from polcap.quality.advice import advise
from polcap.quality.gate_values import Gate

_OF_SHAPE: tuple[Extra, ...] = ("curvature", "cavity")  # extra textures that a plane does not have
_SINGLE_VIEW = {"exr", "sfp"}  # formats that need the maps of one picture


def measure(
    session_input: SessionInput[MaterialConfig],
    out: Path,
    region: Region | None,
    texel: float | None,
    tile: bool,
    notify: Notify,
    progress: Progress,
) -> dict[str, Any]:
    """Make a material of the views below a folder, in the result folder `out`; returns the content of report.json.

    `region` and `texel` as for `material_session.process`; `tile` makes the maps seamless.

    Raises InputError: anything at fault with the user's input.
    """
    config = session_input.config
    with session_views.opened(session_input, out, progress) as (session, cache):
        flat = material_session.process(session, session_input, region, texel, cache, notify)  # Stokes parameters
        with cache.memory_explained(math.prod(session.capture.size_px)):
            results = material_path.path(flat.views, flat.chart, flat.board, flat.grid, config.material, tile, cache)
        cache.begin("write")
        about = _document(session_input.folder.resolve().name, session, flat, config, results, timings(out))
        material_maps.write(out / "maps", flat.grid, results.maps, about["keys"], tile)
        source = material_maps.read(out / "maps", config.asset)  # as stored, as `polcap export` reads it
        asset_export.write(out, about, ExportRequest(), source)
        material_page.write(out, about, source)
        cache.end()
        return about


def _document(
    name: str,
    session: Session,
    flat: FlatSession,
    config: MaterialConfig,
    results: MaterialResults,
    seconds: Mapping[str, float],
) -> dict[str, Any]:
    """The content of report.json: facts, figures by view, gates; `seconds` are those of the stages."""
    figures = _figures(flat, results)
    judged = advise(list(_gates(flat, results, figures["views"], config)))
    others = {
        "figures": figures,
        "timings": dict(seconds),
        "model": None,
        "keys": results.keys,
        "settings": msgspec.to_builtins(config),
    }
    captures = {view: report.capture_facts(session.views[view].capture) for view in flat.names}
    return report.session_document(name, captures, judged, others)


def _view_figures(flat: FlatSession, results: MaterialResults, k: int) -> dict[str, Any]:
    """Figures of view k: its pose, its light over that of the first view, and its agreement with the fit."""
    name, gain = flat.names[k], results.light.gain
    posed = flat.poses.views[name]
    return {
        "name": name,
        "tilt_deg": flat.tilt_deg[name],
        "blur_px": flat.blur_px[name],
        "corners": posed.corners,
        "reprojection_px": posed.residual_px,
        "pose_sigma_deg": posed.sigma_deg,
        "light": float(gain[k] / gain[0]),
        "residual": float(results.fitted.residual[k]),
        "misfit": float(results.fitted.misfit[k]),
    }


def _gates(
    flat: FlatSession, results: MaterialResults, views: Mapping[str, Any], config: MaterialConfig
) -> Iterator[Gate]:
    """The gates of a material, in the order of the report; `views` are the figures by view."""
    limits = config.material.gates
    yield flat_sample.views(flat.names, flat.left_out, limits)
    yield flat_sample.tilts(flat.tilt_deg, limits)
    reprojection_px = {name: view["reprojection_px"] for name, view in views.items()}
    yield several_views.poses(reprojection_px, limits.max_corner_px, board=True)
    yield flat_sample.focus(flat.blur_px, limits)
    yield flat_sample.paper(results.light.shine, limits)
    yield flat_sample.agreement({name: view["residual"] for name, view in views.items()}, limits)
    yield flat_sample.seen(float(results.maps.seen.mean()), limits)


def _figures(flat: FlatSession, results: MaterialResults) -> dict[str, Any]:
    """Figures of the views, the light, the materials and the maps."""
    maps, light, gloss = results.maps, results.light, results.gloss
    height, width = maps.seen.shape
    seen = maps.seen if maps.seen.any() else np.ones_like(maps.seen)
    doubts = ("normal_sigma", "diffuse_sigma", "specular_sigma", "roughness_sigma")
    return {
        "views": {name: _view_figures(flat, results, k) for k, name in enumerate(flat.names)},
        "left_out": dict(flat.left_out),
        "camera": asdict(flat.poses.camera),
        "flash": {
            "place_m": light.place.tolist(),
            "paper_albedo": light.paper,
            "paper_scatter": light.sigma,
            "paper_shine": light.shine,
        },
        "chart": {"view": None if flat.chart is None else flat.names[flat.chart.view]},
        "materials": {
            "law": gloss.law,
            "roughness": [float(one) for one in gloss.roughness],
            "f0": [float(one) for one in gloss.f0],
        },
        "maps": {
            "size": [width, height],
            "texel_mm": 1000 * flat.grid.texel,
            "extent_mm": [1000 * flat.grid.texel * side for side in (width, height)],
            "height_mm": [1000 * float(maps.height.min()), 1000 * float(maps.height.max())],
            "thickness_mm": 1000 * maps.thickness,
            "seen": float(maps.seen.mean()),
            **{f"{name}_median": float(np.median(getattr(maps, name)[seen])) for name in doubts},
        },
    }


def export(out: Path, *requests: ExportRequest) -> list[Path]:
    """Write the asset of a material again for each request, from maps/ and report.json; returns the files."""
    requests = tuple(export_request.without(request, _OF_SHAPE) for request in requests)
    for request in requests:
        export_request.check(request)
        for flag in _SINGLE_VIEW & set(export_request.effective(request).formats):
            raise SettingError(f"--{flag} is for results of one view; leave it out, and use the EXRs in maps/")
        if request.lod or request.triangles:
            raise SettingError("--lod and --triangles reduce a mesh, and a material is a plane; leave them out")
    return asset_export.again(out, requests, MaterialConfig, lambda maps, of: material_maps.read(maps, of.asset))
