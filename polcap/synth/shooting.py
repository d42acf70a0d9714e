"""A scene and a way of shooting it -> a capture folder: DNG brackets per polarizer angle, and the truth beside.

::

    FOLDER/pol000/IMG_0001.DNG …   what `formats/capture/reader.py` reads
    FOLDER/cross000/IMG_0010.DNG … with `cross`: under a flash polarized across the filter
    FOLDER/truth.json              scene, shoot, and what was done to every file
    FOLDER/truth.npz               maps at the pixel centres of the first angle's shots
"""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from math import sqrt
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from polcap.errors import CaptureError
from polcap.formats import atomic
from polcap.formats.capture import layouts
from polcap.formats.raw import dng
from polcap.images import Exif, Floats, GBuffer, View
from polcap.optics import projection
from polcap.optics.color import REC709_TO_XYZ
from polcap.synth import color_checker as charts
from polcap.synth import forward_camera, lens, render, scene_materials
from polcap.synth.forward_camera import Sensor
from polcap.synth.render import Scene, Seen
from polcap.synth.scenes import Kind, random_scene

__all__ = ["MIDDLE_S", "Kind", "Scene", "Shoot", "Studio", "Take", "random_scene", "transform", "write"]

Angle = Annotated[float, Meta(ge=0, le=360)]  # degrees, as folders are named by
MIDDLE_S = 0.02  # exposure time of the middle frame of a bracket by time
_SENSOR_MM = 36.0  # width
_CFA = {
    "RGGB": [[0, 1], [1, 2]],
    "BGGR": [[2, 1], [1, 0]],
    "GRBG": [[1, 0], [2, 1]],
    "GBRG": [[1, 2], [0, 1]],
    "X-Trans": [[1, 2, 1, 1, 0, 1], [0, 1, 0, 2, 1, 2], [1, 2, 1, 1, 0, 1],
                [1, 0, 1, 1, 2, 1], [2, 1, 2, 0, 1, 0], [1, 0, 1, 1, 2, 1]],
}  # fmt: skip
_CONVENTIONS = (
    "pixel (i, j) of the visible RAW has its centre at column i, row j; camera at the origin, x right, y up, "
    "z towards the camera; depth = -z [m]; polarizer and AoLP angles from image x towards image up; "
    "transform: reference RAW px (x, y, 1) -> px of this file; px and maps are a pinhole's, before the lens; "
    "S in linear Rec.709 in the frame of each ray, S0 of the chart's white patch = its reference; specular = F0; "
    "roughness = sqrt(GGX alpha)"
)


class Shoot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera, the polarizer and the photographer's hand."""

    seed: Annotated[int, Meta(ge=0)] = 0
    width: Annotated[int, Meta(ge=64, le=20000, multiple_of=2)] = 1152  # visible RAW px
    height: Annotated[int, Meta(ge=64, le=20000, multiple_of=2)] = 864
    focal_mm: Annotated[float, Meta(ge=1, le=10000)] = 60.0  # on a sensor 36 mm wide
    angles_deg: Annotated[tuple[Angle, ...], Meta(min_length=1)] = (0.0, 45.0, 90.0)  # nominal
    exposures: Annotated[int, Meta(ge=1, le=9)] = 3
    step: Annotated[float, Meta(gt=1, le=1000)] = 4.0  # from one exposure to the next
    exposure_factor: Annotated[float, Meta(gt=0, le=1000)] = 1.0  # on what suits the scene; more clips gloss
    bracket: Literal["time", "aperture", "iso", "flash"] = "time"  # time: steady light, else a flash fired
    gain_jitter: Annotated[float, Meta(ge=0, le=0.2)] = 0.01  # 1σ of the light's energy from frame to frame, relative
    nudge_px: Annotated[float, Meta(ge=0, le=1000)] = 1.5  # the camera moves by up to this between angles
    nudge_deg: Annotated[float, Meta(ge=0, le=45)] = 0.05  # and rolls by up to this
    angle_error_deg: Annotated[float, Meta(ge=0, le=90)] = 0.5  # 1σ of the polarizer's angle
    extinction_ratio: Annotated[float, Meta(ge=1)] = 1000.0
    cross: bool = False  # one shot more, the flash polarized across the filter at the first angle
    flash_extinction: Annotated[float, Meta(ge=1)] = 1000.0  # extinction ratio of the flash's film
    distortion: tuple[lens.Bend, lens.Bend] = (0.0, 0.0)  # k1, k2 of the lens, see synth/lens.py
    blur_px: Annotated[float, Meta(ge=0, le=50)] = 0.4  # 1σ of the lens's point spread
    samples: Annotated[int, Meta(ge=1, le=4)] = 2  # rays per pixel side
    sensor: Sensor = Sensor()
    cfa: Literal["RGGB", "BGGR", "GRBG", "GBRG", "X-Trans"] = "RGGB"
    color_matrix: Annotated[tuple[float, ...], Meta(min_length=9, max_length=9)] = (
        0.87, -0.27, -0.075, -0.44, 1.23, 0.235, -0.09, 0.19, 0.69,
    )  # XYZ → camera  # fmt: skip

    @property
    def view(self) -> View:
        """The camera over its own RAW pixels."""
        center = (self.width - 1) / 2, (self.height - 1) / 2
        return View(self.focal_mm / _SENSOR_MM * self.width, center, scale=1)


