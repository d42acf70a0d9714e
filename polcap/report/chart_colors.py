"""Colors of the chart's patches as a laboratory states them: CIE Lab measured and reference, and their differences.

References
----------
CIE 15:2018, §8.2.1 (Lab; ΔL*, ΔC*, ΔH*).
"""

from pathlib import Path
from typing import Any

import numpy as np

from polcap.chart_values import ChartReference, ColorCalibration
from polcap.formats import shipped_data
from polcap.formats.raw import file_bytes
from polcap.image_values import Floats
from polcap.optics.color import REC709_TO_XYZ
from polcap.report import page_data
from polcap.stage_values import AngleStack


def patches(radiance: AngleStack, color: ColorCalibration, kind: str) -> list[dict[str, Any]]:
    """Each patch of the chart: name, Lab (D65, 2°) measured and reference, differences, ΔE2000; empty without a chart.

    `kind` is the setting whitebalance.chart. Values of patches that were not measured are None.
    """
    measured = page_data.patches(radiance, color)
    if measured is None or color.patches is None:
        return []
    known = reference(color, kind)
    one, other = _lab(measured), _lab(known.rec709)
    columns = zip(known.patches, one, other, *_differences(one, other), color.patches.delta_e, strict=True)
    names = ("lab", "lab_reference", "delta_l", "delta_c", "delta_h", "delta_e")
    return [{"name": name, **dict(zip(names, map(_rounded, values)))} for name, *values in columns]


def digest(kind: str) -> str | None:
    """SHA-256 of the file of measurements that whitebalance.chart names; None for a chart by its maker's values."""
    path = Path(kind)
    return file_bytes.digest(path.read_bytes()) if path.is_file() else None


def reference(color: ColorCalibration, kind: str) -> ChartReference:
    """The reference colors of the edition of the chart that fits."""
    known = shipped_data.colorchecker(kind)
    edition = "" if color.patches is None else color.patches.edition
    return next((one for one in known.editions if one.name == edition), known)


def _lab(rec709: Floats) -> Floats:
    """CIE Lab (N, 3) of linear Rec.709 (N, 3)."""
    from polcap.optics.colour_science import colour

    return np.asarray(colour.XYZ_to_Lab(np.asarray(rec709, np.float64) @ REC709_TO_XYZ.T))


def _differences(one: Floats, other: Floats) -> tuple[Floats, Floats, Floats]:
    """ΔL*, ΔC* and ΔH* (N,) of measured minus reference Lab (N, 3); ΔH* has the sign of the turn of the hue."""
    chroma, reference_chroma = (np.hypot(lab[:, 1], lab[:, 2]) for lab in (one, other))
    along = reference_chroma * chroma + one[:, 1] * other[:, 1] + one[:, 2] * other[:, 2]
    turn = one[:, 2] * other[:, 1] - one[:, 1] * other[:, 2]
    hue = turn * np.sqrt(2 / np.maximum(along, 1e-12))
    return one[:, 0] - other[:, 0], chroma - reference_chroma, hue


def _rounded(value: Floats) -> Any:
    """A number or a list of numbers with two decimals; None where it is not finite."""
    values = np.round(np.atleast_1d(value), 2)
    rounded = [float(x) if np.isfinite(x) else None for x in values]
    return rounded if np.ndim(value) else rounded[0]
