"""Views of a mesh for tests and benchmarks of the fusion: traced maps, with simulated errors of normals and poses."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polcap.fusion.values import ClosedMesh, FusionView, Pose
from polcap.image_values import Floats, View
from polcap.optics import frames
from polcap.optics.mesh_tracer import Tracer, Triangles, smooth

DISTANCE = 0.6  # m from the lens to the object's middle
SIZE = 0.16  # m, the object's longest side
FILLED = 0.95  # share of the picture's side that the object's diagonal fills, at most
BLOB_DEG = 5.2  # rms of each tilt's smooth part
READ_LOW = 0.12  # relative error of the zenith angle at the rim
HALF_TURNS = 0.03  # share of the pixels
POSE_DEG, POSE_SHIFT = 0.1, 5e-4  # 1σ of the turn about the object's middle, and of its position over its size


@dataclass(frozen=True)
class Body:
    """A mesh in the world frame, standing on the board, with its tracer."""

    triangles: Triangles
    tracer: Tracer
    middle: Floats  # (3,) m
    size: float  # longest side, m


def stand(vertices: Floats, faces: NDArray[np.integer], turn: Rotation | None = None) -> Body:
    """The mesh turned, scaled to SIZE, and standing on the middle of the board."""
    placed = vertices if turn is None else turn.apply(vertices)
    low, high = placed.min(axis=0), placed.max(axis=0)
    placed = (placed - [(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2]) * (SIZE / (high - low).max())
    triangles = smooth(placed, faces)
    middle = (placed.min(axis=0) + placed.max(axis=0)) / 2
    return Body(triangles, Tracer(triangles), middle, SIZE)


def ring(body: Body, count: int, elevation_deg: float = 25.0, tip: Rotation | None = None) -> list[Pose]:
    """Poses (count) of a camera that looks at the object from a ring around it, first turned over by `tip`."""
    tip = tip or Rotation.identity()
    turns = (Rotation.from_euler("XY", [elevation_deg, -360 * k / count], degrees=True) for k in range(count))
    return [look_at(body, turn * tip) for turn in turns]


def all_around(body: Body, count: int) -> list[Pose]:
    """Two thirds of the poses on a ring about the standing object, one third after it is laid on its side."""
    laid = count // 3
    return ring(body, count - laid) + ring(body, laid, tip=Rotation.from_euler("x", 90, degrees=True))


def into_the_opening(body: Body, count: int) -> list[Pose]:
    """Half of the poses on a ring about a standing vessel; half look into it after it is laid on its side."""
    laid = count // 2
    tip = Rotation.from_euler("x", 90, degrees=True)
    turns = (Rotation.from_euler("XY", [15, azimuth], degrees=True) for azimuth in np.linspace(40, -40, laid))
    return ring(body, count - laid) + [look_at(body, turn * tip) for turn in turns]


def look_at(body: Body, turn: Rotation) -> Pose:
    """Pose of the turned object before the camera."""
    return Pose(turn.as_matrix(), np.array([0, 0, -DISTANCE]) - turn.apply(body.middle))


def capture(body: Body, pose: Pose, pixels: int = 384, name: str = "") -> FusionView:
    """Maps of the object from one pose, without errors; its albedo is a solid texture."""
    diagonal = float(np.linalg.norm(np.ptp(body.triangles.vertices, axis=0)))
    view = View(pixels * FILLED * DISTANCE / diagonal, ((pixels - 1) / 2, (pixels - 1) / 2), 1.0)
    seen = body.tracer.trace(pose.rotation, pose.translation, view, pixels, pixels)
    mask = seen.mask
    albedo = np.where(mask[..., None], solid_texture(seen.position / body.size), 0).astype(np.float32)
    flat = np.ones_like(albedo)
    return FusionView(
        name, pose, view, mask, seen.normal, np.full(mask.shape, 1, np.float32), albedo, flat * 0.04,
        flat[..., 0] * 0.4,
    )  # fmt: skip


def solid_texture(position: Floats) -> Floats:
    """Albedo (..., 3) of points in the object's frame [sizes]: waves of four lengths, ± 20 %."""
    rng = np.random.default_rng(5)
    total = np.zeros((*position.shape[:-1], 3))
    for length in (0.5, 0.2, 0.08, 0.04):
        for channel in range(3):
            wave = rng.normal(size=(3, 3)) * 2 * np.pi / length
            total[..., channel] += np.sin(position @ wave.T + rng.uniform(0, 6, 3)).prod(axis=-1)
    return np.asarray(0.45 * (1 + 0.2 * np.clip(total, -1.5, 1.5)))


def with_errors(body: Body, of: FusionView, rng: np.random.Generator, normals: float = 1.0) -> FusionView:
    """The view with normals, albedo and pose wrong as those of real captures; `normals` scales the first."""
    height, width = of.mask.shape
    v = frames.rays(of.camera, height, width)
    local = frames.to_ray_frame(of.normal, v)  # x, y across the ray, z along it
    zenith = np.arccos(np.clip(local[..., 2], -1, 1))
    azimuth = np.arctan2(local[..., 1], local[..., 0])
    turned = blobs(rng, (height, width), width / 40)
    azimuth = azimuth + np.pi * (turned > np.quantile(turned[of.mask], 1 - HALF_TURNS * normals))
    zenith = zenith * (1 - normals * READ_LOW * (zenith / (np.pi / 2)) ** 2)
    local = np.stack([np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1)
    tilt = [np.radians(BLOB_DEG * normals) * blobs(rng, (height, width), width / 12) for _ in range(2)]
    local = frames.unit(local + np.stack([*tilt, np.zeros((height, width))], axis=-1))
    normal = frames.from_ray_frame(frames.lifted(local), v)
    error = frames.angle_deg(normal, of.normal)
    expected = cv2.GaussianBlur(np.where(of.mask, error, 8).astype(np.float32), (0, 0), width / 10) + 1
    albedo = of.diffuse * (1 + 0.05 * blobs(rng, (height, width), width / 12))[..., None]
    return replace(
        of,
        pose=disturbed(body, of.pose, rng),
        normal=np.where(of.mask[..., None], normal, 0).astype(np.float32),
        sigma_deg=expected,
        diffuse=albedo.astype(np.float32),
    )


def disturbed(body: Body, pose: Pose, rng: np.random.Generator) -> Pose:
    """The pose with an error of the turn about the object's middle and of its position."""
    turn = Rotation.from_rotvec(rng.normal(size=3) * np.radians(POSE_DEG) / np.sqrt(3)).as_matrix() @ pose.rotation
    middle = pose.rotation @ body.middle + pose.translation + rng.normal(size=3) * POSE_SHIFT * body.size / np.sqrt(3)
    return Pose(turn, middle - turn @ body.middle)


def blobs(rng: np.random.Generator, shape: tuple[int, int], radius: float) -> Floats:
    """Smooth random picture of mean 0 and variance 1."""
    noise = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), radius)
    return np.asarray((noise - noise.mean()) / noise.std())


def mean_error_deg(a: FusionView, b: FusionView) -> float:
    """Mean angle between the normals of two views of the same pixels."""
    return float(frames.angle_deg(a.normal, b.normal)[a.mask & b.mask].mean())


def solid(mesh: ClosedMesh) -> trimesh.Trimesh:
    """A fused mesh for trimesh, which knows its volume and Euler number."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