def write(folder: Path, scene: Scene, shoot: Shoot, frame_written: Callable[[int, int], None] | None = None) -> None:
    """Photograph `scene` into `folder`, which is made; the same arguments give the same bytes.

    `frame_written` is told how many of how many photographs are there.

    Raises
    ------
    CaptureError
        `folder` holds something already.
    StorageError
        It cannot be written; then nothing is left of it.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CaptureError(f"{folder} is not an empty folder; choose another place for the capture")
    studio = Studio(scene, shoot)
    with atomic.folder(folder) as place:
        files = []
        for shot, angle in enumerate(shoot.angles_deg):
            pose = _pose(shoot, shot)
            radiance = studio.radiance(pose, first=shot == 0)
            for frame in range(shoot.exposures):
                name = f"pol{layouts.degrees(angle)}/IMG_{shot * shoot.exposures + frame + 1:04d}.DNG"
                done = studio.photograph(place / name, radiance, Take(shot, frame, _stops(shoot, frame)))
                files.append({"file": name, "nominal_deg": angle, **pose, **done})
                if frame_written is not None:
                    frame_written(len(files), len(shoot.angles_deg) * shoot.exposures)
        if shoot.cross:
            shot = len(shoot.angles_deg)
            pose = _pose(shoot, shot)
            radiance = studio.crossed(pose)
            for frame in range(shoot.exposures):
                name = f"cross{layouts.degrees(shoot.angles_deg[0])}/IMG_{shot * shoot.exposures + frame + 1:04d}.DNG"
                done = studio.photograph(place / name, radiance, Take(shot, frame, _stops(shoot, frame)))
                files.append({"file": name, "nominal_deg": shoot.angles_deg[0], **pose, **done})
        _write_truth(place, scene, shoot, studio.buffer, studio.reference, studio.to_camera, files)


@dataclass(frozen=True)
class Take:
    """Which photograph of a capture; each has noise and a time stamp of its own."""

    shot: int
    frame: int  # within the bracket
    stops: float  # exposure relative to the middle frame's, as a factor
    again: int = 0  # how often it was taken before
    lit: bool = True  # False: with the light off


class Studio:
    """A scene before the camera, lit: what `write` photographs, and the simulated rig."""

    def __init__(self, scene: Scene, shoot: Shoot) -> None:
        self.scene, self.shoot = scene, shoot
        self.buffer = render.gbuffer(scene, shoot.view, shoot.height, shoot.width)
        self.to_camera = _to_camera(shoot)
        self.reference = _light(scene, shoot, self.buffer, np.eye(3))
        self.middle = _middle_exposure(scene, shoot, self.buffer, self.reference[0] @ self.to_camera.T)

    def through(self, angle_deg: float) -> Floats:
        """What the polarizer at this angle passes to a camera that stands still, (H, W, 3) camera channels."""
        return self.radiance(_still(angle_deg), first=True)

    def crossed_at(self, angle_deg: float) -> Floats:
        """The same with the flash's filter on, across the first angle."""
        return self.crossed(_still(angle_deg))

    def radiance(self, pose: dict[str, Any], first: bool) -> Floats:
        """The same for a camera moved to `pose`; the `first` shot defines where it stood."""
        passed = _passed(self.scene, self.shoot, self.buffer, pose, self.reference if first else None)
        return np.asarray(passed @ self.to_camera.T)

    def crossed(self, pose: dict[str, Any]) -> Floats:
        """The same under a flash polarized across the filter at the first angle; its film takes half the light."""
        shoot = self.shoot
        axis = np.radians(shoot.angles_deg[0] + 90.0)
        back = np.linalg.inv(np.array(pose["transform"]))
        whole, along = (_light(self.scene, shoot, self.buffer, back, one) for one in (None, axis))
        kept = (shoot.flash_extinction - 1) / (shoot.flash_extinction + 1)
        lit = 0.5 * (kept * along + (1 - kept) * whole)
        return np.asarray(_passed(self.scene, shoot, self.buffer, pose, lit) @ self.to_camera.T)

    def photograph(self, path: Path, radiance: Floats, take: Take) -> dict[str, Any]:
        """One DNG of `radiance` (H, W, 3), and what was done to it. Raises StorageError."""
        return _write_frame(path, self.shoot, self.to_camera, radiance, take, self.middle, self.buffer.mask)


