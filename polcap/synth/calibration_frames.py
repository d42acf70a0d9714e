"""In: what a camera, lens, polarizer and flash are. Out: the photographs that calibrate them, and the truth beside.

The folder is as `polcap calibrate` reads it: dark/, flat/, flash/, lens/, polarizer/axis000/pol000/ …
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import CaptureError
from polcap.formats import atomic
from polcap.formats.capture import layouts
from polcap.formats.raw import dng
from polcap.images import Exif, Floats, View
from polcap.optics.color import REC709_TO_XYZ
from polcap.synth import boards, forward_camera, lens
from polcap.synth.forward_camera import Sensor

_CFA = np.array([[0, 1], [1, 2]], np.uint8)
_MATRIX = np.array([[0.87, -0.27, -0.075], [-0.44, 1.23, 0.235], [-0.09, 0.19, 0.69]])  # XYZ → camera
Extinction = Annotated[float, Meta(ge=1)]  # greatest over least transmittance
_TINT = np.array([0.8, 1.0, 0.7])  # of the light, in camera channels


class CalibrationShoot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The set-up, and how it is photographed."""

    seed: Annotated[int, Meta(ge=0)] = 0
    width: Annotated[int, Meta(ge=64, le=20000, multiple_of=2)] = 384  # visible RAW px
    height: Annotated[int, Meta(ge=64, le=20000, multiple_of=2)] = 256
    sensor: Sensor = Sensor()
    black_error: Annotated[float, Meta(ge=-1000, le=1000)] = 0.0  # counts, of the sensor's black over the stated one
    isos: tuple[Annotated[float, Meta(ge=1, le=1e6)], ...] = (100.0, 400.0)
    levels: tuple[Annotated[float, Meta(gt=0, le=10)], ...] = (0.05, 0.15, 0.4, 0.8)  # of white, in the middle of green
    power: Annotated[float, Meta(gt=0, le=10)] = 1.0  # of the exposure that the sensor follows; 1 is linear
    falloff: tuple[float, float, float] = (-0.25, 0.05, 0.0)  # of r², r⁴, r⁶; r = 1 in the corners
    slope: tuple[float, float] = (0.03, -0.02)  # of the flat surface's light, from the middle to the edge
    zero_deg: float = 1.7  # of the polarizer's ring
    sense: Literal[1, -1] = 1  # 1: the ring counts as the picture does
    extinction: tuple[Extinction, Extinction, Extinction] = (300.0, 500.0, 200.0)
    axes_deg: tuple[Annotated[float, Meta(ge=0, le=360)], ...] = (0.0, 30.0)  # of the polarized light
    ring_step_deg: Annotated[float, Meta(ge=1, le=180)] = 15.0
    ring_error_deg: Annotated[float, Meta(ge=0, le=90)] = 0.05  # 1σ of the ring's angle
    lamp_jitter: Annotated[float, Meta(ge=0, le=0.2)] = 0.0005  # 1σ of a steady lamp
    flash_jitter: Annotated[float, Meta(ge=0, le=0.2)] = 0.012  # 1σ of the flash
    pops: Annotated[int, Meta(ge=0, le=10000)] = 24
    boards: Annotated[int, Meta(ge=0, le=10000)] = 0  # photographs of a board from all sides
    board: Literal["checkerboard", "chart"] = "checkerboard"
    distortion: tuple[lens.Bend, lens.Bend] = (-0.12, 0.05)  # k1, k2, see synth/lens.py; only boards show it
    focal_mm: Annotated[float, Meta(ge=1, le=10000)] = 60.0  # on a sensor 36 mm wide

    @property
    def view(self) -> View:
        """The camera over its own RAW pixels."""
        return View(self.focal_mm / 36.0 * self.width, ((self.width - 1) / 2, (self.height - 1) / 2), scale=1)


