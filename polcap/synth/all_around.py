"""Simulated captures of one object from all sides: object and board turn before a fixed camera and flash.

::

    FOLDER/view01/ …   one capture per view, as `shooting.py` writes it; the chart is in the first
    FOLDER/truth.json  poses of the board, camera
    FOLDER/truth.npz   true surface: vertices [m, world frame], faces, and the material at every vertex

With views of the object laid on its side, these folders are setA/view01 … and setB/view01 …; truth.json then has the
turn and the shift of the object from the first board to the second.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import UNSET, Meta
from scipy.spatial.transform import Rotation

from polcap.errors import package_for
from polcap.formats import atomic
from polcap.formats.capture import folder_names
from polcap.image_values import Floats
from polcap.optics.mesh_tracer import Triangles, smooth
from polcap.synth import forward_camera, scene_materials, shooting, trace
from polcap.synth.color_checker import Chart
from polcap.synth.distance_fields import Model
from polcap.synth.laid_board import LaidBoard
from polcap.synth.render import Scene
from polcap.synth.shooting import Shoot

Poses = list[tuple[Rotation, Floats]]  # turn and position [m] of the board in the camera frame
CONVENTIONS = (
    "world: origin in the board's middle, x right and z down the printed page, y up, metres; "
    "camera: x right, y up, z towards the camera; camera point = rotation @ world point + translation; "
    "pixels are those of a pinhole with focal_px and principal_px, before the lens"
)
_LAID = Rotation.from_euler("yxz", [40, 87, 5], degrees=True)  # turn of an object that is laid on its side
_GRID = 96  # points along a side of the grid on which a shape's surface is found


class AroundShoot(Shoot, frozen=True, forbid_unknown_fields=True):
    """Camera, polarizer and turntable of captures from all sides. One flat list, because users set fields by name."""

    focal_mm: Annotated[float, Meta(ge=1, le=10000, description="focal length, on a sensor 36 mm wide [mm]")] = 76.0
    board: Annotated[
        Literal["A4", "A3", "A2", "none"], Meta(description="size of the printed board; none: no board")
    ] = "A4"
    distance_m: Annotated[float, Meta(gt=0.1, le=100, description="from the lens to the object's middle")] = 0.7
    elevation_deg: Annotated[float, Meta(ge=5, le=85, description="of the lens above the board")] = 25.0
    turn_error_deg: Annotated[float, Meta(ge=0, le=45, description="1σ of the table's angle")] = 0.5
    radius_m: Annotated[float, Meta(gt=0, le=10, description="of the sphere about the object, if it is a mesh")] = 0.065
    off_axis_m: Annotated[float, Meta(ge=0, le=0.1, description="from the table's axis to the board's middle")] = 0.003
    laid: Annotated[int, Meta(ge=0, le=99, description="further views, after the object was laid on its side")] = 0


@dataclass(frozen=True)
class ObjectPose:
    """An object on the board, turned from its own frame."""

    mesh: Triangles
    turn: Rotation

    @property
    def _heights(self) -> Floats:
        return np.asarray(self.turn.apply(self.mesh.vertices))[:, 1]

    @property
    def lift(self) -> float:
        """Height of the origin of the object's frame above the board [m]."""
        return -float(self._heights.min())

    @property
    def middle(self) -> Floats:
        """Point (3,) m of the world frame that the lens aims at."""
        return np.array([0.0, np.ptp(self._heights) / 2, 0.0])


def write(
    folder: Path, scene: Scene, shoot: AroundShoot, views: int, frame_written: Callable[[int, int], None] | None = None
) -> None:
    """Write captures of `scene`'s object from `views` sides into a new folder; the same arguments give the same bytes.

    The object is on the board, its y axis up; position and turn of `scene` are not used. All views have the exposure
    of the first. `frame_written` and errors are as for `shooting.write`.
    """
    forward_camera.require_empty(folder)
    if isinstance(scene.shape, Model):
        sized = msgspec.structs.replace(scene.shape, radius=shoot.radius_m)
        scene = msgspec.structs.replace(scene, shape=sized)
    mesh = surface(scene)
    sets = [ObjectPose(mesh, Rotation.identity())] + [ObjectPose(mesh, _LAID)] * bool(shoot.laid)
    scenes: dict[str, Scene] = {}
    poses: dict[str, tuple[Rotation, Floats]] = {}
    for letter, placed, count in zip("AB", sets, (views, shoot.laid)):
        for k, pose in enumerate(_poses(shoot, count, placed.middle)):
            name = f"set{letter}/" * bool(shoot.laid) + folder_names.view_name(k)
            view = _view(scene, shoot, *pose, placed)
            scenes[name] = msgspec.structs.replace(view, chart=None) if scenes else view
            poses[name] = pose
    with atomic.new_folder(folder) as place:
        shooting.write_views(place, scenes, shoot, [1.0] * len(scenes), frame_written)
        _write_surface(place / "truth.npz", scene, mesh, sets[0].lift)
        _write_poses(place / "truth.json", scene, shoot, poses, sets)


