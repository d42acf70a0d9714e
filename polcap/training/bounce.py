"""Light between the parts of an object in training: which pixel each one sees, and what comes from there.

The first is traced once per view, the second computed at every step. The flash stands next to the lens, so what
it lights the camera sees: the light that bounces comes from pixels of the same picture. `visibility` traces a
few rays from every second pixel of every second row and remembers which pixels they meet; `arriving` is the
light that takes those ways under the materials of the moment. `surroundings` adds the mirror image of a backdrop and
of the ground where no part of the object hides them. Left out, as in `light_transport.py`: more bounces, and that
bounced light arrives a little polarized.
"""

from math import log, pi
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from polcap.images import Floats, GBuffer
from polcap.optics import brdf, frames, fresnel, shade
from polcap.optics.projection import project
from polcap.training import light_transport
from polcap.training.materials import Surface

COARSE = 2  # pixels of the cache from one place that is traced to the next
_SPREAD = 4  # rays by the cosine about the smooth normal,
_LOBES = ((3, 0.5**2), (3, 0.2**2))  # and by GGX facets of these α
RAYS = _SPREAD + sum(count for count, _ in _LOBES)
SHARP = _LOBES[-1][0]  # the last rays, nearest to the mirror direction
NOWHERE = 65535  # the ray meets a place that the camera does not see
ESCAPED = 65534  # the ray leaves the object
_SHARPEST = 0.2  # roughness; what mirrors better is drawn as this
_BESIDE = 2  # pixels of the cache that count as the place itself
_APART = 0.01  # sides of the object by which a place met may differ from the one seen in its pixel

_SURROUNDINGS = (log(0.01), log(0.5))  # logarithm of the albedo of backdrop and ground, dark cloth to paper

Indices = NDArray[np.integer[Any]]


