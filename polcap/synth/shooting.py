"""Simulated capture: photographs a synthetic scene into a folder of DNG brackets, with the true maps.

::

    FOLDER/pol000/IMG_0001.DNG …   one bracket per polarizer angle
    FOLDER/cross000/IMG_0010.DNG … with `cross`: flash and lens polarized at right angles
    FOLDER/truth.json              scene, camera, and exposure and pose of every file
    FOLDER/truth.npz               true maps on the pixels of the first angle
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timedelta
from math import sqrt
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from scipy.ndimage import gaussian_filter

from polcap.capture_values import Exif
from polcap.errors import CaptureError
from polcap.formats import atomic
from polcap.formats.capture import folder_names
from polcap.image_values import Floats, View
from polcap.optics import frames, mueller, projection
from polcap.optics.mesh_tracer import GBuffer
from polcap.synth import color_checker as charts
from polcap.synth import forward_camera, render, scene_materials
from polcap.synth.forward_camera import COLOR_MATRIX, SENSOR_WIDTH_MM, Bend, Sensor
from polcap.synth.render import Scene

Angle = Annotated[float, Meta(ge=0, le=360)]  # degrees, as in folder names
MIDDLE_S = 0.02  # s, exposure time of the middle frame of a time bracket
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
    """The simulated camera, polarizer and errors of the photographer; users set the fields by name."""

    seed: Annotated[int, Meta(ge=0, description="of light, noise and errors")] = 0
    width: Annotated[int, Meta(ge=64, le=20000, multiple_of=2, description="width of the RAW [px]")] = 1152
    height: Annotated[int, Meta(ge=64, le=20000, multiple_of=2, description="height of the RAW [px]")] = 864
    focal_mm: Annotated[float, Meta(ge=1, le=10000, description="focal length, on a sensor 36 mm wide [mm]")] = 60.0
    angles_deg: Annotated[
        tuple[Angle, ...],
        Meta(
            min_length=1, description="stated polarizer angles, 0 to 360, counter-clockwise; write -45 as 135 [degrees]"
        ),
    ] = (0.0, 45.0, 90.0)
    exposures: Annotated[int, Meta(ge=1, le=9, description="frames of a bracket")] = 3
    step: Annotated[float, Meta(gt=1, le=1000, description="exposure ratio of neighboring frames")] = 4.0
    exposure_factor: Annotated[
        float, Meta(gt=0, le=1000, description="on the automatic exposure; above 1 highlights clip")
    ] = 1.0
    bracket: Annotated[
        Literal["time", "aperture", "iso", "flash"],
        Meta(description="what differs between the frames; time: steady light, others: a flash"),
    ] = "time"
    gain_jitter: Annotated[
        float, Meta(ge=0, le=0.2, description="1σ of the light's energy from frame to frame, relative")
    ] = 0.01
    nudge_px: Annotated[float, Meta(ge=0, le=1000, description="largest camera shift between angles")] = 1.5
    nudge_deg: Annotated[float, Meta(ge=0, le=45, description="largest camera roll between angles")] = 0.05
    angle_error_deg: Annotated[float, Meta(ge=0, le=90, description="1σ of the polarizer's true angle")] = 0.5
    extinction_ratio: Annotated[float, Meta(ge=1, description="of the polarizer on the lens")] = 1000.0
    cross: Annotated[
        bool, Meta(description="one more shot, its flash polarized at right angles to the first angle")
    ] = False
    flash_extinction: Annotated[float, Meta(ge=1, description="extinction ratio of the flash's polarizer")] = 1000.0
    distortion: Annotated[tuple[Bend, Bend], Meta(description="k1 and k2 of the lens")] = (0.0, 0.0)
    blur_px: Annotated[float, Meta(ge=0, le=50, description="1σ of the lens's point spread")] = 0.4
    samples: Annotated[int, Meta(ge=1, le=4, description="rays per pixel side")] = 2
    sensor: Sensor = Sensor()
    cfa: Annotated[
        Literal["RGGB", "BGGR", "GRBG", "GBRG", "X-Trans"], Meta(description="pattern of the color filters")
    ] = "RGGB"
    color_matrix: Annotated[
        tuple[float, ...],
        Meta(
            min_length=9, max_length=9, description="from the scene's XYZ to the camera's colors, nine numbers by rows"
        ),
    ] = COLOR_MATRIX

    @property
    def view(self) -> View:
        return forward_camera.pinhole(self.focal_mm, self.width, self.height)


def write(folder: Path, scene: Scene, shoot: Shoot, frame_written: Callable[[int, int], None] | None = None) -> None:
    """Write a simulated capture of `scene` into a new folder; the same arguments give the same bytes.

    `frame_written` is called with the number of photographs written so far and in all.

    Raises CaptureError: the folder holds something already. StorageError: the folder cannot be written; then it is
    removed.
    """
    forward_camera.require_empty(folder)
    write_capture(folder, Studio(scene, shoot), frame_written)


def write_views(
    folder: Path,
    scenes: Mapping[str, Scene],
    shoot: Shoot,
    energies: Sequence[float],
    frame_written: Callable[[int, int], None] | None,
) -> None:
    """Write a capture of each scene into the subfolder of its name; all have the exposure of the first.

    `energies` are factors on the light of each scene; `frame_written` is as in `write`, over all captures.
    """
    frames, middle = shoot.exposures * (len(shoot.angles_deg) + shoot.cross), None
    for k, (name, scene) in enumerate(scenes.items()):

        def report(written: int, _: int, before: int = k * frames) -> None:
            if frame_written is not None:
                frame_written(before + written, len(scenes) * frames)

        studio = Studio(scene, msgspec.structs.replace(shoot, seed=shoot.seed + 1000 * k), middle)
        middle = studio.middle
        studio.middle *= energies[k]
        write_capture(folder / name, studio, report)


def write_capture(folder: Path, studio: "Studio", frame_written: Callable[[int, int], None] | None = None) -> None:
    """Write the capture that a studio is prepared for; see `write`."""
    shoot = studio.shoot
    with atomic.new_folder(folder) as place:
        files = []
        shots = [("pol", angle) for angle in shoot.angles_deg]
        if shoot.cross:
            shots.append(("cross", shoot.angles_deg[0]))
        for shot, (kind, angle) in enumerate(shots):
            pose = _draw_pose(shoot, shot)
            radiance = studio.radiance(pose, crossed=kind == "cross")
            matrix = transform(shoot, pose.shift_px, pose.rot_deg).tolist()
            for frame in range(shoot.exposures):
                name = f"{kind}{folder_names.degrees(angle)}/IMG_{shot * shoot.exposures + frame + 1:04d}.DNG"
                factor = float(shoot.step ** (frame - shoot.exposures // 2))
                taken = studio.photograph(place / name, radiance, Take(shot, frame, factor))
                files.append({"file": name, "nominal_deg": angle, **asdict(pose), "transform": matrix, **taken})
                if frame_written is not None:
                    frame_written(len(files), len(shots) * shoot.exposures)
        _write_truth(place, studio, files)


@dataclass(frozen=True)
class ShotPose:
    """True polarizer angle of a shot, and the camera's movement since the reference shot."""

    actual_deg: float
    shift_px: tuple[float, float] = (0.0, 0.0)  # of the picture, right and down
    rot_deg: float = 0.0  # of the picture, counter-clockwise as displayed


