"""In: the results of a run. Out: its figures and the verdict of its gates, report.json and report.html.

A gate that fails means: the asset was written, do not trust it unseen (exit code 3). A gate that warns
states an assumption. A gate that could not be measured says so.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from polcap import __version__
from polcap.config import Config
from polcap.errors import StorageError
from polcap.formats import atomic, text_file
from polcap.formats.maps import maps_folder
from polcap.images import (
    Capture,
    Floats,
    Frame,
    Network,
    Quality,
    StokesImage,
)
from polcap.quality import gates
from polcap.quality.gate import Gate, full_size
from polcap.report import labels, page, shown
from polcap.results import Results
from polcap.stages.cues import scale
from polcap.stages.whitebalance import patches

_COMPARED_PX = 512  # the longest side on which photographs and re-rendering are compared


class _Photograph(msgspec.Struct, frozen=True):
    file: str
    digest: str


class _Angle(msgspec.Struct, frozen=True):
    angle_deg: float
    frames: list[_Photograph]


class _Facts(msgspec.Struct, frozen=True):
    name: str
    camera: str
    shots: list[_Angle]


class _Maps(msgspec.Struct, frozen=True):
    normal_error_deg_median: float | None


class _Figures(msgspec.Struct, frozen=True):
    maps: _Maps


class _Stored(msgspec.Struct, frozen=True):
    """What other commands take from a report.json, which anybody, or another polcap, may have written."""

    polcap: str
    verdict: Literal["pass", "warn", "fail"]
    gates: list[Gate]
    capture: _Facts
    figures: dict[str, dict[str, Any]]
    settings: dict[str, dict[str, Any]]
    keys: dict[str, str]
    model: dict[str, str] | None


def capture_facts(capture: Capture) -> dict[str, Any]:
    """What was understood of the folder."""

    def frame(one: Frame) -> dict[str, Any]:
        return {"file": Path(one.path).name, "exposure_time": one.exif.exposure_time, "digest": one.digest}

    camera = capture.shots[0].frames[0].exif
    return {
        "name": capture.name,
        "folder": capture.folder,
        "layout": capture.layout,
        "camera": f"{camera.make} {camera.model}".strip(),
        "size_px": list(capture.size_px),
        "focal_px": capture.focal_px,
        "focal_known": capture.focal_known,
        "focal_doubt": list(capture.focal_doubt),
        "shots": [
            {"angle_deg": float(np.degrees(shot.angle)), "frames": [frame(one) for one in shot.frames]}
            for shot in capture.shots
        ],
        "notes": list(capture.notes),
    }


def figures(results: Results) -> dict[str, dict[str, Any]]:
    """Every measured figure, by the part of the path that it tells of."""
    radiance, color = results.radiance, results.color
    colors = color.patches
    predicted = None if colors is None else colors.predicted
    found, gains, image = results.alignment, results.selfcal.gains, results.stokes
    cues, maps, mesh, object_ = results.cues, results.maps, results.mesh, results.object_
    ring, outline = results.selfcal.ring, results.selfcal.outline
    turn = np.degrees(np.arctan2(found.transform[:, 1, 0], found.transform[:, 0, 0]))
    extent = mesh.vertices.max(0) - mesh.vertices.min(0)
    return {
        "merge": {
            "exposure_ratio": _list(radiance.bracket.exposure_ratio.mean(-1)),
            "exif_ratio": _list(radiance.bracket.exif_ratio),
            "ghost_fraction": _list(radiance.bracket.ghost_fraction),
            "lossy_source": radiance.sensor.lossy,
        },
        "chart": {
            "source": color.source,
            "edition": None if colors is None else colors.edition or None,
            "tilt_deg": None if color.light is None else _number(np.degrees(color.light.tilt)),
            "flash": None if color.light is None else _list(color.light.flash[:2], 3),
            "delta_e_mean": None if colors is None else _number(np.nanmean(colors.delta_e)),
            "delta_e_max": None if colors is None else _number(np.nanmax(colors.delta_e)),
            "delta_e": None if colors is None else _list(colors.delta_e, 2),
            "predicted_mean": None if predicted is None else _number(np.nanmean(predicted)),
            "predicted": None if predicted is None else _list(predicted, 2),
            "left_out": None if colors is None or colors.use is None else patches.left_out(colors.use),
            "detector_cost": _number(color.cost),
            "metres_per_px": color.metres_per_px,
            "scale_doubt": scale.doubt(image, color),
            "matrix": _list(color.matrix),
        },
        "alignment": {
            "shift_px": _list(found.transform[:, :2, 2], 3),
            "turn_deg": _list(turn, 4),
            "residual_px": _list(found.residual_px, 4),
            "correlation": _list(found.correlation, 4),
        },
        "gains": {
            "source": gains.source,
            "gain": _list(gains.gain, 5),
            "sigma": _list(gains.sigma, 5),
            "anchor": _list(gains.anchor, 5),
            "disagreement": _number(gains.disagreement),
        },
        "angles": {
            "offset_deg": _number(np.degrees(ring.offset)),
            "offset_sigma_deg": _number(np.degrees(ring.sigma)),
            "applied_deg": _number(np.degrees(ring.correction)),
            "concentration": _number(outline.concentration),
            "best_order": list(outline.best.shots),
            "mirrored": outline.best.mirrored,
        },
        "object": {
            "pixels": int(image.mask.sum()),
            "crop": maps_folder.raw_crop(maps.view, *maps.mask.shape[::-1]),
            "source": object_.source,
            "mask_doubt": None if object_.doubt is None else _number(object_.doubt),
            "mask_islands": _number(object_.islands),
            "mask_holes": _number(object_.holes),
            "mask_border": _number(object_.border),
            **{
                f"{bit.name}_fraction".lower(): _share(image, bit)
                for bit in (Quality.CLIPPED, Quality.DARK, Quality.ILL_POSED, Quality.METAL, Quality.GHOST)
            },
        },
        "polarization": {
            "dolp_median": _inside(cues.dolp, image, 50),
            "dolp_95": _inside(cues.dolp, image, 95),
            "dolp_sigma_median": _inside(cues.ratio_sigma, image, 50),
            "residual_median": None if image.residual is None else _inside(image.residual, image, 50),
        },
        "maps": {
            "estimator": maps.estimator,
            "normal_error_deg_median": _inside(maps.confidence, image, 50),
            "normal_error_deg_90": _inside(maps.confidence, image, 90),
            "diffuse_mean": _list(maps.diffuse[maps.mask].mean(0), 4),
            "specular_median": _list(np.median(maps.specular[maps.mask], axis=0), 4),
            "roughness_median": _inside(maps.roughness, image, 50),
        },
        "mesh": {
            "vertices": len(mesh.vertices),
            "faces": len(mesh.faces),
            "metric": mesh.metric,
            "extent": _list(extent, 5),
            "pieces": mesh.pieces,
            "cuts": _number(mesh.cuts),
            "cut_px": _number(mesh.cut_px),
            "raggedness": _number(mesh.raggedness),
        },
    }


def rerendering(results: Results, ior: float) -> dict[str, Any]:
    """How far the photographs are from what the maps say they should be."""
    small = shown.reduce(results.maps, results.mesh, results.cues, results.radiance.angle, _COMPARED_PX)
    again = shown.rerender(small, ior)
    return {"rms": [_number(one) for one in again.rms(small.maps.mask)], "scale": _number(again.scale)}


def document(
    facts: Mapping[str, Any], results: Results, config: Config, timings: Mapping[str, float]
) -> dict[str, Any]:
    """report.json: facts of the run, measurements and the gates' judgement; timings [s] of the stored stages."""
    found = {**figures(results), "rerendering": rerendering(results, config.infer.ior)}
    focal_doubt = tuple(facts["capture"].get("focal_doubt", (0.0, 0.0)))
    judged = list(gates.judge(full_size(results, focal_doubt), config.gates, config.align))
    return {
        "polcap": __version__,
        "versions": facts["versions"],
        "verdict": gates.verdict(judged),
        "capture": facts["capture"],
        "gates": msgspec.to_builtins(judged),
        "figures": found,
        "units": labels.units(bool(found["mesh"]["metric"])),
        "timings": dict(timings),
        "model": facts["model"],
        "keys": dict(results.keys),
        "settings": facts["settings"],
    }


