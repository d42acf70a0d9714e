"""Simulated calibration photographs of a camera, lens, polarizer and flash, with their true properties.

The folder has the layout that `polcap calibrate` reads: dark/, flat/, flash/, lens/, polarizer/axis000/pol000/ …
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap.capture_values import Exif
from polcap.formats import atomic
from polcap.formats.capture import folder_names
from polcap.image_values import Floats, View
from polcap.optics import frames
from polcap.synth import color_checker, forward_camera
from polcap.synth.color_checker import Chart
from polcap.synth.forward_camera import COLOR_MATRIX, Bend, Sensor

_CFA = np.array([[0, 1], [1, 2]], np.uint8)
Extinction = Annotated[float, Meta(ge=1)]  # largest over smallest transmittance
_TINT = np.array([0.8, 1.0, 0.7])  # of the light, in camera channels
_SAMPLES = 3  # rays per pixel side
_COLUMNS, _ROWS = 10, 7  # squares of the checkerboard
_WALL, _PAPER, _INK = 0.18, 0.85, 0.04  # albedos of the wall behind and of the checkerboard
_MOST_TILT_DEG = 35.0  # of a board
_FILLED = 0.6  # width of a board over that of the picture, at distance 1


class CalibrationShoot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The simulated equipment and the calibration photographs to take; users set the fields by name."""

    seed: Annotated[int, Meta(ge=0, description="of light, noise and errors")] = 0
    width: Annotated[int, Meta(ge=64, le=20000, multiple_of=2, description="width of the RAW [px]")] = 384
    height: Annotated[int, Meta(ge=64, le=20000, multiple_of=2, description="height of the RAW [px]")] = 256
    sensor: Sensor = Sensor()
    black_error: Annotated[
        float, Meta(ge=-1000, le=1000, description="counts, true black level minus the stated one")
    ] = 0.0
    isos: Annotated[tuple[Annotated[float, Meta(ge=1, le=1e6)], ...], Meta(description="ISO of the frames")] = (
        100.0,
        400.0,
    )
    levels: Annotated[
        tuple[Annotated[float, Meta(gt=0, le=10)], ...], Meta(description="green in the middle / white")
    ] = (0.05, 0.15, 0.4, 0.8)
    power: Annotated[float, Meta(gt=0, le=10, description="exponent of the sensor's response; 1 is linear")] = 1.0
    falloff: Annotated[
        tuple[float, float, float], Meta(description="factors of r², r⁴, r⁶ of the lens's light; r = 1 in the corners")
    ] = (-0.25, 0.05, 0.0)
    slope: Annotated[
        tuple[float, float], Meta(description="of the flat surface's light per half diagonal, right and down")
    ] = (0.03, -0.02)
    zero_deg: Annotated[float, Meta(description="zero error of the polarizer's ring [degrees]")] = 1.7
    sense: Annotated[
        Literal[1, -1], Meta(description="1: the ring counts from image x towards image up; −1: the other way")
    ] = 1
    extinction: Annotated[
        tuple[Extinction, Extinction, Extinction],
        Meta(description="extinction ratio of the polarizer in red, green and blue"),
    ] = (300.0, 500.0, 200.0)
    axes_deg: Annotated[
        tuple[Annotated[float, Meta(ge=0, le=360)], ...], Meta(description="axes of the polarized light")
    ] = (0.0, 30.0)
    ring_step_deg: Annotated[float, Meta(ge=1, le=180, description="between two positions of the ring [degrees]")] = (
        15.0
    )
    ring_error_deg: Annotated[float, Meta(ge=0, le=90, description="1σ of the ring's angle")] = 0.05
    lamp_jitter: Annotated[float, Meta(ge=0, le=0.2, description="1σ of a steady lamp, relative")] = 0.0005
    flash_jitter: Annotated[float, Meta(ge=0, le=0.2, description="1σ of the flash's energy, relative")] = 0.012
    pops: Annotated[int, Meta(ge=0, le=10000, description="photographs with flash")] = 24
    boards: Annotated[int, Meta(ge=0, le=10000, description="photographs of a board in random poses")] = 0
    board: Annotated[Literal["checkerboard", "chart"], Meta(description="pattern of the boards")] = "checkerboard"
    distortion: Annotated[
        tuple[Bend, Bend], Meta(description="k1 and k2 of the lens, in photographs of boards only")
    ] = (-0.12, 0.05)
    focal_mm: Annotated[float, Meta(ge=1, le=10000, description="focal length, on a sensor 36 mm wide [mm]")] = 60.0

    @property
    def view(self) -> View:
        return forward_camera.pinhole(self.focal_mm, self.width, self.height)


def write(folder: Path, shoot: CalibrationShoot) -> None:
    """Write simulated calibration photographs into a new folder; the same arguments give the same bytes.

    Raises CaptureError: the folder holds something already.
    """
    forward_camera.require_empty(folder)
    actual = msgspec.structs.replace(shoot.sensor, black=shoot.sensor.black + shoot.black_error)
    base = Exif(
        make="Polcap", model="Synthetic", lens="Synthetic 60mm", f_number=11.0, focal_length_mm=shoot.focal_mm,
        taken="2026-03-14T12:00:00.000",
    )  # fmt: skip
    with atomic.new_folder(folder) as place:
        for number, (name, radiance, iso, time) in enumerate(_photographs(shoot)):
            random = np.random.default_rng([shoot.seed, 8, number])
            counts = forward_camera.expose(forward_camera.mosaic(radiance, _CFA), actual, iso / 100, random)
            exif = replace(base, exposure_time=time, iso=iso, flash_fired=name == "flash")
            file = place / name / f"IMG_{number:04d}.DNG"
            forward_camera.write_dng(file, counts, shoot.sensor, _CFA, COLOR_MATRIX, exif)
        atomic.write_json(place / "truth.json", shoot)


