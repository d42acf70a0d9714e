"""A ball with a red top-left quarter, as maps and mesh: to see what happens to an asset on its way out."""

from dataclasses import replace

import numpy as np

from polcap.image_values import Floats, View
from polcap.mesh_values import Asset, Mesh, ReliefMesh
from polcap.stage_values import SurfaceMaps
from polcap.stages import asset, surface

VIEW = View(focal=400.0, center=(70.0, 50.0), scale=2.0, origin=(300.0, 200.0))
HEIGHT, WIDTH = 120, 160
CENTER, RADIUS = (0.01, -0.01, -0.6), 0.075  # m, camera frame
DISTANCE = 0.55  # m


def maps(ripple: float = 0.0, roughness: float = 1.0, specular: float = 0.0) -> SurfaceMaps:
    """The ball; `ripple` rad tilts its normals by waves of 14 px along x and 20 px along y."""
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    a, b = (column - VIEW.center[0]) / VIEW.focal, -(row - VIEW.center[1]) / VIEW.focal
    ray = np.stack([a, b, -np.ones_like(a)], axis=-1)
    along, square = ray @ np.array(CENTER), np.sum(ray * ray, axis=-1)
    root = along**2 - square * (np.dot(CENTER, CENTER) - RADIUS**2)
    mask = root > 0.06 * RADIUS**2
    depth = (along - np.sqrt(np.maximum(root, 0))) / square
    normal = (ray * depth[..., None] - CENTER) / RADIUS
    normal[..., 0] += ripple * np.sin(2 * np.pi * column / 14)
    normal[..., 1] += ripple * np.sin(2 * np.pi * row / 20)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    left = column - VIEW.center[0] < VIEW.focal * CENTER[0] / -CENTER[2]
    top = row - VIEW.center[1] < -VIEW.focal * CENTER[1] / -CENTER[2]
    diffuse = np.where((left & top)[..., None], [0.6, 0.05, 0.05], [0.1, 0.5, 0.1])
    return SurfaceMaps(
        normal=np.where(mask[..., None], normal, 0).astype(np.float32),
        diffuse=diffuse.astype(np.float32),
        specular=np.full((HEIGHT, WIDTH, 3), specular, dtype=np.float32),
        roughness=np.full((HEIGHT, WIDTH), roughness, dtype=np.float32),
        depth_prior=None,
        confidence=np.full((HEIGHT, WIDTH), 3.0, dtype=np.float32),
        mask=mask,
        view=VIEW,
        estimator="truth",
    )


def mesh(of: SurfaceMaps, settings: surface.SurfaceSettings | None = None) -> ReliefMesh:
    return surface.integrate(of, DISTANCE, settings or surface.SurfaceSettings())


def flat_mesh(of: SurfaceMaps) -> ReliefMesh:
    """A plane facing the camera under the same mask: all shape is left to the normal texture."""
    plane = np.zeros_like(of.normal)
    plane[..., 2] = 1
    return mesh(replace(of, normal=plane))


def built(of: SurfaceMaps, on: Mesh) -> Asset:
    return asset.build(of, on, asset.AssetSettings())


def lit(of: SurfaceMaps, to_light: Floats) -> Floats:
    """What a Lambertian renderer shows of the maps, (H, W, 3) linear: base colour · n·l."""
    shade = np.maximum(of.normal @ (np.asarray(to_light) / np.linalg.norm(to_light)), 0.0)
    return np.asarray(0.9216 / (1 - of.specular) * of.diffuse * shade[..., None])  # T₊(0)² = .96²