@dataclass(frozen=True)
class Take:
    """One simulated photograph of a capture; each has its own noise and time stamp."""

    shot: int
    frame: int  # within the bracket
    factor: float  # exposure over that of the middle frame
    again: int = 0  # number of earlier photographs of this frame
    lit: bool = True  # False: the light is off
    dials: "Dials | None" = None  # None: as the bracket of `Shoot`


@dataclass(frozen=True)
class Dials:
    """Camera settings of one photograph, as EXIF states them."""

    time_s: float
    f_number: float
    iso: float
    flash: bool


class Studio:
    """A lit scene in front of the simulated camera, ready to be photographed."""

    def __init__(self, scene: Scene, shoot: Shoot, middle: float | None = None) -> None:
        """`middle`: exposure of the middle frame, as of another studio; None: automatic."""
        self.scene, self.shoot = scene, shoot
        self.buffer = render.gbuffer(scene, shoot.view, shoot.height, shoot.width)
        self.to_camera = forward_camera.rec709_to_camera(shoot.color_matrix)
        self.reference = _light(scene, shoot, self.buffer, np.eye(3))
        automatic = _middle_exposure(scene, shoot, self.buffer, self.reference[0] @ self.to_camera.T)
        self.middle = automatic if middle is None else middle

    def through(self, angle_deg: float, crossed: bool = False) -> Floats:
        """Light through the polarizer at this angle, as of `radiance`, for a camera that does not move."""
        return self.radiance(ShotPose(angle_deg), crossed)

    def radiance(self, pose: ShotPose, crossed: bool = False) -> Floats:
        """Light after polarizer and lens, (H, W, 3) camera channels.

        A camera that rolls turns its polarizer too. `crossed`: the flash is polarized at right angles to the first
        angle; its polarizer takes half the light.
        """
        shoot, back = self.shoot, np.linalg.inv(transform(self.shoot, pose.shift_px, pose.rot_deg))
        moved = not np.array_equal(back, np.eye(3))
        stokes = _light(self.scene, shoot, self.buffer, back) if moved else self.reference
        if crossed:
            axis = np.radians(shoot.angles_deg[0] + 90.0)
            polarized = _light(self.scene, shoot, self.buffer, back, axis)
            degree = (shoot.flash_extinction - 1) / (shoot.flash_extinction + 1)  # of the flash's polarization
            stokes = 0.5 * (degree * polarized + (1 - degree) * stokes)
        y, x = np.mgrid[: shoot.height, : shoot.width].astype(np.float64)
        v = frames.rays_at(shoot.view, *_reference_px(shoot, back, x, y))
        axis = frames.axis_on_ray(np.radians(pose.actual_deg - pose.rot_deg), v)
        weights = mueller.analyzer(axis, shoot.extinction_ratio).astype(np.float32)  # (H, W, 3)
        light = gaussian_filter(np.einsum("hws,shwc->hwc", weights, stokes), shoot.blur_px, axes=(0, 1))
        return np.asarray(light @ self.to_camera.T)

    def photograph(self, path: Path, radiance: Floats, take: Take) -> dict[str, Any]:
        """Write one DNG of `radiance` (H, W, 3); returns its exposure for truth.json."""
        shoot, sensor = self.shoot, self.shoot.sensor
        exif, light, amplification = _exposure(shoot, take, self.middle)
        light *= take.lit
        seed = [shoot.seed, 1 + take.shot, take.frame, *((take.again,) if take.again else ())]
        random = np.random.default_rng(seed)
        energy = float(1 + shoot.gain_jitter * random.normal())
        cfa = np.array(_CFA[shoot.cfa], np.uint8)
        mosaic = forward_camera.mosaic(radiance, cfa) * (light * energy)
        counts = forward_camera.expose(mosaic, sensor, amplification, random)
        forward_camera.write_dng(path, counts, sensor, cfa, shoot.color_matrix, exif)
        return {
            "exposure_index": take.frame, "time": exif.exposure_time, "fnumber": exif.f_number, "iso": exif.iso,
            "relative_exposure": light * amplification, "flash_factor": energy,
            "clipped_fraction_object": float((counts[self.buffer.mask] >= sensor.white).mean()),
            "time_stamp": exif.taken,
        }  # fmt: skip