def surface(scene: Scene) -> Triangles:
    """True surface of a scene's object in its own frame [m].

    Raises InputError where scikit-image is missing; a mesh does not need it.
    """
    if isinstance(scene.shape, Model):
        return trace.model_tracer(scene.shape).mesh
    with package_for("--views", "scikit-image", "fusion", ", or give a --mesh"):
        from skimage import measure
    axis = np.linspace(-scene.shape.radius, scene.shape.radius, _GRID)
    field = scene.shape.distance(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1))
    found: Any = measure.marching_cubes(field, 0.0, spacing=(axis[1] - axis[0],) * 3)
    return smooth(found[0] + axis[0], found[1])


def _poses(shoot: AroundShoot, views: int, target: Floats) -> Poses:
    """Turn and position [m] of the board in the camera frame of each view; the lens aims at `target` (3,)."""
    random = np.random.default_rng([shoot.seed, 0x7A61E])
    angle = random.uniform(0, 2 * np.pi)
    off = shoot.off_axis_m * np.array([np.cos(angle), 0.0, np.sin(angle)])  # of the board's middle from the axis
    tilt = Rotation.from_euler("x", shoot.elevation_deg, degrees=True)
    out: Poses = []
    for k in range(views):
        degrees = 360.0 * k / views + shoot.turn_error_deg * random.normal() * (k > 0)
        table = Rotation.from_euler("y", degrees, degrees=True)
        out.append((tilt * table, tilt.apply(table.apply(off) - target) - [0.0, 0.0, shoot.distance_m]))
    return out


def _view(scene: Scene, shoot: AroundShoot, turn: Rotation, position: Floats, placed: ObjectPose) -> Scene:
    """The scene on its board in one pose of the board, with the chart upright at the right of the object."""
    vector = tuple(turn.as_rotvec(degrees=True).tolist())
    own = tuple((turn * placed.turn).as_rotvec(degrees=True).tolist())
    place = tuple((turn.apply([0.0, placed.lift, 0.0]) + position).tolist())
    edge = 0.5 * forward_camera.SENSOR_WIDTH_MM / shoot.focal_mm * shoot.distance_m  # m, of the picture
    # half the chart and a gap from the edge [m], above the middle
    chart = Chart(center=(edge - 0.053, 0.085 * shoot.distance_m, -shoot.distance_m))
    laid = UNSET if shoot.board == "none" else LaidBoard(tuple(position.tolist()), vector, shoot.board)
    return msgspec.structs.replace(
        scene, turn_deg=own, position=place, chart=chart, board=laid, cast_shadows=True, shadows=True
    )


def _write_surface(file: Path, scene: Scene, mesh: Triangles, lift: float) -> None:
    """Write vertices, faces and material of the true surface, raised by `lift` [m] into the world frame."""
    diffuse, specular, roughness, ior = scene_materials.evaluate(scene.coat, mesh.vertices, mesh.vertex_normals())
    values = {
        "vertices": mesh.vertices + np.array([0.0, lift, 0.0]), "diffuse": diffuse, "specular": specular,
        "roughness": roughness, "ior": ior,
    }  # fmt: skip
    shooting.write_arrays(file, values, np.float32, faces=mesh.faces)


def _write_poses(
    file: Path, scene: Scene, shoot: AroundShoot, poses: dict[str, tuple[Rotation, Floats]], sets: Sequence[ObjectPose]
) -> None:
    """Write camera, light and true poses of all views."""
    views = [
        {"name": name, "rotation": turn.as_matrix().tolist(), "translation": position.tolist()}
        for name, (turn, position) in poses.items()
    ]
    document: dict[str, Any] = {
        "conventions": CONVENTIONS, "board": shoot.board, "focal_px": shoot.view.focal,
        "principal_px": shoot.view.center, "size_px": (shoot.width, shoot.height), "distortion": shoot.distortion,
        "light": scene.light, "views": views,
    }  # fmt: skip
    if shoot.laid:
        first, second = sets
        shift = np.array([0.0, second.lift, 0.0]) - second.turn.apply([0.0, first.lift, 0.0])
        document["laid"] = {"rotation": second.turn.as_matrix().tolist(), "translation": shift.tolist()}
    atomic.write_json(file, document)
