"""An ellipsoid before the camera, known everywhere: its mesh, and views of it."""

from dataclasses import replace
from functools import cache

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from polcap.fusion.values import ClosedMesh, FusionView, Pose
from polcap.image_values import Bools, Floats, View
from polcap.optics import frames, shade
from polcap.optics.mesh_tracer import Tracer, smooth
from polcap.optics.projection import back_project
from tests.fusion.traced_views import blobs

AXES = np.array([0.05, 0.035, 0.04])  # m
DISTANCE, PIXELS = 0.6, 160
FLASH = (0.0, 0.05, 0.0)  # m, camera frame
F0, ROUGHNESS = 0.06, 0.35  # of the photographs; the views' maps say 0.04 and 0.4
VIEW = View(PIXELS * 0.85 * DISTANCE / 0.1, ((PIXELS - 1) / 2, (PIXELS - 1) / 2), 1.0)


def mesh(subdivisions: int = 4) -> ClosedMesh:
    """The ellipsoid about the origin as a closed mesh."""
    ball = trimesh.creation.icosphere(subdivisions)
    return ClosedMesh((ball.vertices * AXES).astype(np.float32), ball.faces.astype(np.int32))


def normals(position: Floats) -> Floats:
    """Normals (..., 3) at points of the surface."""
    return frames.unit(position / AXES**2)


def albedo(position: Floats) -> Floats:
    """Albedo (..., 3), smooth waves of 2 cm."""
    wave = 0.4 + 0.2 * np.sin(position @ np.array([[310, 0, 40], [0, 290, 0], [60, 0, 330]]))
    return np.asarray(wave, np.float32)


@cache
def views(count: int, elevation_deg: float = 20.0, flash: tuple[float, float, float] = FLASH) -> tuple[FusionView, ...]:
    """Views without errors from a ring of positions around the ellipsoid."""
    body = mesh(5)
    tracer = Tracer(smooth(body.vertices, body.faces))
    found: list[FusionView] = []
    for azimuth in np.arange(count) * (360 / max(count, 1)):
        turn = Rotation.from_euler("XY", [elevation_deg, -azimuth], degrees=True).as_matrix()
        pose = Pose(turn, np.array([0.0, 0.0, -DISTANCE]))
        surface = tracer.trace(pose.rotation, pose.translation, VIEW, PIXELS, PIXELS)
        inside = surface.mask[..., None]
        normal = np.where(inside, normals(surface.position) @ turn.T, 0).astype(np.float32)
        flat = np.ones(surface.mask.shape, np.float32)
        diffuse = np.where(inside, albedo(surface.position), 0).astype(np.float32)
        gray = np.repeat(0.04 * flat[..., None], 3, axis=-1)
        name = f"view{len(found) + 1:02d}"
        s0 = photograph(surface.depth, normal, diffuse, inside, np.array(flash))
        found.append(FusionView(name, pose, VIEW, surface.mask, normal, 4 * flat, diffuse, gray, 0.4 * flat, s0))
    return tuple(found)


def photograph(depth: Floats, normal: Floats, diffuse: Floats, inside: Bools, flash: Floats) -> Floats:
    """S0 (H, W, 3) under a flash, of a surface with F0 and ROUGHNESS; a white plane at DISTANCE has 1."""
    y, x = np.mgrid[:PIXELS, :PIXELS].astype(float)
    point = back_project(VIEW, x, y) * np.where(np.isfinite(depth), depth, DISTANCE)[..., None]
    v = frames.unit(-point)
    light = frames.to_ray_frame(frames.unit(flash - point), v)
    one = np.ones(inside.shape[:2])
    f0 = np.full((*one.shape, 3), F0)
    fall = DISTANCE**2 / np.sum((flash - point) ** 2, axis=-1)
    local = frames.to_ray_frame(normal.astype(float), v)
    s0 = shade.stokes(local, diffuse, f0, ROUGHNESS * one, 1.5 * one, light, fall)[0]
    return np.where(inside, s0, 0).astype(np.float32)


def tilted(view: FusionView, degrees: float, seed: int) -> FusionView:
    """The view with its normals tilted by smooth random angles of this rms."""
    rng = np.random.default_rng(seed)
    tilt = [np.radians(degrees) / np.sqrt(2) * blobs(rng, view.mask.shape, PIXELS / 16) for _ in range(2)]
    normal = frames.unit(view.normal + np.stack([*tilt, 0 * tilt[0]], axis=-1))
    return replace(view, normal=np.where(view.mask[..., None], normal, 0).astype(np.float32))
