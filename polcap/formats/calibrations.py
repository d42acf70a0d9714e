"""Measurements of the user: calibrations of camera, lens and filter, and color profiles of a chart (TOML).

`polcap calibrate` writes dated files into the user's folder, $POLCAP_CALIB or the system's folder for settings; a
capture uses the newest that fits it. Each result keeps its color profile for captures without a chart.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import tomli_w
from msgspec import Meta

from polcap.errors import CaptureError, ChartError
from polcap.formats import atomic, own_folders, text_file
from polcap.images import (
    Calibration,
    ChartPlace,
    ColorCalibration,
    Distortion,
    Exif,
    Floats,
    LensGeometry,
    PatchColors,
    Polarizer,
)
from polcap.optics import distortion

_FULL_TURN = 360.0  # degrees
_MAX_SIDE = 1_000_000  # px of a picture
_MAX_DISTORTION = 1000.0  # of k1 and k2; a lens whose picture does not fold over itself has less
_LEAST_LIGHT = 0.02  # in a corner of the lens, relative to the middle
_HEAD = """\
# polcap calibration. Signals: 1 is the sensor's white. Each sigma is 1σ. Angles from image x towards image up.
# noise: variance of a pixel of the merged picture (half size) = slope * signal + floor.
# geometry: a point at x appears at x (1 + k1 r^2 + k2 r^4), x and r from the principal point in focal lengths.
# falloff: light = 1 + a r^2 + b r^4 + c r^6, r = 1 in the corners. polarizer: axis = sense * stated + zero_deg.
"""


def write(place: Path, found: Calibration) -> Path:
    """Write a dated file into the folder `place` and return its path; StorageError."""
    parts = [found.made[:19].replace(":", ""), found.camera, found.lens, found.filter]
    path = place / (atomic.safe_name(" ".join(part for part in parts if part)) + ".toml")
    with atomic.path(path) as temporary:
        temporary.write_text(text(found), encoding="utf-8")
    return path


def text(found: Calibration) -> str:
    """The content of the file that `write` writes."""
    return _HEAD + tomli_w.dumps(_bare(msgspec.to_builtins(found)))


def read(path: Path) -> Calibration:
    """Read a file that `write` wrote.

    Raises
    ------
    CaptureError
        It is not such a file, or cannot be read.
    """
    try:
        found = msgspec.convert(text_file.read_toml(path), Calibration)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); repair or remove it") from None
    except ValueError as error:
        raise CaptureError(f"{path}: not a polcap calibration ({error}); calibrate again, or remove it") from None
    wrong = [name for name, possible in _possible_parts(found).items() if not possible]
    if wrong:
        raise CaptureError(f"{path}: its {', '.join(wrong)} is impossible; calibrate again, or remove the file")
    return found


def choose(exif: Exif, lens_filter: str | None, focal_length_mm: float | None) -> tuple[Calibration | None, list[str]]:
    """The newest calibration of this camera, lens and filter, with notes on its use.

    Parts that were measured at another aperture or focal length are left out. Without `lens_filter`, the filter is
    the only one in the calibrations of this camera and lens; with several, none is used.

    Raises
    ------
    CaptureError
        A file in the folder is not a calibration.
    """
    camera = f"{exif.make} {exif.model}".strip()
    fitting = []
    for path in own_folders.calibration_files():
        found = read(path)
        if camera and found.camera == camera and (not found.lens or not exif.lens or found.lens == exif.lens):
            fitting.append((found, path))
    if not fitting:
        return None, []
    names = sorted({found.filter for found, _ in fitting})
    if lens_filter is None and len(names) > 1:
        listed = ", ".join(name or "(none)" for name in names)
        return None, [f"calibration: several filters are known ({listed}); state filter in capture.toml to use one"]
    wanted = names[0] if lens_filter is None else lens_filter
    of_filter = [pair for pair in fitting if pair[0].filter == wanted]
    if not of_filter:
        return None, [f'calibration: none of filter "{wanted}" for this camera and lens']
    found, path = max(of_filter, key=lambda pair: pair[0].made)
    notes = [f"calibration {path.name}: {', '.join(_parts(found))}"]
    if found.falloff is not None and not _same_lens_setting(found, exif, focal_length_mm):
        found = replace(found, falloff=None)
        notes.append("calibration: the falloff was measured at another aperture or focal length and is not used")
    if found.geometry is not None and not _same_geometry(found.geometry, exif, focal_length_mm):
        found = replace(found, geometry=None)
        notes.append(
            "calibration: the lens was measured at another focal length or picture size; its geometry is not used"
        )
    return found, notes


def _same_geometry(geometry: LensGeometry, exif: Exif, focal_length_mm: float | None) -> bool:
    stated = focal_length_mm or exif.focal_length_mm
    alike = not stated or not geometry.focal_length_mm or abs(stated / geometry.focal_length_mm - 1) < 0.05
    return alike and geometry.size_px == (exif.width, exif.height)


def _same_lens_setting(found: Calibration, exif: Exif, focal_length_mm: float | None) -> bool:
    assert found.falloff is not None
    pairs = (
        (found.falloff.f_number, exif.f_number),
        (found.falloff.focal_length_mm, focal_length_mm or exif.focal_length_mm),
    )
    return all(not one or not other or abs(one / other - 1) < 0.05 for one, other in pairs)


def _parts(found: Calibration) -> list[str]:
    parts = []
    if found.noise:
        parts.append("noise at ISO " + ", ".join(f"{line.iso:g}" for line in found.noise))
    if found.falloff is not None:
        parts.append("falloff of the lens")
    if found.geometry is not None:
        lens = found.geometry
        parts.append(f"lens {lens.focal_px:.0f} ± {lens.focal_sigma_px:.1f} px, k1 {lens.k1:+.4f}, k2 {lens.k2:+.4f}")
    if found.polarizer is not None:
        ring = found.polarizer
        parts.append(f"polarizer {ring.zero_deg:+.2f}° ± {ring.zero_sigma_deg:.2f}°{', mirrored' * (ring.sense < 0)}")
    if found.flash is not None:
        parts.append(f"flash ± {100 * found.flash.spread:.2f} %")
    return parts


def _possible_parts(found: Calibration) -> dict[str, bool]:
    """For each part, whether its figures are physically possible."""
    ring, light, channels = found.polarizer, found.falloff, (1, 3)
    return {
        "noise": all(
            line.iso > 0
            and len(line.slope) == len(line.floor)
            and len(line.slope) in channels
            and _possible_noise(line.slope, line.floor)
            for line in found.noise
        ),
        "falloff": light is None
        or (len(light.coefficient) in channels and all(_lights_corners(one) for one in light.coefficient)),
        "geometry": found.geometry is None or _possible_lens(found.geometry),
        "polarizer": ring is None or (len(ring.extinction) in channels and _possible_ring(ring)),
        "flash": found.flash is None or 0 < found.flash.spread < 1,
    }


def _possible_noise(slope: tuple[float, ...], floor: tuple[float, ...]) -> bool:
    return min(slope) > 0 and max(slope) < 1 and min(floor) >= 0 and max(floor) < 1


def _possible_ring(ring: Polarizer) -> bool:
    angles = abs(ring.zero_deg) <= _FULL_TURN and 0 <= ring.zero_sigma_deg <= _FULL_TURN
    return ring.sense in (-1, 1) and min(ring.extinction) > 1 and angles


def _possible_lens(lens: LensGeometry) -> bool:
    """A principal point inside the picture, and a distortion that does not fold it over itself."""
    known = Distortion(lens.focal_px, lens.principal_px, lens.k1, lens.k2)
    inside = all(0 < c < side for c, side in zip(lens.principal_px, lens.size_px))
    small = max(lens.size_px) <= _MAX_SIDE and max(abs(lens.k1), abs(lens.k2)) <= _MAX_DISTORTION
    return lens.focal_px >= 1 and inside and small and not distortion.folds(known, *lens.size_px)


def _lights_corners(law: tuple[float, float, float]) -> bool:
    """Whether 1 + a r² + b r⁴ + c r⁶ stays positive up to the corners."""
    steps = [k / 16 for k in range(17)]
    return all(1 + r2 * (law[0] + r2 * (law[1] + r2 * law[2])) > _LEAST_LIGHT for r2 in steps)


def _bare(tree: Any) -> Any:
    """Plain data without None, which TOML cannot hold; numbers of eight digits."""
    if isinstance(tree, dict):
        return {key: _bare(value) for key, value in tree.items() if value is not None}
    if isinstance(tree, Sequence) and not isinstance(tree, str):
        return [_bare(value) for value in tree]
    return float(f"{tree:.8g}") if isinstance(tree, float) else tree


_Point = tuple[float, float]
_Quad = tuple[_Point, _Point, _Point, _Point]
_OfPatches = Meta(min_length=24, max_length=24)
_Finite = Annotated[float, Meta(ge=-1e9, le=1e9)]


class _Profile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The keys of a color profile, as of `ColorCalibration`."""

    matrix: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    source: Literal["chart", "corners", "profile", "camera", "none"]
    cost: float = float("nan")
    delta_e: Annotated[list[float], _OfPatches] | None = None
    metres_per_px: _Finite | None = None
    quads: Annotated[list[_Quad], _OfPatches] | None = None
    corners: _Quad | None = None
    falloff: tuple[_Finite, _Finite] = (0.0, 0.0)
    glare: _Finite = 0.0
    predicted: Annotated[list[float], _OfPatches] | None = None
    patch_use: Annotated[list[Annotated[int, Meta(ge=0, le=255)]], _OfPatches] | None = None