def model_facts(network: Network | None) -> dict[str, str] | None:
    """What a model says of itself, its digest and that of its fine pass; None for the analytic estimator."""
    if network is None:
        return None
    beside = {} if network.fine is None else {"fine": network.fine.digest}
    return {**network.metadata, "digest": network.digest, **beside}


def write(folder: Path, about: dict[str, Any], results: Results) -> None:
    """report.json and report.html with its pictures, in a result folder.

    Raises
    ------
    StorageError
        The folder cannot be written.
    """
    with atomic.path(folder / "report.json") as temporary:
        text = json.dumps(about, indent=1, ensure_ascii=False, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8", errors="backslashreplace")  # names of files are bytes
    page.write(folder, about, results)


def read(folder: Path) -> dict[str, Any]:
    """The report.json of a result folder.

    Raises
    ------
    StorageError
        There is none, or it is not one.
    """
    try:
        about = text_file.read_json(folder / "report.json")
        msgspec.convert(msgspec.convert(about, _Stored).figures, _Figures)
    except OSError as error:
        if not folder.exists():
            raise StorageError(f"{folder}: no such folder; give the result folder of `polcap process`") from error
        if (folder.parent / "report.json").exists():
            raise StorageError(f"{folder} is a part of a result; give the whole, {folder.parent}") from error
        raise StorageError(f"{folder} holds no report.json; run `polcap process` first") from error
    except ValueError as error:
        text = f"{folder / 'report.json'} is no report of this polcap ({error}); run `polcap process` again"
        raise StorageError(text) from error
    found: dict[str, Any] = about
    return found


def _share(image: StokesImage, bit: Quality) -> float:
    inside = image.quality[image.mask]
    return round(float(((inside & int(bit)) > 0).mean()), 5) if inside.size else 0.0


def _inside(value: Floats, image: StokesImage, percentile: float) -> float | None:
    return _number(np.percentile(value[image.mask], percentile)) if image.mask.any() else None


def _number(value: Any, digits: int = 6) -> float | None:
    """A figure for JSON; None where it could not be measured."""
    return round(float(value), digits) if math.isfinite(value) else None


def _list(values: Floats, digits: int = 5) -> list[Any]:
    return [
        _list(value, digits) if isinstance(value, np.ndarray) else _number(value, digits)
        for value in np.asarray(values)
    ]
