"""Measures the figures of report.json: numbers on the result of every stage, as plain JSON values."""

import math
from typing import Any

import numpy as np

from polcap.chart_values import ColorCalibration, PatchColors
from polcap.formats.maps import maps_folder
from polcap.image_values import Floats, Quality
from polcap.mesh_values import Mesh
from polcap.quality.rerendering import reduce, rerender
from polcap.results import Results
from polcap.stage_values import StokesImage
from polcap.stages.whitebalance import patches

_COMPARED_PX = 512  # longest side on which photographs and their re-rendering are compared
_FLAGS = (Quality.CLIPPED, Quality.DARK, Quality.ILL_POSED, Quality.METAL, Quality.GHOST)


def measure(results: Results) -> dict[str, dict[str, Any]]:
    """All figures of a result by subject, for report.json; `labels.LABELS` describes each of them."""
    bracket, alignment, gains = results.radiance.bracket, results.alignment, results.selfcal.gains
    ring, outline = results.selfcal.ring, results.selfcal.outline
    return {
        "merge": {
            "exposure_ratio": _plain(bracket.exposure_ratio.mean(-1), 5),
            "exif_ratio": _plain(bracket.exif_ratio, 5),
            "ghost_fraction": _plain(bracket.ghost_fraction, 5),
            "lossy_source": results.radiance.sensor.lossy,
        },
        "chart": _colors(results.color, results.maps.albedo_sigma),
        "alignment": {
            "shift_px": _plain(alignment.transform[:, :2, 2], 3),
            "turn_deg": _plain(np.degrees(np.arctan2(alignment.transform[:, 1, 0], alignment.transform[:, 0, 0])), 4),
            "residual_px": _plain(alignment.residual_px, 4),
            "correlation": _plain(alignment.correlation, 4),
        },
        "gains": {
            "source": gains.source,
            "gain": _plain(gains.gain, 5),
            "sigma": _plain(gains.sigma, 5),
            "anchor": _plain(gains.anchor, 5),
            "disagreement": _plain(gains.disagreement),
        },
        "angles": {
            "offset_deg": _plain(np.degrees(ring.offset)),
            "offset_sigma_deg": _plain(np.degrees(ring.sigma)),
            "applied_deg": _plain(np.degrees(ring.correction)),
            "concentration": _plain(outline.concentration),
            "best_order": list(outline.best.shots),
            "mirrored": outline.best.mirrored,
        },
        "object": _object(results),
        "polarization": _polarization(results),
        "maps": _maps(results),
        "mesh": _mesh(results.mesh),
    }


def rerendering(results: Results, ior: float) -> dict[str, Any]:
    """Figures of the re-rendering: photographs against the maps rendered under the same light and polarizer angle."""
    small = reduce(results.maps, results.cues, results.radiance.angle, _COMPARED_PX)
    rendered = rerender(small, ior)
    found = {name: [_plain(one) for one in values] for name, values in rendered.residuals(small.maps.mask).items()}
    return {**found, "scale": _plain(rendered.scale), "agreement": _plain(rendered.agreement)}


def _colors(color: ColorCalibration, albedo_sigma: float | None) -> dict[str, Any]:
    """Figures of the color calibration and of the chart's patches."""
    fit, light = color.patches, color.light
    delta_e, predicted = (None, None) if fit is None else (fit.delta_e, fit.predicted)
    return {
        "source": color.source,
        "edition": None if fit is None else fit.edition or None,
        "tilt_deg": None if light is None else _plain(np.degrees(light.tilt)),
        "flash": None if light is None else _plain(light.flash[:2], 3),
        "delta_e_mean": None if delta_e is None else _plain(np.nanmean(delta_e)),
        "delta_e_90": None if delta_e is None else _plain(np.nanquantile(delta_e, 0.9)),
        "delta_e_max": None if delta_e is None else _plain(np.nanmax(delta_e)),
        "delta_e": _plain(delta_e, 2),
        "predicted_mean": None if predicted is None else _plain(np.nanmean(predicted)),
        "predicted": _plain(predicted, 2),
        "surroundings": _surroundings(fit),
        "left_out": None if fit is None or fit.use is None else patches.left_out(fit.use),
        "detector_cost": _plain(color.cost),
        "metres_per_px": color.metres_per_px,
        "scale_doubt": albedo_sigma,
        "matrix": _plain(color.matrix, 5),
    }


def _surroundings(fit: PatchColors | None) -> str | None:
    """Text for the report: number of patches used around the block of a ColorChecker SG."""
    if fit is None or fit.surroundings is None:
        return None
    used = fit.surroundings[~np.isnan(fit.surroundings)]
    mean = f", mean color error {used.mean():.1f} ΔE2000" if len(used) else ""
    return f"{len(used)} of {len(fit.surroundings)} used{mean}"


def _object(results: Results) -> dict[str, Any]:
    """Figures of the mask, and the shares of flagged pixels."""
    image, maps, found = results.stokes, results.maps, results.object_
    inside = image.quality[image.mask]
    flagged = {flag: float(((inside & int(flag)) > 0).mean()) if inside.size else 0.0 for flag in _FLAGS}
    return {
        "pixels": int(image.mask.sum()),
        "crop": maps_folder.raw_crop(maps.view, *maps.mask.shape[::-1]),
        "source": found.source,
        "mask_doubt": _plain(found.doubt),
        "mask_islands": _plain(found.islands),
        "mask_holes": _plain(found.holes),
        "mask_border": _plain(found.border),
        **{f"{flag.name}_fraction".lower(): _plain(share, 5) for flag, share in flagged.items()},
    }


def _polarization(results: Results) -> dict[str, Any]:
    cues, image = results.cues, results.stokes
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
        "diffuse_mean": _plain(maps.diffuse[maps.mask].mean(0), 4),
        "specular_median": _plain(np.median(maps.specular[maps.mask], axis=0), 4),
        "roughness_median": _percentile(maps.roughness, image, 50),
    }


def _mesh(mesh: Mesh) -> dict[str, Any]:
    return {
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "metric": mesh.metric,
        "extent": _plain(np.ptp(mesh.vertices, axis=0), 5),
        "pieces": mesh.pieces,
        "cuts": _plain(mesh.cuts),
        "cut_px": _plain(mesh.cut_px),
        "raggedness": _plain(mesh.raggedness),
    }


def _percentile(value: Floats, image: StokesImage, percentile: float) -> Any:
    """A percentile of a map over the object's pixels; None without an object."""
    return _plain(np.percentile(value[image.mask], percentile)) if image.mask.any() else None


def _plain(value: Any, digits: int = 6) -> Any:
    """Convert numbers to rounded Python numbers, arrays to nested lists; None for missing or infinite numbers."""
    if np.ndim(value):
        return [_plain(one, digits) for one in value]
    return round(float(value), digits) if value is not None and math.isfinite(value) else None
