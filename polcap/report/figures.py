"""Figures of the report: the measured numbers of every stage, by subject, as plain JSON values."""

import math
from typing import Any

import numpy as np

from polcap.formats.maps import maps_folder
from polcap.images import Alignment, AngleStack, ColorCalibration, Cues, Floats, Mesh, Quality, StokesImage
from polcap.report import page_data
from polcap.results import Results
from polcap.stages.whitebalance import patches

_COMPARED_PX = 512  # longest side on which photographs and their re-rendering are compared
_FLAGS = (Quality.CLIPPED, Quality.DARK, Quality.ILL_POSED, Quality.METAL, Quality.GHOST)


def measured(results: Results) -> dict[str, dict[str, Any]]:
    """All figures by subject; `labels.LABELS` describes each of them."""
    return {
        "merge": _exposures(results.radiance),
        "chart": _colors(results.color, results.maps.albedo_sigma),
        "alignment": _registration(results.alignment),
        "gains": _gains(results),
        "angles": _angles(results),
        "object": _object(results),
        "polarization": _polarization(results.cues, results.stokes),
        "maps": _maps(results),
        "mesh": _mesh(results.mesh),
    }


def rerendering(results: Results, ior: float) -> dict[str, Any]:
    """Difference between each photograph and the maps rendered under the same light and polarizer angle."""
    small = page_data.reduce(results.maps, results.mesh, results.cues, results.radiance.angle, _COMPARED_PX)
    rendered = page_data.rerender(small, ior)
    return {"rms": [_number(one) for one in rendered.rms(small.maps.mask)], "scale": _number(rendered.scale)}


def _exposures(radiance: AngleStack) -> dict[str, Any]:
    return {
        "exposure_ratio": _list(radiance.bracket.exposure_ratio.mean(-1)),
        "exif_ratio": _list(radiance.bracket.exif_ratio),
        "ghost_fraction": _list(radiance.bracket.ghost_fraction),
        "lossy_source": radiance.sensor.lossy,
    }


def _colors(color: ColorCalibration, albedo_sigma: float | None) -> dict[str, Any]:
    fit, light = color.patches, color.light
    predicted = None if fit is None else fit.predicted
    return {
        "source": color.source,
        "edition": None if fit is None else fit.edition or None,
        "tilt_deg": None if light is None else _number(np.degrees(light.tilt)),
        "flash": None if light is None else _list(light.flash[:2], 3),
        "delta_e_mean": None if fit is None else _number(np.nanmean(fit.delta_e)),
        "delta_e_max": None if fit is None else _number(np.nanmax(fit.delta_e)),
        "delta_e": None if fit is None else _list(fit.delta_e, 2),
        "predicted_mean": None if predicted is None else _number(np.nanmean(predicted)),
        "predicted": None if predicted is None else _list(predicted, 2),
        "left_out": None if fit is None or fit.use is None else patches.left_out(fit.use),
        "detector_cost": _number(color.cost),
        "metres_per_px": color.metres_per_px,
        "scale_doubt": albedo_sigma,
        "matrix": _list(color.matrix),
    }


def _registration(alignment: Alignment) -> dict[str, Any]:
    transform = alignment.transform
    return {
        "shift_px": _list(transform[:, :2, 2], 3),
        "turn_deg": _list(np.degrees(np.arctan2(transform[:, 1, 0], transform[:, 0, 0])), 4),
        "residual_px": _list(alignment.residual_px, 4),
        "correlation": _list(alignment.correlation, 4),
    }


def _gains(results: Results) -> dict[str, Any]:
    gains = results.selfcal.gains
    return {
        "source": gains.source,
        "gain": _list(gains.gain, 5),
        "sigma": _list(gains.sigma, 5),
        "anchor": _list(gains.anchor, 5),
        "disagreement": _number(gains.disagreement),
    }


def _angles(results: Results) -> dict[str, Any]:
    ring, outline = results.selfcal.ring, results.selfcal.outline
    return {
        "offset_deg": _number(np.degrees(ring.offset)),
        "offset_sigma_deg": _number(np.degrees(ring.sigma)),
        "applied_deg": _number(np.degrees(ring.correction)),
        "concentration": _number(outline.concentration),
        "best_order": list(outline.best.shots),
        "mirrored": outline.best.mirrored,
    }


def _object(results: Results) -> dict[str, Any]:
    image, maps, found = results.stokes, results.maps, results.object_
    return {
        "pixels": int(image.mask.sum()),
        "crop": maps_folder.raw_crop(maps.view, *maps.mask.shape[::-1]),
        "source": found.source,
        "mask_doubt": None if found.doubt is None else _number(found.doubt),
        "mask_islands": _number(found.islands),
        "mask_holes": _number(found.holes),
        "mask_border": _number(found.border),
        **{f"{flag.name}_fraction".lower(): _flagged_share(image, flag) for flag in _FLAGS},
    }


def _polarization(cues: Cues, image: StokesImage) -> dict[str, Any]:
    return {
        "dolp_median": _percentile(cues.dolp, image, 50),
        "dolp_95": _percentile(cues.dolp, image, 95),
        "dolp_sigma_median": _percentile(cues.ratio_sigma, image, 50),
        "residual_median": None if image.residual is None else _percentile(image.residual, image, 50),
    }


def _maps(results: Results) -> dict[str, Any]:
    maps, image = results.maps, results.stokes
    return {
        "estimator": maps.estimator,
        "normal_error_deg_median": _percentile(maps.confidence, image, 50),
        "normal_error_deg_90": _percentile(maps.confidence, image, 90),
        "diffuse_mean": _list(maps.diffuse[maps.mask].mean(0), 4),
        "specular_median": _list(np.median(maps.specular[maps.mask], axis=0), 4),
        "roughness_median": _percentile(maps.roughness, image, 50),
    }


def _mesh(mesh: Mesh) -> dict[str, Any]:
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "metric": mesh.metric,
        "extent": _list(mesh.vertices.max(0) - mesh.vertices.min(0), 5),
        "pieces": mesh.pieces,
        "cuts": _number(mesh.cuts),
        "cut_px": _number(mesh.cut_px),
        "raggedness": _number(mesh.raggedness),
    }


def _flagged_share(image: StokesImage, flag: Quality) -> float:
    inside = image.quality[image.mask]
    return round(float(((inside & int(flag)) > 0).mean()), 5) if inside.size else 0.0


def _percentile(value: Floats, image: StokesImage, percentile: float) -> float | None:
    """Percentile of a map over the object; None without an object."""
    return _number(np.percentile(value[image.mask], percentile)) if image.mask.any() else None


def _number(value: Any, digits: int = 6) -> float | None:
    """A rounded Python number; None where the value is not finite."""
    return round(float(value), digits) if math.isfinite(value) else None


def _list(values: Floats, digits: int = 5) -> list[Any]:
    """Nested lists of `_number`."""
    return [
        _list(value, digits) if isinstance(value, np.ndarray) else _number(value, digits)
        for value in np.asarray(values)
    ]
