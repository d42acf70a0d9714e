"""Pictures of the fused object from any side: rays meet the mesh, and its textures are shaded there."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps
from polcap.fusion.values import IOR, Pose
from polcap.image_values import Floats, View
from polcap.optics import color, frames
from polcap.optics.mesh_tracer import Tracer
from polcap.report import animation
from polcap.report.animation import TexturedPoints
from polcap.report.sheets import Picture

FRAMES = 48  # of the turntable
_FILLED = 0.85  # diameter of the sphere around the object in the picture, over the picture's side
_DISTANCE = 5.0  # of the camera from the object's middle, in radii of this sphere
_ELEVATION_DEG = 20.0  # of the camera
_LIGHT = np.array([-0.5, 0.7, 0.8])  # direction towards the light, camera frame
_BACKGROUND = 0.012  # linear


def draw_around(atlas: Atlas, maps: AtlasMaps, count: int, side: int) -> list[Picture]:
    """Pictures (side, side, 3) of the object from `count` directions around the vertical, in sRGB."""
    vertices, tracer = atlas.mesh.vertices, atlas.tracer()
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - middle, axis=-1).max())
    view = View(side * _FILLED / 2 * np.sqrt(_DISTANCE**2 - 1), ((side - 1) / 2, (side - 1) / 2), 1.0)
    drawn = []
    for azimuth in np.arange(count) * (360 / count):
        turn = Rotation.from_euler("XY", [_ELEVATION_DEG, -azimuth], degrees=True).as_matrix()
        pose = Pose(turn, np.array([0, 0, -_DISTANCE * radius]) - turn @ middle)
        drawn.append(render(atlas, maps, tracer, pose, view, side))
    # about eight of the pictures give the exposure: their highlights become nearly white
    top = max(float(np.quantile(np.stack(drawn[:: max(1, count // 8)]), 0.998)), 1e-6)
    return [color.srgb_eight_bits(0.9 * one / top) for one in drawn]


def render(atlas: Atlas, maps: AtlasMaps, tracer: Tracer, pose: Pose, view: View, side: int) -> Floats:
    """Radiance (side, side, 3) of the object under a distant lamp next to the camera and a gray sky."""
    v = frames.rays(view, side, side).reshape(-1, 3)
    met = tracer.meet(np.broadcast_to(pose.center, v.shape), -v @ pose.rotation)
    points = sample_textures(atlas, maps, met.face, met.weight)
    points = points._replace(normal=points.normal @ pose.rotation.T)  # in the camera frame
    out = np.full((side * side, 3), _BACKGROUND, np.float32)
    out[met.index] = animation.render(points, v[met.index], _LIGHT, pose.rotation[:, 1], IOR)
    return out.reshape(side, side, 3)


def sample_textures(atlas: Atlas, maps: AtlasMaps, face: NDArray[np.integer], weight: Floats) -> TexturedPoints:
    """The values of the texels nearest to N surface points.

    A point lies in triangle `face` (N,), at the barycentric coordinates `weight` (N, 3).
    """
    side = maps.mask.shape[0]
    uv = (atlas.mesh.uv[atlas.mesh.faces[face]] * weight[..., None]).sum(axis=1) * side - 0.5
    at = np.clip(np.rint(uv).astype(int), 0, side - 1)
    row, column = at[:, 1], at[:, 0]
    return TexturedPoints(*(one[row, column] for one in (maps.normal, maps.diffuse, maps.specular, maps.roughness)))


def seen_picture(maps: AtlasMaps) -> Picture:
    """The diffuse albedo of the atlas, darkened where no view saw the surface."""
    shown = maps.diffuse * np.where(maps.seen, 1.0, 0.3)[..., None]
    return np.asarray(cv2.resize(color.srgb_eight_bits(shown), (640, 640)))  # px