def transform(shoot: Shoot, shift_px: tuple[float, float], rot_deg: float) -> Floats:
    """Reference RAW px (x, y, 1) -> RAW px of a shot, (3, 3).

    The picture is rolled by `rot_deg`, counter-clockwise as seen, about the principal point and moved by `shift_px`
    (right, down).
    """
    c, s = np.cos(np.radians(rot_deg)), np.sin(np.radians(rot_deg))
    roll = np.array([[c, s], [-s, c]])  # rows run down, so counter-clockwise is the transpose
    center = np.array(shoot.view.center)
    out = np.eye(3)
    out[:2, :2] = roll
    out[:2, 2] = center + shift_px - roll @ center
    return out


def _still(angle_deg: float) -> dict[str, Any]:
    """A camera that did not move, its polarizer at this angle."""
    return {"actual_deg": angle_deg, "rot_deg": 0.0, "transform": np.eye(3).tolist()}


def _pose(shoot: Shoot, shot: int) -> dict[str, Any]:
    """What the hand did to the camera and to the polarizer before one shot; the first defines the frame."""
    random = np.random.default_rng([shoot.seed, 0, shot])
    x, y, roll = (random.uniform(-1, 1, 3) if shot else np.zeros(3)).tolist()
    shift = x * shoot.nudge_px, y * shoot.nudge_px
    roll *= shoot.nudge_deg
    nominal = shoot.angles_deg[shot % len(shoot.angles_deg)]  # past the last: the crossed shot, at the first
    actual = nominal + shoot.angle_error_deg * random.normal()
    return {
        "actual_deg": float(actual),
        "shift_px": shift,
        "rot_deg": roll,
        "transform": transform(shoot, shift, roll).tolist(),
    }


def _passed(scene: Scene, shoot: Shoot, buffer: GBuffer, pose: dict[str, Any], reference: Floats | None) -> Floats:
    """What one shot's polarizer passes, (H, W, 3) linear Rec.709; `reference`, where known, is the shot's light.

    A camera that rolls turns its polarizer too.
    """
    back = np.linalg.inv(np.array(pose["transform"]))
    stokes = _light(scene, shoot, buffer, back) if reference is None else reference
    y, x = np.mgrid[: shoot.height, : shoot.width].astype(np.float64)
    v = render.view_rays(shoot.view, *_looked_at(shoot, back, x, y))
    angle = np.radians(pose["actual_deg"] - pose["rot_deg"])
    passed = render.polarize(stokes, v, angle, shoot.extinction_ratio)
    return _blurred(shoot, passed)