def transform(shoot: Shoot, shift_px: tuple[float, float], rot_deg: float) -> Floats:
    """Homography (3, 3) that a simulated camera movement causes, from reference RAW px to RAW px of a shot.

    The picture is rotated by `rot_deg` about the principal point, counter-clockwise as displayed, and shifted by
    `shift_px` (right, down).
    """
    c, s = np.cos(np.radians(rot_deg)), np.sin(np.radians(rot_deg))
    roll = np.array([[c, s], [-s, c]])  # rows run down, so counter-clockwise is the transpose
    center = np.array(shoot.view.center)
    out = np.eye(3)
    out[:2, :2] = roll
    out[:2, 2] = center + shift_px - roll @ center
    return out


def _draw_pose(shoot: Shoot, shot: int) -> ShotPose:
    """Random camera movement and polarizer angle of one shot; the first shot does not move."""
    random = np.random.default_rng([shoot.seed, 0, shot])
    x, y, roll = (random.uniform(-1, 1, 3) if shot else np.zeros(3)).tolist()
    shift = x * shoot.nudge_px, y * shoot.nudge_px
    roll *= shoot.nudge_deg
    nominal = shoot.angles_deg[shot % len(shoot.angles_deg)]  # the crossed shot, after the last, has the first angle
    return ShotPose(float(nominal + shoot.angle_error_deg * random.normal()), shift, roll)


def _light(scene: Scene, shoot: Shoot, buffer: GBuffer, back: Floats, flash_axis: float | None = None) -> Floats:
    """Stokes parameters (3, H, W, 3) of the scene as a shot sees it, averaged over each pixel's area.

    `back` (3, 3) maps the shot's pixels to those of the reference shot.
    """
    start = render.guide(buffer)
    total = np.zeros((3, shoot.height, shoot.width, 3), np.float32)
    for x, y in forward_camera.pixel_samples(shoot.height, shoot.width, shoot.samples):
        total += render.stokes(scene, shoot.view, *_reference_px(shoot, back, x, y), start, flash_axis)
    return total / shoot.samples**2