def visibility(
    scene: light_transport.Scene, buffer: GBuffer, pose: light_transport.Pose, rng: np.random.Generator
) -> tuple[NDArray[np.bool_], NDArray[np.uint16]]:
    """Pixels (H, W) that the flash reaches, and the flat indices (H/2, W/2, RAYS) of pixels that places see.

    ESCAPED where a ray leaves the object, NOWHERE where it meets a place that the camera does not see.
    """
    mask = buffer.mask
    height, width = mask.shape
    v = frames.rays(buffer.view, height, width)
    eye = -pose.translation @ pose.rotation
    _, flat = scene.facing(np.broadcast_to(eye, (int(mask.sum()), 3)), -v[mask] @ pose.rotation)
    lit = np.zeros_like(mask)
    lit[mask] = scene.lit(buffer.position[mask], flat, pose)[1] > 0

    above: Floats = np.zeros((height, width, 3), np.float32)
    above[mask] = flat
    places = np.zeros_like(mask)
    places[::COARSE, ::COARSE] = True
    places &= mask
    normal = frames.to_ray_frame(buffer.normal[places], v[places])
    way = frames.from_ray_frame(_ways(normal, rng), v[places][:, None])  # (M, RAYS, 3)
    origin = buffer.position[places] + light_transport.LIFT * scene.size * above[places]
    start = np.broadcast_to(origin[:, None], way.shape).reshape(-1, 3)
    direction = way.reshape(-1, 3) @ pose.rotation
    distance, _ = scene.facing(start, direction)
    met = np.flatnonzero(np.isfinite(distance) & (distance > light_transport.LIFT * scene.size))
    there = start[met] + distance[met, None] * direction[met]
    found = np.where(np.isfinite(distance), NOWHERE, ESCAPED).astype(np.uint16)
    found[met] = _pixel(there, np.argwhere(places)[met // RAYS], buffer, pose, scene.size)
    out = np.full((height, width, RAYS), NOWHERE, np.uint16)
    out[places] = found.reshape(-1, RAYS)
    return lit, out[::COARSE, ::COARSE]


def _ways(normal: Floats, rng: np.random.Generator) -> Floats:
    """Directions (M, RAYS, 3) about normals (M, 3), in the frame of each ray; their density is `_density`."""
    e_x, e_y = frames.basis(normal)
    turn, shift = rng.uniform(0, 1, (2, len(normal)))
    ways = []
    for number, alpha in ((_SPREAD, None), *_LOBES):
        for k in range(number):
            u = (k + shift) / number
            cosine = np.sqrt(1 - u if alpha is None else (1 - u) / (1 + (alpha**2 - 1) * u))
            azimuth = 2 * pi * (k * 0.618034 + turn)
            sine = np.sqrt(1 - cosine**2)
            x, y = (a[:, None] for a in (sine * np.cos(azimuth), sine * np.sin(azimuth)))
            axis = x * e_x + y * e_y + cosine[:, None] * normal
            ways.append(axis if alpha is None else 2 * axis[:, 2:] * axis - [0, 0, 1])
    return np.stack(ways, axis=1)


def _pixel(
    place: Floats, origin: Indices, buffer: GBuffer, pose: light_transport.Pose, size: float
) -> NDArray[np.uint16]:
    """Flat index of the pixel in which the camera sees each of the places (N, 3), NOWHERE if it does not.

    Nor where that is next to the pixel `origin` (N, 2) that the ray came from: the grid cannot tell its direction.
    """
    height, width = buffer.mask.shape
    seen = place @ pose.rotation.T + pose.translation
    x, y = np.round(project(buffer.view, seen)).astype(np.int64).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    inside &= np.linalg.norm(buffer.position[y, x] - place, axis=1) < _APART * size
    inside &= np.maximum(np.abs(y - origin[:, 0]), np.abs(x - origin[:, 1])) > _BESIDE
    return np.where(inside & buffer.mask[y, x], y * width + x, NOWHERE).astype(np.uint16)


def arriving(seen: Any, normal: Tensor, surface: Surface, body: Tensor) -> Tensor:
    """Stokes parameters (3, M, 3) of once-bounced light at the pixels of a `dataset.Seen`, before smoothing.

    normal (M, 3) with bumps, in the frames of the rays; body (M, 3) diffuse S0 by the flash alone. All rays count
    for both kinds of reflection, weighed by the balance heuristic.

    References
    ----------
    Veach & Guibas, Optimally combining sampling techniques for Monte Carlo rendering, SIGGRAPH 1995.
    """
    here, ray = (seen.met >= 0).nonzero(as_tuple=True)
    there = seen.met[here, ray]
    v, light = seen.v[here], body[there] / RAYS
    way = frames.to_ray_frame(F.normalize(seen.place[there] - seen.place[here], dim=1), v)
    irradiance = 1 / (pi * _density(frames.to_ray_frame(seen.normal[here], v), way).clamp(min=1e-3))
    n, rough, ior = normal[here], surface.roughness[here].clamp(min=_SHARPEST), surface.ior[here]
    diffuse, specular = surface.diffuse[here] * light, surface.specular[here]
    diffuse_part = shade.stokes(n, diffuse, 0 * specular, rough, ior, way, irradiance, surface.law.at(here))
    mirrored = shade.stokes(n, 0 * diffuse, specular * light, rough, _facet_ior(specular, ior), way, irradiance)
    return normal.new_zeros(3, len(normal), 3).index_add(1, here, diffuse_part + mirrored)


def surroundings(seen: Any, normal: Tensor, surface: Surface, strength: Tensor) -> Tensor:
    """Stokes parameters (3, M, 3) of the backdrop's and the ground's mirror image in the surface.

    Near the outline all light comes from there: reflectance tends to 1, and the mirrored ray points away from the
    camera. Each pixel has one ray, about its own normal, as far as the sharpest lobe of `visibility` leaves the object.
    strength (B,) as in `dataset.Simulator.shoot`; a third of the objects have neither backdrop nor ground.
    """
    count, device, own = len(strength), normal.device, seen.owner

    def u(low: float, high: float, columns: int = 1) -> Tensor:
        return low + (high - low) * torch.rand(count, columns, device=device)

    albedo = torch.exp(u(*_SURROUNDINGS)) * torch.exp(0.1 * torch.randn(count, 3, device=device)) * (u(0, 1) > 1 / 3)
    turn = u(0, 2 * pi)
    down = torch.cat([torch.cos(turn), torch.sin(turn), 0 * turn], dim=1)  # the ground's normal points the other way
    low = (seen.place * down[own]).sum(dim=1)  # the object rests on the ground
    ground = torch.full((count,), -9.0, device=device).scatter_reduce(0, own, low, "amax") + 9 * (u(0, 1)[:, 0] > 0.6)
    behind = 1.35 + 1.5 * u(0, 1)[:, 0] ** 2

    half = frames.from_ray_frame(normal, seen.v)
    way = 2 * normal[:, 2:] * half - seen.v
    to_ground = (ground[own] - low) / (way * down[own]).sum(dim=1).clamp(min=1e-4)
    to_backdrop = (behind[own] + seen.place[:, 2]) / (-way[:, 2]).clamp(min=1e-4)
    place = seen.place + torch.minimum(to_ground, to_backdrop)[:, None] * way
    facing = torch.where((to_ground < to_backdrop)[:, None], -down[own], down.new_tensor([0.0, 0.0, 1.0]))
    to_flash = seen.flash[own] - place
    far = to_flash.norm(dim=1)
    received = strength[own] * seen.open * (to_flash * facing).sum(dim=1).clamp(min=0) / far**3
    light = albedo[own] * received[:, None]

    rough = surface.roughness.clamp(min=_SHARPEST)
    mirror = 2 * normal[:, 2:] * normal - normal.new_tensor([0.0, 0.0, 1.0])
    irradiance = 4 * normal[:, 2] * rough**4  # one over π times the density of facets that mirror exactly
    ior = _facet_ior(surface.specular, surface.ior)
    return shade.stokes(normal, 0 * light, surface.specular * light, rough, ior, mirror, irradiance)


def _facet_ior(specular: Tensor, ior: Tensor) -> Tensor:
    """The index that F0 (M, 3) belongs to where it is more than the body's (M,), as in `light_transport.py`."""
    root = torch.maximum(specular.mean(dim=1), fresnel.normal_reflectance(ior)).sqrt()
    return (1 + root) / (1 - root)


def _density(normal: Tensor, way: Tensor) -> Tensor:
    """Of `_ways`, per steradian: normal and way (N, 3) in the frame of each ray."""
    density = _SPREAD / RAYS * (normal * way).sum(dim=1).clamp(min=0) / pi
    half = F.normalize(way + way.new_tensor([0.0, 0.0, 1.0]), dim=1)
    cosine = (normal * half).sum(dim=1).clamp(min=0)
    for number, alpha in _LOBES:
        facets = brdf.ggx_distribution(cosine, alpha) * cosine / (4 * half[:, 2].clamp(min=1e-3))
        density = density + number / RAYS * facets
    return density


def smooth(stokes: Tensor, mask: Tensor) -> Tensor:
    """(3, B, H, W, 3) averaged over 3 × 3 pixels of the object (B, H, W)."""
    count, height, width = mask.shape
    flat = stokes.permute(1, 0, 4, 2, 3).reshape(count, 9, height, width)
    inside = mask[:, None].to(stokes.dtype)
    share = F.avg_pool2d(inside, 3, 1, 1).clamp(min=0.1)
    mean = F.avg_pool2d(flat * inside, 3, 1, 1) / share * inside
    return mean.reshape(count, 3, 3, height, width).permute(1, 0, 3, 4, 2)
