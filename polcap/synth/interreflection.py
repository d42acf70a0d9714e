"""Interreflection between the parts of a mesh: flash light that reaches a place by one diffuse bounce elsewhere.

`flash_light` and `diffuse_light` are the law of this bounce. Synthetic captures gather it at the vertices (`gather`):
all shots use the same interpolated values, so sampling noise adds no false polarization. The evaluation's pictures
gather it per pixel, also in specular reflection (`training/light_transport.py`). Both neglect further bounces and the
slight polarization of this light. Training has another simulation, `training/bounced_light.py`. It computes light with
torch along paths that were traced before, because materials change with each step.
"""

from collections.abc import Callable

import numpy as np

from polcap.image_values import Floats
from polcap.optics import frames, fresnel
from polcap.optics.mesh_tracer import Tracer

LIFT = 1e-3  # longest sides of the mesh, from the surface to the start of a ray; nearer hits are the place itself
_RAYS = 48  # per vertex, distributed by their cosine
_SMOOTH = 2  # smoothing passes: each vertex takes the mean of its faces

DiffuseLight = Callable[[Floats, Floats, Floats], Floats]  # points, normals, directions (N, 3) -> S0 (N, 3)


def flash_light(tracer: Tracer, place: Floats, normal: Floats, flash: Floats, strength: float) -> tuple[Floats, Floats]:
    """Direct flash light at points of a mesh: unit vectors to the flash (M, 3), and irradiance (M,), 0 in shadow.

    All vectors are in the frame of the mesh. The irradiance is S0 of a white plane that faces the flash; `strength` is
    that at distance 1.
    """
    distance = np.linalg.norm(flash - place, axis=1)
    to_flash, lift = (flash - place) / distance[:, None], LIFT * tracer.size
    start = place + lift * normal
    hidden = tracer.hidden(start, start + to_flash * (distance - lift)[:, None])
    return to_flash, np.where(hidden, 0, strength / distance**2)


def diffuse_light(
    lit: tuple[Floats, Floats], normal: Floats, towards: Floats, albedo: Floats, ior: Floats | float
) -> Floats:
    """Diffusely reflected S0 (M, 3) of places under the flash, `lit` by `flash_light`, in directions (M, 3)."""
    to_flash, irradiance = lit
    cos_i = np.clip(np.sum(to_flash * normal, axis=1), 1e-3, 1)
    cos_o = np.clip(np.sum(towards * normal, axis=1), 1e-2, 1)
    into, out = (fresnel.transmission(cosine, ior)[0] for cosine in (cos_i, cos_o))
    return np.asarray(albedo * (irradiance * cos_i * into * out)[:, None])


def gather(tracer: Tracer, lit: DiffuseLight, camera: Floats, ior: float) -> Floats:
    """Interreflected light that enters the surface at each vertex, (V, 3), relative to the light from a white plane.

    `lit(point, normal, towards)` computes the diffusely reflected S0 (N, 3) of points under the flash, in the direction
    `towards`. All positions are in the frame of the mesh, also that of the `camera` (3,). Normals of open surfaces are
    turned to face the camera.
    """
    mesh = tracer.mesh
    normal = mesh.vertex_normals()
    towards = frames.unit(camera - mesh.vertices)
    normal = np.where(np.sum(normal * towards, axis=1, keepdims=True) < -0.3, -normal, normal)  # seen from behind
    # square to the normal, from an axis that is not along it
    e_x = frames.unit(np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.6, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])))
    e_y = np.cross(normal, e_x)
    turn = np.random.default_rng(0).uniform(0, 2 * np.pi, len(normal))
    total: Floats = np.zeros(normal.shape)
    for k in range(_RAYS):
        cosine = np.sqrt(1 - (k + 0.5) / _RAYS)
        angle = turn + k * np.pi * (3 - np.sqrt(5))  # golden angle
        across = np.cos(angle)[:, None] * e_x + np.sin(angle)[:, None] * e_y
        direction = cosine * normal + np.sqrt(1 - cosine**2) * across
        hit = tracer.meet(mesh.vertices + LIFT * tracer.size * normal, direction)
        back = -direction[hit.index]
        facing = np.where(np.sum(hit.normal * back, axis=1, keepdims=True) < 0, -hit.normal, hit.normal)
        entered, _ = fresnel.transmission(np.float64(cosine), ior)
        total[hit.index] += entered * lit(hit.position, facing, back)
    return _smooth(total / _RAYS, tracer)


def _smooth(value: Floats, tracer: Tracer) -> Floats:
    """Values (V, 3) at vertices, averaged over the triangles around, `_SMOOTH` times."""
    faces = tracer.mesh.faces
    count = np.maximum(np.bincount(faces.ravel(), minlength=len(value)), 1)[:, None]
    for _ in range(_SMOOTH):
        mean = np.repeat(value[faces].mean(axis=1), 3, axis=0)
        value = np.stack([np.bincount(faces.ravel(), m, len(value)) for m in mean.T], axis=1) / count
    return value
