"""In: a figure's name and value. Out: both as a reader wants them, with the unit; never a Python repr."""

from typing import Any

# figure -> (what it is, unit)
LABELS: dict[str, tuple[str, str]] = {
    "merge.exposure_ratio": ("Exposures measured in the pixels, of the brightest frame's", "×"),
    "merge.exif_ratio": ("Exposures as the camera states them", "×"),
    "merge.ghost_fraction": ("Share of each shot that moved between its frames", "%"),
    "merge.lossy_source": ("From 8-bit or developed photographs", ""),
    "chart.source": ("Colors from", ""),
    "chart.edition": ("Edition of the chart, told by its colors", ""),
    "chart.tilt_deg": ("Its turn from facing the lens", "°"),
    "chart.flash": ("Flash as its light's slope has it: right of the lens, above it; of the distance", ""),
    "chart.delta_e_mean": ("Mean residual of the patches", "ΔE2000"),
    "chart.delta_e_max": ("Greatest residual of a patch", "ΔE2000"),
    "chart.delta_e": ("Residual of each patch, from dark skin", "ΔE2000"),
    "chart.predicted_mean": ("Mean residual of patches left out of the fit", "ΔE2000"),
    "chart.predicted": ("The same of each patch", "ΔE2000"),
    "chart.left_out": ("Patches that did not serve", ""),
    "chart.detector_cost": ("Detector's cost", ""),
    "chart.metres_per_px": ("Size of a pixel at the chart", "mm"),
    "chart.scale_doubt": ("All albedos together, 1σ: how deep the chart stands and where the flash is not known", "%"),
    "chart.matrix": ("Camera channels to linear Rec.709", ""),
    "alignment.shift_px": ("Shift of each shot, right and down", "px"),
    "alignment.turn_deg": ("Turn of each shot", "°"),
    "alignment.residual_px": ("Registration error, 1σ", "px"),
    "alignment.correlation": ("Likeness of each shot to the first after registration", ""),
    "gains.source": ("Gains from", ""),
    "gains.gain": ("Light of each shot, of the first's: red, green, blue", "×"),
    "gains.sigma": ("1σ of it", "×"),
    "gains.anchor": ("The same from the object's facing pixels", "×"),
    "gains.disagreement": ("Greatest disagreement of the two", "%"),
    "angles.offset_deg": ("Turn of the polarizer's ring, told by the outline", "°"),
    "angles.offset_sigma_deg": ("1σ of it", "°"),
    "angles.applied_deg": ("Turn taken out of the angles", "°"),
    "angles.concentration": ("How well polarization follows the outline, 0 … 1", ""),
    "angles.best_order": ("Order of the shots that the outline supports", ""),
    "angles.mirrored": ("Angles counted the other way", ""),
    "object.pixels": ("Size of the object", "px"),
    "object.crop": ("Crop: left, top, right, bottom", "RAW px"),
    "object.source": ("Outline from", ""),
    "object.mask_doubt": ("Pixels of the outline in doubt, of the object's", "%"),
    "object.mask_islands": ("Parts that stand apart, of the object", "%"),
    "object.mask_holes": ("Holes, of the object", "%"),
    "object.mask_border": ("Share of the picture's edge that the object covers", "%"),
    "object.clipped_fraction": ("Clipped in every exposure", "%"),
    "object.dark_fraction": ("Too dark", "%"),
    "object.ill_posed_fraction": ("Polarized as no dielectric is", "%"),
    "object.metal_fraction": ("Polarized as metal is", "%"),
    "object.ghost_fraction": ("Moved between frames", "%"),
    "polarization.dolp_median": ("Degree of linear polarization, median", "%"),
    "polarization.dolp_95": ("95th percentile", "%"),
    "polarization.dolp_sigma_median": ("Its noise, 1σ, median", "%"),
    "polarization.residual_median": ("Residual of the sinusoid, median", "%"),
    "maps.estimator": ("Estimated by", ""),
    "maps.normal_error_deg_median": ("Expected error of the normals by the estimator alone, median", "°"),
    "maps.normal_error_deg_90": ("90th percentile", "°"),
    "maps.diffuse_mean": ("Mean diffuse albedo: red, green, blue", ""),
    "maps.specular_median": ("Median specular albedo F0: red, green, blue", ""),
    "maps.roughness_median": ("Median roughness", ""),
    "mesh.vertices": ("Vertices", ""),
    "mesh.faces": ("Triangles", ""),
    "mesh.metric": ("Scale known", ""),
    "mesh.extent": ("Width, height, depth", ""),
    "mesh.pieces": ("Pieces", ""),
    "mesh.cuts": ("Cuts inside the outline, both sides, of its length", "%"),
    "mesh.cut_px": ("Cuts inside the outline", "px"),
    "mesh.raggedness": ("Rim longer than its smooth curve by", "%"),
    "rerendering.rms": ("Difference of photographs and re-rendering, of white, each angle", "%"),
    "rerendering.scale": ("Brightness of the photographs, of the re-rendering's", "×"),
}
PARTS = {
    "merge": "Exposures",
    "chart": "Color",
    "alignment": "Registration",
    "gains": "Light of the shots",
    "angles": "Polarizer",
    "object": "Object",
    "polarization": "Polarization",
    "maps": "Maps",
    "mesh": "Surface",
    "rerendering": "Re-rendering",
}
_STORED = {"%": "1", "×": "1", "mm": "m", "°": "deg"}  # unit on the page -> unit of the number in report.json
_FACTORS = {"%": 100.0, "mm": 1000.0}  # figures are shares and metres