def write_profile(path: Path, color: ColorCalibration) -> None:
    """Write a color profile for other captures of the same camera, light and exposure; StorageError."""
    document: dict[str, Any] = {
        "matrix": _rounded(color.matrix, 9),
        "source": color.source,
        "cost": float(color.cost),
        "metres_per_px": color.metres_per_px,
    }
    if color.place is not None:
        document |= {"quads": _rounded(color.place.quads, 3), "corners": _rounded(color.place.corners, 3)}
    if (colors := color.patches) is not None:
        document |= {
            "delta_e": _rounded(colors.delta_e, 3),
            "falloff": list(colors.falloff),
            "glare": colors.glare,
            "predicted": _rounded(colors.predicted, 3),
            "patch_use": None if colors.use is None else colors.use.tolist(),
        }
    text = (
        "# polcap color profile. matrix: camera radiance (I0 + I90) -> linear Rec.709 reflectance.\n"
        "# quads, corners: px of the grid it was measured on. metres_per_px: at the chart's distance.\n"
    ) + tomli_w.dumps({key: value for key, value in document.items() if value is not None})
    with atomic.path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_profile(path: Path) -> ColorCalibration:
    """Read a file that `write_profile` wrote.

    Raises
    ------
    ChartError
        The file is missing, not a profile, or its matrix cannot be inverted.
    """
    document: dict[str, Any] = {}
    try:
        document = text_file.read_toml(path, finite=False)
        profile = msgspec.convert(document, _Profile)
    except OSError as error:
        raise ChartError(f"{path}: cannot be read ({error.strerror}); give a profile's path") from error
    except msgspec.ValidationError as error:
        fault = text_file.fault(error, document, _Profile)
        raise ChartError(f"{path}: not a polcap color profile ({fault}); write the profile again") from error
    except ValueError as error:
        raise ChartError(f"{path}: not a polcap color profile ({error}); write the profile again") from error
    matrix = np.array(profile.matrix)
    if not np.isfinite(matrix).all() or np.linalg.matrix_rank(matrix, rtol=1e-6) < 3:
        raise ChartError(f"{path}: its color matrix cannot be inverted; write the profile again")
    quads, corners, delta_e = (_array(one) for one in (profile.quads, profile.corners, profile.delta_e))
    use = None if profile.patch_use is None else np.array(profile.patch_use, np.uint8)
    return ColorCalibration(
        matrix=matrix,
        source=profile.source,
        cost=profile.cost,
        metres_per_px=profile.metres_per_px,
        place=None if quads is None or corners is None else ChartPlace(quads, corners),
        patches=None
        if delta_e is None
        else PatchColors(delta_e, use, _array(profile.predicted), profile.falloff, profile.glare),
    )


def _rounded(values: Floats | None, digits: int) -> Any:
    return None if values is None else np.round(np.asarray(values, np.float64), digits).tolist()


def _array(values: Any) -> Floats | None:
    return None if values is None else np.array(values, np.float64)