def write(folder: Path, shoot: CalibrationShoot) -> None:
    """Photograph everything into `folder`, which is made; the same arguments give the same bytes.

    Raises
    ------
    CaptureError
        `folder` holds something already.
    StorageError
        It cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CaptureError(f"{folder} is not an empty folder; choose another place")
    with atomic.folder(folder) as place:
        for number, (name, radiance, iso, time, flash) in enumerate(_frames(shoot)):
            _photograph(place / name, shoot, radiance, iso, time, flash, number)
        with atomic.path(place / "truth.json") as temporary:
            temporary.write_bytes(msgspec.json.format(msgspec.json.encode(shoot), indent=1))


def _frames(shoot: CalibrationShoot) -> Iterator[tuple[str, Floats, float, float, bool]]:
    """Name, light (H, W, 3) at base sensitivity, ISO, exposure time [s] and whether a flash fired, of each frame."""
    random = np.random.default_rng([shoot.seed, 7])
    light, number = _surface(shoot), 0
    for iso in shoot.isos:
        amplification = iso / 100
        for _ in range(2):
            yield f"dark/IMG_{number:04d}.DNG", 0 * light, iso, 0.01, False
            number += 1
        for level in shoot.levels:
            for _ in range(2):
                jitter = 1 + shoot.lamp_jitter * random.normal()
                time = level / amplification * 0.1
                yield (
                    f"flat/IMG_{number:04d}.DNG",
                    light * (level**shoot.power / amplification * jitter),
                    iso,
                    time,
                    False,
                )
                number += 1
    for _ in range(shoot.pops):
        jitter = 1 + shoot.flash_jitter * random.normal()
        yield f"flash/IMG_{number:04d}.DNG", light * (0.5 * jitter), 100.0, 1 / 160, True
        number += 1
    for albedo in boards.pictures(
        shoot.view, shoot.distortion, (shoot.width, shoot.height), shoot.boards, shoot.board, shoot.seed
    ):
        yield f"lens/IMG_{number:04d}.DNG", albedo * (0.8 * _TINT), 100.0, 0.05, False
        number += 1
    contrast = (np.array(shoot.extinction) - 1) / (np.array(shoot.extinction) + 1)
    for axis in shoot.axes_deg:
        for ring in np.arange(0, 180, shoot.ring_step_deg):
            actual = shoot.sense * (ring + shoot.ring_error_deg * random.normal()) + shoot.zero_deg
            passed = 0.5 * (1 + contrast * np.cos(2 * np.radians(actual - axis)))
            jitter = 1 + shoot.lamp_jitter * random.normal()
            name = f"polarizer/axis{layouts.degrees(axis)}/pol{layouts.degrees(ring)}/IMG_{number:04d}.DNG"
            yield name, light * (0.8 * jitter) * passed, 100.0, 0.05, False
            number += 1


def _surface(shoot: CalibrationShoot) -> Floats:
    """An almost evenly lit surface through the lens, (H, W, 3), 1 in the middle of green."""
    y, x = np.mgrid[0 : shoot.height, 0 : shoot.width].astype(float)
    x, y = x - (shoot.width - 1) / 2, y - (shoot.height - 1) / 2
    half = np.hypot(shoot.width, shoot.height) / 2
    r2 = (x**2 + y**2) / half**2
    vignette = 1 + sum(a * r2 ** (k + 1) for k, a in enumerate(shoot.falloff))
    uneven = 1 + shoot.slope[0] * x / half + shoot.slope[1] * y / half
    return np.asarray((vignette * uneven)[..., None] * _TINT)


def _photograph(
    path: Path, shoot: CalibrationShoot, radiance: Floats, iso: float, time: float, flash: bool, number: int
) -> None:
    random = np.random.default_rng([shoot.seed, 8, number])
    mosaic = forward_camera.mosaic(radiance, _CFA)
    real = msgspec.structs.replace(shoot.sensor, black=shoot.sensor.black + shoot.black_error)
    counts = forward_camera.expose(mosaic, real, iso / 100, random)
    to_camera = _MATRIX @ REC709_TO_XYZ
    exif = Exif(
        make="Polcap",
        model="Synthetic",
        lens="Synthetic 60mm",
        exposure_time=time,
        f_number=11.0,
        iso=iso,
        focal_length_mm=shoot.focal_mm,
        taken="2026-03-14T12:00:00.000",
        flash_fired=flash,
    )
    dng.write(
        path,
        counts,
        cfa=_CFA,
        black=shoot.sensor.black,
        white=shoot.sensor.white,
        exif=exif,
        color_matrix=_MATRIX,
        as_shot_neutral=to_camera.sum(axis=1) / to_camera[1].sum(),
    )
