"""In: the user's folder of calibrations, dated TOML. Out: the newest that is of a capture's camera, lens and filter."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import tomli_w

from polcap.calibration_values import Calibration, LensGeometry, Polarizer
from polcap.errors import CaptureError
from polcap.formats import atomic, calibrations_folder, text_file
from polcap.images import Distortion, Exif
from polcap.optics import distortion

_FULL_TURN = 360.0  # degrees
_MOST_SIDE = 1_000_000  # px of a picture
_MOST_BENT = 1000.0  # of k1 and k2: a lens that folds nothing has less
_LEAST_LIGHT = 0.02  # of the middle's, in a lens's corner
_HEAD = """\
# polcap calibration. Signals: 1 is the sensor's white. Each sigma is 1σ. Angles from image x towards image up.
# noise: variance of a pixel of the merged picture (half size) = slope * signal + floor.
# geometry: what belongs at x appears at x (1 + k1 r^2 + k2 r^4), x and r from the principal point in focal lengths.
# falloff: light = 1 + a r^2 + b r^4 + c r^6, r = 1 in the corners. polarizer: axis = sense * stated + zero_deg.
"""


def write(place: Path, found: Calibration) -> Path:
    """A dated file in `place`, which is made; returns its path.

    Raises
    ------
    StorageError
        It cannot be written.
    """
    parts = [found.made[:19].replace(":", ""), found.camera, found.lens, found.filter]
    path = place / (atomic.safe_name(" ".join(part for part in parts if part)) + ".toml")
    with atomic.path(path) as temporary:
        temporary.write_text(text(found), encoding="utf-8")
    return path


def text(found: Calibration) -> str:
    """What `write` writes."""
    return _HEAD + tomli_w.dumps(_bare(msgspec.to_builtins(found)))


def read(path: Path) -> Calibration:
    """What `write` wrote.

    Raises
    ------
    CaptureError
        It is no such file, or cannot be read.
    """
    try:
        found = msgspec.convert(text_file.read_toml(path), Calibration)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be read ({error.strerror}); mend or remove it") from None
    except ValueError as error:
        raise CaptureError(f"{path}: no calibration of this polcap ({error}); calibrate again, or remove it") from None
    _check(path, found)
    return found


def choose(exif: Exif, lens_filter: str | None, focal_length_mm: float | None) -> tuple[Calibration | None, list[str]]:
    """The newest calibration of this camera and lens, and of this filter; with notes of what was taken or left.

    What another filter, aperture or focal length was measured with is left out. Without `lens_filter` the filter
    is the only one that this camera and lens were calibrated with, or none.

    Raises
    ------
    CaptureError
        A file in the folder that is no calibration.
    """
    camera = f"{exif.make} {exif.model}".strip()
    fitting = []
    for path in calibrations_folder.files():
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


def _check(path: Path, found: Calibration) -> None:
    """Figures that would spoil a capture."""
    wrong = [name for name, sound in _sound(found).items() if not sound]
    if wrong:
        raise CaptureError(f"{path}: its {', '.join(wrong)} is impossible; calibrate again, or remove the file")


def _sound(found: Calibration) -> dict[str, bool]:
    ring, light, channels = found.polarizer, found.falloff, (1, 3)
    return {
        "noise": all(
            line.iso > 0
            and len(line.slope) == len(line.floor)
            and len(line.slope) in channels
            and _sane(line.slope, line.floor)
            for line in found.noise
        ),
        "falloff": light is None
        or (len(light.coefficient) in channels and all(_positive(one) for one in light.coefficient)),
        "geometry": found.geometry is None or _possible(found.geometry),
        "polarizer": ring is None
        or (ring.sense in (-1, 1) and len(ring.extinction) in channels and min(ring.extinction) > 1 and _turn(ring)),
        "flash": found.flash is None or 0 < found.flash.spread < 1,
    }


def _sane(slope: tuple[float, ...], floor: tuple[float, ...]) -> bool:
    return min(slope) > 0 and max(slope) < 1 and min(floor) >= 0 and max(floor) < 1


def _turn(ring: Polarizer) -> bool:
    return abs(ring.zero_deg) <= _FULL_TURN and 0 <= ring.zero_sigma_deg <= _FULL_TURN


def _possible(lens: LensGeometry) -> bool:
    """A pinhole in front of its picture, whose lens folds nothing."""
    known = Distortion(lens.focal_px, lens.principal_px, lens.k1, lens.k2)
    inside = all(0 < c < side for c, side in zip(lens.principal_px, lens.size_px))
    small = max(lens.size_px) <= _MOST_SIDE and max(abs(lens.k1), abs(lens.k2)) <= _MOST_BENT
    return lens.focal_px >= 1 and inside and small and not distortion.folds(known, *lens.size_px)


def _positive(law: tuple[float, float, float]) -> bool:
    """1 + a r² + b r⁴ + c r⁶ leaves light everywhere."""
    steps = [k / 16 for k in range(17)]
    return all(1 + r2 * (law[0] + r2 * (law[1] + r2 * law[2])) > _LEAST_LIGHT for r2 in steps)


def _bare(tree: Any) -> Any:
    """Without None, which TOML does not know; numbers rounded to what a reader can use."""
    if isinstance(tree, dict):
        return {key: _bare(value) for key, value in tree.items() if value is not None}
    if isinstance(tree, Sequence) and not isinstance(tree, str):
        return [_bare(value) for value in tree]
    return float(f"{tree:.8g}") if isinstance(tree, float) else tree
