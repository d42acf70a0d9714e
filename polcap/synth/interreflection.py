"""Interreflection between the parts of a mesh in synthetic captures: one diffuse bounce, computed at the vertices.

All shots use the same interpolated values, so sampling noise adds no false polarization. Neglected: specular
reflection, and the slight polarization of the bounced light. There are two other simulations of this light:
`training/light_transport.py` works per pixel and includes specular reflection; `training/bounced_light.py` reuses
traced paths while the materials change during training.
"""

from collections.abc import Callable

import numpy as np

from polcap.images import Floats
from polcap.optics import fresnel
from polcap.synth.mesh_tracer import Tracer

_RAYS = 48  # per vertex, distributed by their cosine
_LIFT = 5e-4  # m above the surface, where a ray starts
_SMOOTH = 2  # smoothing passes: each vertex takes the mean of its faces

DiffuseLight = Callable[[Floats, Floats, Floats], Floats]  # points, normals, directions (N, 3) -> S0 (N, 3)


def received(tracer: Tracer, lit: DiffuseLight, camera: Floats, ior: float) -> Floats:
    """Interreflected light that enters the surface at each vertex, (V, 3), relative to the light from a white plane.

    `lit(point, normal, towards)` computes the diffusely reflected S0 (N, 3) of points under the flash, in the direction
    `towards`. All positions are in the frame of the mesh, also that of the `camera` (3,). Normals of open surfaces are
    turned to face the camera.
    """
    mesh = tracer.mesh
    normal = mesh.vertex_normals()
    towards = camera - mesh.vertices
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    normal = np.where(np.sum(normal * towards, axis=1, keepdims=True) < -0.3, -normal, normal)
    e_x = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.6, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]))
    e_x /= np.maximum(np.linalg.norm(e_x, axis=1, keepdims=True), 1e-12)
    e_y = np.cross(normal, e_x)
    turn = np.random.default_rng(0).uniform(0, 2 * np.pi, len(normal))
    total: Floats = np.zeros(normal.shape)
    for k in range(_RAYS):
        cosine = np.sqrt(1 - (k + 0.5) / _RAYS)
        angle = turn + k * np.pi * (3 - np.sqrt(5))
        across = np.cos(angle)[:, None] * e_x + np.sin(angle)[:, None] * e_y
        direction = cosine * normal + np.sqrt(1 - cosine**2) * across
        hit = tracer.meet(mesh.vertices + _LIFT * normal, direction)
        back = -direction[hit.index]
        facing = np.where(np.sum(hit.normal * back, axis=1, keepdims=True) < 0, -hit.normal, hit.normal)
        entered, _ = fresnel.transmission(np.float64(cosine), ior)
        total[hit.index] += entered * lit(hit.position, facing, back)
    return _smoothed(total / _RAYS, tracer)


def _smoothed(value: Floats, tracer: Tracer) -> Floats:
    faces = tracer.mesh.faces
    count = np.maximum(np.bincount(faces.ravel(), minlength=len(value)), 1)[:, None]
    for _ in range(_SMOOTH):
        mean = np.repeat(value[faces].mean(axis=1), 3, axis=0)
        value = np.stack([np.bincount(faces.ravel(), m, len(value)) for m in mean.T], axis=1) / count
    return value