def units(metric: bool) -> dict[str, str]:
    """Unit of every number in report.json that has one; "1" is a share or a factor."""
    found = {name: _STORED.get(unit, unit) for name, (_, unit) in LABELS.items() if unit}
    raw = {"capture.focal_px": "RAW px", "capture.size_px": "RAW px", "capture.focal_doubt": "1"}
    return {**found, **raw, "mesh.extent": "m" if metric else "relative", "timings": "s"}


def part(name: str) -> str:
    """Heading of a part of the figures."""
    return PARTS.get(name, _spoken(name))


def label(name: str) -> str:
    """What `part.figure` or `section.setting` is."""
    known = LABELS.get(name)
    return known[0] if known else _spoken(name.partition(".")[2] or name)


def text(name: str, value: Any) -> str:
    """A figure's value with its unit; lists of lists row by row."""
    unit = LABELS.get(name, ("", ""))[1]
    shown = _plain(value, _FACTORS.get(unit, 1.0))
    if value is None or isinstance(value, (str, bool)) or not unit:
        return shown
    return f"{shown}{'' if unit == '°' else ' '}{unit}"


def number(value: float, digits: int = 4) -> str:
    """At most so many significant digits, no exponent where it can be read without."""
    if value == 0:
        return "0"
    if abs(value) >= 1000:
        return f"{value:,.0f}".replace(",", " ")
    if abs(value) < 1e-5:
        return f"{value:.1e}"
    short = f"{value:.{max(0, digits - 1 - _magnitude(value))}f}"
    return short.rstrip("0").rstrip(".") if "." in short else short


def _magnitude(value: float) -> int:
    """Power of ten of a number's first digit."""
    return int(f"{value:e}".partition("e")[2])


def _plain(value: Any, factor: float) -> str:
    if value is None:
        return "not measured"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (int, float)):
        return number(value * factor)
    if isinstance(value, (list, tuple)):
        if not value:
            return "none"
        nested = any(isinstance(item, (list, tuple)) for item in value)
        return (" / " if nested else ", ").join(_plain(item, factor) for item in value)
    if isinstance(value, dict):
        return ", ".join(f"{_spoken(str(key))} {_plain(item, factor)}" for key, item in value.items())
    return str(value)


def _spoken(name: str) -> str:
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]