def _photographs(shoot: CalibrationShoot) -> Iterator[tuple[str, Floats, float, float]]:
    """The simulated calibration photographs: folder, light (H, W, 3) at ISO 100, ISO and exposure time [s] of each.

    White is 1. Flash frames reach 0.5 of it in green; a white board, and light along the polarizer's axis, reach 0.8.
    """
    random = np.random.default_rng([shoot.seed, 7])
    light = _surface(shoot)
    for iso in shoot.isos:
        amplification = iso / 100
        for _ in range(2):
            yield "dark", 0 * light, iso, 0.01
        for level in np.repeat(shoot.levels, 2).tolist():
            jitter = 1 + shoot.lamp_jitter * random.normal()
            yield "flat", light * (level**shoot.power / amplification * jitter), iso, level / amplification * 0.1
    for _ in range(shoot.pops):
        yield "flash", light * (0.5 * (1 + shoot.flash_jitter * random.normal())), 100.0, 1 / 160
    for albedo in _boards(shoot):
        yield "lens", albedo * (0.8 * _TINT), 100.0, 0.05
    contrast = (np.array(shoot.extinction) - 1) / (np.array(shoot.extinction) + 1)
    for axis in shoot.axes_deg:
        for ring in np.arange(0, 180, shoot.ring_step_deg):
            actual = shoot.sense * (ring + shoot.ring_error_deg * random.normal()) + shoot.zero_deg
            passed = 0.5 * (1 + contrast * np.cos(2 * np.radians(actual - axis)))
            jitter = 1 + shoot.lamp_jitter * random.normal()
            name = f"polarizer/axis{folder_names.degrees(axis)}/pol{folder_names.degrees(ring)}"
            yield name, light * (0.8 * jitter) * passed, 100.0, 0.05


def _surface(shoot: CalibrationShoot) -> Floats:
    """Simulated light from an almost evenly lit surface (a flat frame), (H, W, 3); 1 for green in the middle."""
    y, x = np.mgrid[0 : shoot.height, 0 : shoot.width].astype(float)
    x, y = x - (shoot.width - 1) / 2, y - (shoot.height - 1) / 2
    half = np.hypot(shoot.width, shoot.height) / 2
    r2 = (x**2 + y**2) / half**2
    vignette = 1 + sum(factor * r2**power for power, factor in enumerate(shoot.falloff, 1))
    uneven = 1 + shoot.slope[0] * x / half + shoot.slope[1] * y / half
    return np.asarray((vignette * uneven)[..., None] * _TINT)


def _boards(shoot: CalibrationShoot) -> Iterator[Floats]:
    """Albedo (H, W, 3) of pictures of a checkerboard or chart in random poses, in front of a gray wall."""
    width, height, view, kind = shoot.width, shoot.height, shoot.view, shoot.board
    random = np.random.default_rng([shoot.seed, 9])
    across = width / view.focal  # of the picture, at distance 1
    pitch = _FILLED * across / (6 if kind == "chart" else _COLUMNS)
    for _ in range(shoot.boards):
        turn = random.uniform(-1, 1, 3) * (_MOST_TILT_DEG, _MOST_TILT_DEG, 15)
        share = random.uniform(-1, 1, 2) * (0.2, 0.16)
        center = np.array([share[0] * across, share[1] * height / view.focal, -1.0]) * random.uniform(0.85, 1.1)
        board = Chart(tuple(center.tolist()), tuple(turn.tolist()), pitch)
        total = np.zeros((height, width, 3))
        for x, y in forward_camera.pixel_samples(height, width, _SAMPLES):
            ray = frames.rays_at(view, *forward_camera.undistort(view, shoot.distortion, x, y)).reshape(-1, 3)
            total += _albedo(ray, board, kind).reshape(height, width, 3)
        yield total / _SAMPLES**2


def _albedo(ray: Floats, board: Chart, kind: str) -> Floats:
    """Albedo (P, 3) of the board or wall that rays (P, 3) hit; rays point from the surface to the lens."""
    out = np.full((len(ray), 3), _WALL)
    if kind == "chart":
        at, _, albedo = color_checker.intersect(board, ray)
        out[at] = albedo
        return out
    _, column, row = color_checker.meet_plane(board, ray)
    column, row = column + _COLUMNS / 2, row + _ROWS / 2
    out[(column > -0.5) & (column < _COLUMNS + 0.5) & (row > -0.5) & (row < _ROWS + 0.5)] = _PAPER
    on = (column > 0) & (column < _COLUMNS) & (row > 0) & (row < _ROWS)
    out[on & ((np.floor(column) + np.floor(row)) % 2 == 0)] = _INK
    return out
