"""In: photographs of what is known. Out: what the camera, the lens, the polarizer and the flash are in fact.

::

    FOLDER/dark/                     the cap on the lens
    FOLDER/flat/                     an evenly lit white surface, out of focus, twice at least at every exposure
    FOLDER/bracket/                  exposures of any still scene, or such folders: noise where flat/ has no such ISO
    FOLDER/flash/                    one and the same thing, again and again, by the flash
    FOLDER/lens/                     a checkerboard or a ColorChecker, tilted to all sides, all over the picture
    FOLDER/polarizer/axis000/pol000/ polarized light of a known axis (a second polarizer before a lamp, a screen)
                    /pol015/ …       through the filter at every angle of its ring; a second axis tells its sense

Each is optional, each quantity a file: `photon_transfer` and `bracket_noise` noise, `levels` black and white,
`linearity`, `lens_falloff`, `lens_geometry` focal length and distortion, `polarizer` extinction, zero and sense of the
ring, `flash_energy`.
"""

from pathlib import Path

from polcap.calibrate import (
    bracket_noise,
    flash_energy,
    lens_falloff,
    lens_geometry,
    levels,
    linearity,
    photon_transfer,
    polarizer,
)
from polcap.calibrate.photographs import Photograph, angle_of, inside, listed
from polcap.errors import CaptureError
from polcap.images import Calibration, NoiseLine, Polarizer

_ROOMS = ("dark", "flat", "bracket", "flash", "lens", "polarizer")


def measure(
    folder: Path, made: str, lens_filter: str = "", axis_deg: float = 0.0, squares: tuple[int, int] = (9, 6)
) -> Calibration:
    """All that the folder's photographs tell.

    made : date and time, ISO 8601. lens_filter : the polarizer's name. axis_deg : of polarized light in
    `polarizer/pol…`, where no `axis…` folder states it; from image x towards image up. squares : inner corners of the
    checkerboard in `lens/`.

    Raises
    ------
    CaptureError
        The folder holds none of the rooms, or photographs that do not tell what their room is for.
    DecodeError
        A photograph that cannot be read.
    """
    if not folder.is_dir():
        raise CaptureError(f"{folder}: no such folder; give the one that holds {', '.join(_ROOMS)}")
    rooms = {name: folder / name for name in _ROOMS if (folder / name).is_dir()}
    if not rooms:
        raise CaptureError(f"{folder}: holds none of the folders {', '.join(_ROOMS)}; see the page on calibration")
    dark = listed(rooms["dark"]) if "dark" in rooms else []
    flat = listed(rooms["flat"]) if "flat" in rooms else []
    flash = listed(rooms["flash"]) if "flash" in rooms else []
    turned = _turned(rooms["polarizer"], axis_deg) if "polarizer" in rooms else []
    stepped = bracket_noise.brackets(rooms["bracket"]) if "bracket" in rooms else []
    boards = listed(rooms["lens"]) if "lens" in rooms else []
    every = [*dark, *flat, *(shot for one in stepped for shot in one), *flash, *boards]
    every += [shot.photograph for shot in turned]
    first = every[0]
    _check_one_camera(every)
    return Calibration(
        made=made,
        camera=f"{first.exif.make} {first.exif.model}".strip(),
        lens=first.exif.lens,
        filter=lens_filter,
        noise=_noise(flat, dark, stepped),
        levels=levels.measure(dark, flat) if dark else None,
        linearity=linearity.measure(flat),
        falloff=lens_falloff.measure(flat) if flat else None,
        geometry=lens_geometry.measure(boards, squares) if boards else None,
        polarizer=_polarizer(turned),
        flash=flash_energy.measure(flash) if flash else None,
    )


def _noise(flat: list[Photograph], dark: list[Photograph], stepped: list[list[Photograph]]) -> tuple[NoiseLine, ...]:
    """By flat frames; at an ISO that has none by brackets."""
    lines = photon_transfer.measure(flat, dark)
    if not stepped:
        return lines
    known = {line.iso for line in lines}
    others = [line for line in bracket_noise.measure(stepped) if line.iso not in known]
    return tuple(sorted((*lines, *others), key=lambda line: line.iso))


def _turned(folder: Path, axis_deg: float) -> list[polarizer.Turned]:
    """The shots of `polarizer/`, by axis and ring angle."""
    axes = inside(folder, "axis")
    if not axes:
        axes = [(axis_deg, folder)]
    found = []
    for axis, place in axes:
        for ring, shots in inside(place, "pol"):
            found += [polarizer.Turned(axis, ring, photograph) for photograph in listed(shots)]
    if not found:
        raise CaptureError(f"{folder}: holds no pol000, pol015, … with a photograph of each angle of the ring")
    return found


def _polarizer(turned: list[polarizer.Turned]) -> Polarizer | None:
    return polarizer.measure(turned) if turned else None


def _check_one_camera(photographs: list[Photograph]) -> None:
    first = photographs[0]
    for other in photographs:
        for what in ("make", "model", "lens"):
            mine, theirs = getattr(first.exif, what), getattr(other.exif, what)
            if mine and theirs and mine != theirs:
                raise CaptureError(
                    f"{other.path}: was taken with {theirs}, {first.path.name} with {mine}; "
                    "calibrate one set-up at a time"
                )


__all__ = ["angle_of", "measure"]
