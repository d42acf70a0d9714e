"""Simulated captures of a flat sample on the board: camera and flash are moved about it, nine views by default.

::

    FOLDER/view01/ …   one capture per view, as `shooting.py` writes it; the chart lies on the board in the first
    FOLDER/truth.json  poses of the board, camera, light of each view, and the grid of the maps
    FOLDER/truth.npz   true maps of the sample's upper side on a grid of the board's plane

Rows of the maps run down the printed page (z), columns to the right (x).
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta
from scipy.spatial.transform import Rotation

from polcap.formats import atomic
from polcap.formats.capture import folder_names
from polcap.image_values import Floats
from polcap.synth import forward_camera, scene_materials, shooting, trace
from polcap.synth.all_around import CONVENTIONS, Poses
from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Slab
from polcap.synth.laid_board import LaidBoard
from polcap.synth.render import Scene
from polcap.synth.shooting import Shoot

_BOARD: Literal["A4"] = "A4"
_CHART = (0.084, 0.003, 0.0)  # m, world, middle of the chart: on the right of the ring, over the page's edge
_CHART_TURN = Rotation.from_matrix([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # its columns run to the left, it faces up
_FEW = 5  # views; up to this number, all oblique views have the same tilt
_TEXELS = 1024  # along a side of the true maps


class FlatShoot(Shoot, frozen=True, forbid_unknown_fields=True):
    """Camera, sample and positions of captures of a flat sample. One flat list, because users set fields by name."""

    width: Annotated[int, Meta(ge=64, le=20000, multiple_of=2, description="width of the RAW [px]")] = 1500
    height: Annotated[int, Meta(ge=64, le=20000, multiple_of=2, description="height of the RAW [px]")] = 1000
    focal_mm: Annotated[float, Meta(ge=1, le=10000, description="focal length, on a sensor 36 mm wide [mm]")] = 80.0
    distance_m: Annotated[float, Meta(gt=0.1, le=100, description="from the lens to the board's middle")] = 0.6
    tilts_deg: Annotated[
        tuple[float, float], Meta(description="of the oblique views; their mean for up to five views")
    ] = (20.0, 40.0)
    by_hand_m: Annotated[float, Meta(ge=0, le=0.1, description="1σ of the camera's aim and distance")] = 0.004
    by_hand_deg: Annotated[float, Meta(ge=0, le=20, description="1σ of the camera's direction")] = 2.0
    flash_jitter: Annotated[
        float, Meta(ge=0, le=0.5, description="1σ of the flash's energy from view to view, relative")
    ] = 0.02
    board_roughness: Annotated[float, Meta(ge=0, le=1, description="of a board on glossy paper; 0: matt")] = 0.0
    side_m: Annotated[float, Meta(gt=0, le=0.2, description="of the sample")] = 0.094
    thickness_m: Annotated[float, Meta(ge=0, le=0.05, description="of the sample [m]")] = 0.001
    relief_m: Annotated[float, Meta(ge=0, le=0.02, description="from the lowest to the highest point")] = 0.0006
    feature_m: Annotated[float, Meta(gt=0, le=0.1, description="size of the features of random relief")] = 0.008
    height_map: Annotated[str, Meta(description="picture file in place of random relief, white is high")] = ""


def write(
    folder: Path, scene: Scene, shoot: FlatShoot, views: int, frame_written: Callable[[int, int], None] | None = None
) -> None:
    """Write captures of a flat sample with the coat of `scene` into a new folder; same arguments give the same bytes.

    Shape, position and turn of `scene` are not used. `frame_written` and errors are as for `shooting.write`.
    """
    forward_camera.require_empty(folder)
    slab = Slab(shoot.side_m, shoot.thickness_m, shoot.relief_m, shoot.feature_m, shoot.seed, shoot.height_map)
    power = np.random.default_rng([shoot.seed, 0xF1A5]).normal(1.0, shoot.flash_jitter, views)
    poses = _poses(shoot, views)
    scenes = {
        folder_names.view_name(k): _view(scene, slab, shoot, *pose, with_chart=k == 0) for k, pose in enumerate(poses)
    }
    # the unit of a scene is the light at the board's middle, not the flash
    distance = np.linalg.norm([np.array(scene.light) - position for _, position in poses], axis=1)  # m, to the flash
    energies = [float(one) for one in power * (distance[0] / distance) ** 2]
    with atomic.new_folder(folder) as place:
        shooting.write_views(place, scenes, shoot, energies, frame_written)
        _write_maps(place / "truth.npz", scene, slab)
        _write_poses(place / "truth.json", scene, shoot, poses, power)


def _poses(shoot: FlatShoot, views: int) -> Poses:
    """Turn and position [m] of the board in the camera frame of each view; the first looks straight down."""
    random = np.random.default_rng([shoot.seed, 0xF1A7])
    near, far = shoot.tilts_deg
    count = views - 1
    inner = 0 if views <= _FEW else (count + 1) // 2  # views at the smaller tilt
    tilts = [near] * inner + [far if inner else (near + far) / 2] * (count - inner)
    turns = [360 * k / max(inner, 1) for k in range(inner)]
    turns += [360 * (k + 0.5) / (count - inner) for k in range(count - inner)]
    out: Poses = []
    for tilt, azimuth in zip([0.0, *tilts], [0.0, *turns], strict=True):
        tilt, azimuth = (a + shoot.by_hand_deg * random.normal() for a in (tilt, azimuth))
        turn = Rotation.from_euler("x", 90 - tilt, degrees=True) * Rotation.from_euler("y", azimuth, degrees=True)
        out.append((turn, shoot.by_hand_m * random.normal(size=3) - [0.0, 0.0, shoot.distance_m]))
    return out


def _view(scene: Scene, slab: Slab, shoot: FlatShoot, turn: Rotation, position: Floats, with_chart: bool) -> Scene:
    """The scene of one view: sample, board and chart before the camera."""
    vector, place = tuple(turn.as_rotvec(degrees=True).tolist()), tuple(position.tolist())
    middle = turn.apply(_CHART) + position
    chart = Chart(tuple(middle.tolist()), tuple((turn * _CHART_TURN).as_rotvec(degrees=True).tolist()))
    return msgspec.structs.replace(
        scene, shape=slab, turn_deg=vector, position=place, chart=chart if with_chart else None,
        board=LaidBoard(place, vector, _BOARD, shoot.board_roughness or msgspec.UNSET), cast_shadows=True, shadows=True,
    )  # fmt: skip


def _write_maps(file: Path, scene: Scene, slab: Slab) -> None:
    """Write the true maps at the middles of _TEXELS² texels; normals: x right, y up the page, z out of it."""
    axis = ((np.arange(_TEXELS) + 0.5) / _TEXELS - 0.5) * slab.side
    x, z = np.meshgrid(axis, axis)
    point = np.stack([x, slab.thickness + slab.height(x, z), z], axis=-1)
    facing = trace.gradient(slab, point)
    bent = scene_materials.add_relief(scene.coat, point, facing)
    diffuse, specular, roughness, ior = scene_materials.evaluate(scene.coat, point, facing)
    values = {
        "normal": np.stack([bent[..., 0], -bent[..., 2], bent[..., 1]], axis=-1), "diffuse": diffuse,
        "specular": specular, "roughness": roughness, "ior": ior, "height": slab.height(x, z),
    }  # fmt: skip
    shooting.write_arrays(file, values, np.float32)


def _write_poses(file: Path, scene: Scene, shoot: FlatShoot, poses: Poses, power: Floats) -> None:
    """Write camera, light and true poses of all views."""
    views = [
        {"name": folder_names.view_name(k), "rotation": turn.as_matrix().tolist(), "translation": at.tolist(),
         "light": float(power[k])}
        for k, (turn, at) in enumerate(poses)
    ]  # fmt: skip
    document = {
        "conventions": CONVENTIONS, "board": _BOARD, "focal_px": shoot.view.focal, "principal_px": shoot.view.center,
        "size_px": (shoot.width, shoot.height), "distortion": shoot.distortion, "light": scene.light,
        "side_m": shoot.side_m, "thickness_m": shoot.thickness_m, "texels": _TEXELS, "views": views,
    }  # fmt: skip
    atomic.write_json(file, document)
