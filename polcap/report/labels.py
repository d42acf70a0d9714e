"""Labels, units and number formats of the figures in report.html."""

from typing import Any

# figure -> (label, unit)
LABELS: dict[str, tuple[str, str]] = {
    "merge.exposure_ratio": ("Exposures measured in the pixels, relative to the reference frame", "×"),
    "merge.exif_ratio": ("Exposures stated by the camera", "×"),
    "merge.ghost_fraction": ("Part of each shot that moved between its frames", "%"),
    "merge.lossy_source": ("From 8-bit or developed photographs", ""),
    "chart.source": ("Colors from", ""),
    "chart.edition": ("Edition of the chart", ""),
    "chart.tilt_deg": ("Tilt of the chart away from the lens", "°"),
    "chart.flash": ("Estimated flash position right of and above the lens, relative to the chart's distance", ""),
    "chart.delta_e_mean": ("Mean color error of the patches", "ΔE2000"),
    "chart.reference_sha256": ("Digest of the file of measured reference colors", ""),
    "chart.delta_e_90": ("90th percentile of the color errors of the patches", "ΔE2000"),
    "chart.delta_e_max": ("Largest color error of a patch", "ΔE2000"),
    "chart.delta_e": ("Color error of each patch, dark skin first", "ΔE2000"),
    "chart.predicted_mean": ("Mean color error, each patch left out of the fit in turn", "ΔE2000"),
    "chart.predicted": ("Color error of each patch when left out of the fit", "ΔE2000"),
    "chart.surroundings": ("Patches around the block of 24", ""),
    "chart.left_out": ("Patches not used", ""),
    "chart.detector_cost": ("Cost of the chart's detection, 0 is best", ""),
    "chart.metres_per_px": ("Size of a pixel at the chart", "mm"),
    "chart.scale_doubt": ("Common error of all albedos, 1σ; without a chart they are relative", "%"),
    "chart.matrix": ("Camera channels to linear Rec.709", ""),
    "alignment.shift_px": ("Shift of each shot, right and down", "px"),
    "alignment.turn_deg": ("Rotation of each shot", "°"),
    "alignment.residual_px": ("Registration error, 1σ", "px"),
    "alignment.correlation": ("Correlation of each shot with the first after registration", ""),
    "gains.source": ("Gains from", ""),
    "gains.gain": ("Light of each shot relative to the first: red, green, blue", "×"),
    "gains.sigma": ("Error of this light, 1σ", "×"),
    "gains.anchor": ("The same, measured on pixels that face the camera", "×"),
    "gains.disagreement": ("Largest disagreement of the two", "%"),
    "angles.offset_deg": ("Zero error of the polarizer's ring, measured at the outline", "°"),
    "angles.offset_sigma_deg": ("Error of this measurement, 1σ", "°"),
    "angles.applied_deg": ("Correction added to all angles", "°"),
    "angles.concentration": ("How well polarization follows the outline, 0 … 1", ""),
    "angles.best_order": ("Order of the shots that fits the outline best", ""),
    "angles.mirrored": ("Angles count clockwise", ""),
    "object.pixels": ("Size of the object", "px"),
    "object.crop": ("Crop: left, top, right, bottom", "RAW px"),
    "object.source": ("Outline from", ""),
    "object.mask_doubt": ("Expected error of the outline, relative to the object", "%"),
    "object.mask_islands": ("Separate parts, share of the object", "%"),
    "object.mask_holes": ("Holes, share of the object", "%"),
    "object.mask_border": ("Share of the picture's border covered by the object", "%"),
    "object.clipped_fraction": ("Clipped in every exposure", "%"),
    "object.dark_fraction": ("Too dark", "%"),
    "object.ill_posed_fraction": ("More polarized than any dielectric", "%"),
    "object.metal_fraction": ("Polarized like metal", "%"),
    "object.ghost_fraction": ("Moved between frames", "%"),
    "polarization.dolp_median": ("Degree of linear polarization, median", "%"),
    "polarization.dolp_95": ("Degree of linear polarization, 95th percentile", "%"),
    "polarization.dolp_sigma_median": ("Noise of the polarization, 1σ, median", "%"),
    "polarization.residual_median": ("Residual of the cosine fit over the angles, median", "%"),
    "maps.estimator": ("Estimated by", ""),
    "maps.normal_error_deg_median": ("Expected error of the normals from the estimator alone, median", "°"),
    "maps.normal_error_deg_90": ("Expected error of the normals, 90th percentile", "°"),
    "maps.diffuse_mean": ("Mean diffuse albedo: red, green, blue", ""),
    "maps.specular_median": ("Median specular albedo F0: red, green, blue", ""),
    "maps.roughness_median": ("Median roughness", ""),
    "mesh.vertices": ("Vertices", ""),
    "mesh.faces": ("Triangles", ""),
    "mesh.metric": ("Scale known", ""),
    "mesh.extent": ("Width, height, depth", ""),
    "mesh.pieces": ("Pieces", ""),
    "mesh.cuts": ("Cuts inside the outline, both sides, relative to the outline's length", "%"),
    "mesh.cut_px": ("Length of the cuts inside the outline", "px"),
    "mesh.raggedness": ("Raggedness: mesh border longer than its smoothed curve by", "%"),
    "rerendering.rms": ("Difference of photograph and re-rendering at each angle, without outliers, to white", "%"),
    "rerendering.outliers": ("Pixels that differ by more than five standard deviations, at each angle", "%"),
    "rerendering.agreement": ("Agreement of their polarizations: 1 if equal, −1 if across", "1"),
    "rerendering.scale": ("Brightness of the photographs relative to the re-rendering", "×"),
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
_FACTORS = {"%": 100.0, "mm": 1000.0}  # from shares and metres


def units(metric: bool) -> dict[str, str]:
    """Units of the figures in report.json by name; "1" is a share or a factor."""
    found = {name: _STORED.get(unit, unit) for name, (_, unit) in LABELS.items() if unit}
    raw = {"capture.focal_px": "RAW px", "capture.size_px": "RAW px", "capture.focal_doubt": "1"}
    return {**found, **raw, "mesh.extent": "m" if metric else "relative", "timings": "s"}


def part(name: str) -> str:
    """Heading of a group of figures in the report."""
    return PARTS.get(name, _words(name))


def label(name: str) -> str:
    """Label of a figure or setting, from its full name `part.figure` or `section.setting`."""
    known = LABELS.get(name)
    return known[0] if known else _words(name.partition(".")[2] or name)


def text(name: str, value: Any) -> str:
    """Value of a figure as text with its unit; lists of lists row by row."""
    unit = LABELS.get(name, ("", ""))[1]
    words = _value_text(value, _FACTORS.get(unit, 1.0))
    if value is None or isinstance(value, (str, bool)) or not unit:
        return words
    return f"{words}{'' if unit == '°' else ' '}{unit}"


def number(value: float, digits: int = 4) -> str:
    """A number with at most `digits` significant digits; an exponent only below 1e-5."""
    if value == 0:
        return "0"
    if abs(value) >= 1000:
        return f"{value:,.0f}".replace(",", " ")
    if abs(value) < 1e-5:
        return f"{value:.1e}"
    magnitude = int(f"{value:e}".partition("e")[2])  # power of ten of the first digit
    short = f"{value:.{max(0, digits - 1 - magnitude)}f}"
    return short.rstrip("0").rstrip(".") if "." in short else short


def _value_text(value: Any, factor: float) -> str:
    """A value of report.json as text, times the factor of its unit."""
    if value is None:
        return "not measured"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, (int, float)):
        return number(value * factor)
    if isinstance(value, dict):
        return ", ".join(f"{_words(str(key))} {_value_text(item, factor)}" for key, item in value.items()) or "none"
    if isinstance(value, (list, tuple)):
        separator = " / " if any(isinstance(item, (list, tuple)) for item in value) else ", "
        return separator.join(_value_text(item, factor) for item in value) or "none"
    return str(value)


def _words(name: str) -> str:
    words = name.replace("_", " ").strip()
    return words[:1].upper() + words[1:]