def _light(scene: Scene, shoot: Shoot, buffer: GBuffer, back: Floats, flash_axis: float | None = None) -> Floats:
    """Mean Stokes parameters over each pixel's square, (3, H, W, 3).

    `back` (3, 3) takes the pixels to the reference shot's, where the scene stands still.
    """
    y, x = np.mgrid[: shoot.height, : shoot.width].astype(np.float64)
    start = render.guide(buffer)
    offsets = (np.arange(shoot.samples) + 0.5) / shoot.samples - 0.5
    total = np.zeros((3, shoot.height, shoot.width, 3), np.float32)
    for dy in offsets:
        for dx in offsets:
            total += render.stokes(scene, shoot.view, *_looked_at(shoot, back, x + dx, y + dy), start, flash_axis)
    return total / shoot.samples**2


def _looked_at(shoot: Shoot, back: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Pixels of the reference shot's pinhole that a shot's pixels show: through the lens, then back where it moved."""
    return _moved(back, *lens.looked_at(shoot.view, shoot.distortion, x, y))


def _moved(matrix: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    a, b = matrix[:2]
    return a[0] * x + a[1] * y + a[2], b[0] * x + b[1] * y + b[2]


def _blurred(shoot: Shoot, image: Floats) -> Floats:
    """Through the lens, (..., H, W, C)."""
    return np.asarray(gaussian_filter(image, shoot.blur_px, axes=(-3, -2))) if shoot.blur_px else image


def _to_camera(shoot: Shoot) -> Floats:
    """Linear Rec.709 → camera (3, 3), green of white = 1."""
    matrix = np.reshape(shoot.color_matrix, (3, 3)) @ REC709_TO_XYZ
    return np.asarray(matrix / matrix[1].sum())


def _middle_exposure(scene: Scene, shoot: Shoot, buffer: GBuffer, s0: Floats) -> float:
    """Exposure of the middle frame, for s0 (H, W, 3) in camera channels.

    Most of the object and the white patch stand at 0.35 of the white level there, and all but the sharpest highlights
    below it in the darkest frame.
    """
    bright = s0[buffer.mask].max(axis=-1) / 2
    if not bright.size:
        raise CaptureError("the object is outside the picture; move scene.position towards (0, 0, -0.7)")
    level = float(np.percentile(bright, 90))
    peak = float(np.percentile(bright, 99.9))
    if scene.chart is not None:
        white = render.white_level(scene) / 2
        level, peak = max(level, white), max(peak, white)
    return shoot.exposure_factor * min(0.35 / level, 0.95 / peak * shoot.step ** (shoot.exposures // 2))


def _stops(shoot: Shoot, frame: int) -> float:
    """Exposure of a frame of the bracket, times the middle one's."""
    return float(shoot.step ** (frame - shoot.exposures // 2))


def _write_frame(
    path: Path,
    shoot: Shoot,
    to_camera: Floats,
    radiance: Floats,
    take: Take,
    middle: float,
    mask: NDArray[np.bool_],
) -> dict[str, Any]:
    exif, light, amplification = _setting(shoot, take, middle)
    light *= take.lit
    random = np.random.default_rng([shoot.seed, 1 + take.shot, take.frame, *(() if not take.again else (take.again,))])
    energy = float(1 + shoot.gain_jitter * random.normal())
    cfa = np.array(_CFA[shoot.cfa], np.uint8)
    mosaic = forward_camera.mosaic(radiance, cfa) * (light * energy)
    counts = forward_camera.expose(mosaic, shoot.sensor, amplification, random)
    dng.write(
        path,
        counts,
        cfa=cfa,
        black=shoot.sensor.black,
        white=shoot.sensor.white,
        exif=exif,
        color_matrix=np.reshape(shoot.color_matrix, (3, 3)),
        as_shot_neutral=to_camera.sum(axis=1),
    )
    return {
        "exposure_index": take.frame,
        "time": exif.exposure_time,
        "fnumber": exif.f_number,
        "iso": exif.iso,
        "relative_exposure": light * amplification,
        "flash_factor": energy,
        "clipped_fraction_object": float((counts[mask] >= shoot.sensor.white).mean()),
        "time_stamp": exif.taken,
    }


def _setting(shoot: Shoot, take: Take, middle: float) -> tuple[Exif, float, float]:
    """What the camera writes about a frame, the light it gets and its amplification."""
    stops, number = take.stops, take.shot * shoot.exposures + take.frame
    taken = datetime(2026, 3, 14, 12) + timedelta(seconds=4.25 * number + 20 * (number // shoot.exposures))
    exif: dict[str, Any] = {
        "make": "Polcap",
        "model": "Synthetic",
        "lens": f"Synthetic {shoot.focal_mm:g}mm",
        "exposure_time": 1 / 160,
        "f_number": 11.0,
        "iso": 100.0,
        "focal_length_mm": shoot.focal_mm,
        "focal_length_35mm": shoot.focal_mm,
        "pixel_pitch_um": 1000 * _SENSOR_MM / shoot.width,
        "taken": taken.isoformat(timespec="milliseconds"),
        "flash_fired": shoot.bracket != "time" and take.lit,
    }
    light, amplification = middle * stops, 1.0
    if shoot.bracket == "time":
        exif["exposure_time"] = MIDDLE_S * stops
    elif shoot.bracket == "aperture":
        exif["f_number"] = round(11.0 / sqrt(stops), 1)
    elif shoot.bracket == "iso":
        amplification = shoot.step**take.frame
        light = middle / shoot.step ** (shoot.exposures // 2)
        exif["iso"] = 100.0 * amplification
    return Exif(**exif), light, amplification


def _write_truth(
    place: Path,
    scene: Scene,
    shoot: Shoot,
    buffer: Seen,
    reference: Floats,
    to_camera: Floats,
    files: list[dict[str, Any]],
) -> None:
    view, white = shoot.view, render.white_level(scene)
    chart = scene.chart and {
        "corners_px": projection.project(view, charts.corners(scene.chart)).tolist(),
        "patch_corners_px": projection.project(view, charts.patches(scene.chart)).tolist(),
        "size_m": scene.chart.size_m,
    }
    document = {
        "conventions": _CONVENTIONS,
        "focal_px": view.focal,
        "principal_px": view.center,
        "camera_matrix_from_linear_srgb": to_camera.tolist(),
        "white_S0": white,
        "chart": chart,
        "files": files,
        "scene": msgspec.to_builtins(scene),
        "shoot": msgspec.to_builtins(shoot),
    }
    with atomic.path(place / "truth.json") as temporary:
        temporary.write_bytes(msgspec.json.format(msgspec.json.encode(document), indent=1))

    if any(shoot.distortion):  # truth is a pinhole's
        reference = _light(scene, msgspec.structs.replace(shoot, distortion=(0.0, 0.0)), buffer, np.eye(3))
    diffuse, specular, roughness, ior = scene_materials.evaluate(scene.coat, buffer.position, buffer.facing)
    mask = buffer.mask
    with atomic.path(place / "truth.npz") as temporary:
        np.savez_compressed(
            temporary,
            normal=buffer.normal.astype(np.float16),
            depth=buffer.depth,
            mask=mask,
            diffuse=(diffuse * mask[..., None]).astype(np.float16),
            specular=(specular * mask[..., None]).astype(np.float16),
            roughness=(roughness * mask).astype(np.float16),
            ior=(ior * mask).astype(np.float16),
            S=(_blurred(shoot, reference) / white * mask[..., None]).astype(np.float16),
        )
