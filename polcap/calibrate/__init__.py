"""Calibration of camera, lens, polarizer and flash from photographs of known targets.

::

    FOLDER/dark/                     the cap on the lens
    FOLDER/flat/                     an evenly lit white surface, out of focus, at least twice at every exposure
    FOLDER/bracket/                  exposures of any still scene, or such folders: noise at an ISO that flat/ lacks
    FOLDER/flash/                    one still scene many times, by the flash
    FOLDER/lens/                     a checkerboard or a ColorChecker, tilted to all sides, in all parts of the picture
    FOLDER/polarizer/axis000/pol000/ polarized light of a known axis (a second polarizer on a lamp, a screen)
                    /pol015/ …       through the filter at every angle of its ring; a second axis gives the sense

Every folder is optional. Each module measures one quantity:

    photon_transfer   noise, from flat frames
    bracket_noise     noise, from exposures of any scene
    sensor_levels     black and white level
    linearity         signal against exposure time
    lens_falloff      light falloff towards the corners
    lens_geometry     focal length and distortion
    polarizer_ring    extinction, zero and sense of the polarizer's ring
    flash_energy      spread and drift of the flash
"""

from pathlib import Path

from polcap.calibrate import (
    bracket_noise,
    flash_energy,
    lens_falloff,
    lens_geometry,
    linearity,
    photon_transfer,
    polarizer_ring,
    sensor_levels,
)
from polcap.calibrate.calibration_photographs import Photograph, angle_folders, photographs_in
from polcap.calibration_values import Calibration, NoiseLine
from polcap.errors import CaptureError

_FOLDERS = ("dark", "flat", "bracket", "flash", "lens", "polarizer")


def measure(
    folder: Path, made: str, lens_filter: str = "", axis_deg: float = 0.0, squares: tuple[int, int] = (9, 6)
) -> Calibration:
    """Measure every calibration quantity that the folder's photographs show.

    made : date and time, ISO 8601. lens_filter : the polarizer's name. axis_deg : axis of the light in
    `polarizer/pol…` if no `axis…` folder states it, from image x towards image up. squares : inner corners of the
    checkerboard in `lens/`.

    Raises CaptureError if the folder holds none of these folders, or photographs that do not show their quantity;
    DecodeError if a photograph cannot be read.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; give the one that holds {', '.join(_FOLDERS)}")
    folders = {name: folder / name for name in _FOLDERS if (folder / name).is_dir()}
    if not folders:
        raise CaptureError(f"{folder}: holds none of the folders {', '.join(_FOLDERS)}; see the page on calibration")
    dark, flat, flash, boards = (
        photographs_in(folders[name]) if name in folders else [] for name in ("dark", "flat", "flash", "lens")
    )
    ring_shots = _polarizer_shots(folders["polarizer"], axis_deg) if "polarizer" in folders else []
    brackets = bracket_noise.brackets(folders["bracket"]) if "bracket" in folders else []
    photographs = [*dark, *flat, *(shot for bracket in brackets for shot in bracket), *flash, *boards]
    photographs += [shot.photograph for shot in ring_shots]
    _check_one_camera(photographs)
    exif = photographs[0].exif
    return Calibration(
        made=made,
        camera=exif.camera,
        lens=exif.lens,
        filter=lens_filter,
        noise=_noise(flat, dark, brackets),
        levels=sensor_levels.measure(dark, flat) if dark else None,
        linearity=linearity.measure(flat),
        falloff=lens_falloff.measure(flat) if flat else None,
        geometry=lens_geometry.measure(boards, squares) if boards else None,
        polarizer=polarizer_ring.measure(ring_shots) if ring_shots else None,
        flash=flash_energy.measure(flash) if flash else None,
    )


def _noise(flat: list[Photograph], dark: list[Photograph], brackets: list[list[Photograph]]) -> tuple[NoiseLine, ...]:
    """Noise line of each ISO from flat frames; from exposure brackets at an ISO without flat frames."""
    lines = {line.iso: line for line in bracket_noise.measure(brackets)} if brackets else {}
    lines |= {line.iso: line for line in photon_transfer.measure(flat, dark)}
    return tuple(lines[iso] for iso in sorted(lines))


def _polarizer_shots(folder: Path, axis_deg: float) -> list[polarizer_ring.PolarizerShot]:
    """The calibration photographs of `polarizer/`, each with the axis of the light and the angle of the ring, degrees.

    Folders polNNN give the ring's angle. Folders axisNNN around them give the axis of the light; without such folders
    it is `axis_deg`.
    """
    shots = [
        polarizer_ring.PolarizerShot(axis, ring, photograph)
        for axis, axis_folder in angle_folders(folder, "axis") or [(axis_deg, folder)]
        for ring, ring_folder in angle_folders(axis_folder, "pol")
        for photograph in photographs_in(ring_folder)
    ]
    if not shots:
        raise CaptureError(f"{folder}: holds no pol000, pol015, … with a photograph of each angle of the ring")
    return shots


def _check_one_camera(photographs: list[Photograph]) -> None:
    """Raise CaptureError if the photographs are of several cameras or lenses."""
    first = photographs[0]
    for other in photographs:
        for tag in ("make", "model", "lens"):
            expected, found = getattr(first.exif, tag), getattr(other.exif, tag)
            if expected and found and expected != found:
                raise CaptureError(
                    f"{other.path}: was taken with {found}, {first.path.name} with {expected}; "
                    "calibrate one set-up at a time"
                )