def _reference_px(shoot: Shoot, back: Floats, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Undistorted pixels of the reference shot that show the same points as pixels x, y of a moved shot."""
    return projection.coordinates(back, *forward_camera.undistort(shoot.view, shoot.distortion, x, y))


def _middle_exposure(scene: Scene, shoot: Shoot, buffer: GBuffer, s0: Floats) -> float:
    """Automatic exposure of the middle frame of a bracket, for s0 (H, W, 3) in camera channels.

    In that frame the 90th percentile of the object, and the white patch, have at most 0.35 of the white level. In the
    darkest frame 99.9 % of the object have at most 0.95.
    """
    bright = s0[buffer.mask].max(axis=-1) / 2  # the polarizer passes half
    if not bright.size:
        raise CaptureError("the object is outside the picture; move scene.position towards (0, 0, -0.7)")
    level = float(np.percentile(bright, 90))
    peak = float(np.percentile(bright, 99.9))
    if scene.chart is not None:
        white = render.white_level(scene) / 2
        level, peak = max(level, white), max(peak, white)
    return shoot.exposure_factor * min(0.35 / level, 0.95 / peak * shoot.step ** (shoot.exposures // 2))


def _exposure(shoot: Shoot, take: Take, middle: float) -> tuple[Exif, float, float]:
    """EXIF data of a simulated photograph, the light it receives, and its amplification."""
    factor, number = take.factor, take.shot * shoot.exposures + take.frame
    diagonal_mm = SENSOR_WIDTH_MM * np.hypot(1, shoot.height / shoot.width)
    equivalent_mm = float(shoot.focal_mm * np.hypot(36, 24) / diagonal_mm)  # the same angle of view on full frame
    # s between two frames, and more between two shots
    taken = datetime(2026, 3, 14, 12) + timedelta(seconds=4.25 * number + 20 * (number // shoot.exposures))
    exif = Exif(
        make="Polcap", model="Synthetic", lens=f"Synthetic {shoot.focal_mm:g}mm", exposure_time=1 / 160, f_number=11.0,
        iso=100.0, focal_length_mm=shoot.focal_mm, focal_length_35mm=equivalent_mm,
        pixel_pitch_um=1000 * SENSOR_WIDTH_MM / shoot.width, taken=taken.isoformat(timespec="milliseconds"),
        flash_fired=shoot.bracket != "time" and take.lit,
    )  # fmt: skip
    if take.dials is not None:
        dials, amplification = take.dials, take.dials.iso / 100.0
        exif = replace(exif, exposure_time=dials.time_s, f_number=dials.f_number, iso=dials.iso)
        exif = replace(exif, flash_fired=dials.flash and take.lit)
        return exif, middle * factor / amplification, amplification
    if shoot.bracket == "iso":
        amplification = shoot.step**take.frame
        light = middle / shoot.step ** (shoot.exposures // 2)
        return replace(exif, iso=100.0 * amplification), light, amplification
    if shoot.bracket == "time":
        exif = replace(exif, exposure_time=MIDDLE_S * factor)
    elif shoot.bracket == "aperture":
        exif = replace(exif, f_number=round(11.0 / sqrt(factor), 1))
    return exif, middle * factor, 1.0


def _write_truth(place: Path, studio: Studio, files: list[dict[str, Any]]) -> None:
    """Write truth.json and truth.npz of a capture."""
    scene, shoot, buffer, reference = studio.scene, studio.shoot, studio.buffer, studio.reference
    view, white = shoot.view, render.white_level(scene)
    chart = scene.chart and {
        "corners_px": projection.project(view, charts.corners(scene.chart)).tolist(),
        "patch_corners_px": projection.project(view, charts.patches(scene.chart)).tolist(),
        "size_m": scene.chart.size_m,
    }
    document = {
        "conventions": _CONVENTIONS, "focal_px": view.focal, "principal_px": view.center,
        "camera_matrix_from_linear_srgb": studio.to_camera.tolist(), "white_S0": white, "chart": chart, "files": files,
        "scene": scene, "shoot": shoot,
    }  # fmt: skip
    atomic.write_json(place / "truth.json", document)
    if any(shoot.distortion):  # the true maps are those of a pinhole camera
        reference = _light(scene, msgspec.structs.replace(shoot, distortion=(0.0, 0.0)), buffer, np.eye(3))
    diffuse, specular, roughness, ior = scene_materials.evaluate(scene.coat, buffer.position, buffer.facing)
    inside, blurred = buffer.mask[..., None], gaussian_filter(reference, shoot.blur_px, axes=(1, 2))
    maps = {
        "normal": buffer.normal, "diffuse": diffuse * inside, "specular": specular * inside,
        "roughness": roughness * buffer.mask, "ior": ior * buffer.mask, "S": blurred / white * inside,
    }  # fmt: skip
    write_arrays(place / "truth.npz", maps, np.float16, depth=buffer.depth, mask=buffer.mask)


def write_arrays(file: Path, values: Mapping[str, Floats], kind: type[np.floating[Any]], **others: Any) -> None:
    """Write arrays of the truth by name into an npz file: `others` as they are, then `values` as numbers of `kind`."""
    arrays: dict[str, Any] = {name: value.astype(kind) for name, value in values.items()}
    with atomic.path(file) as temporary:
        np.savez_compressed(temporary, **others, **arrays)
