"""Interreflection within an object, for training: rays are traced once per view, light is computed per step.

The flash is next to the lens, so the camera sees the places that the flash lights. So bounced light comes from pixels
of the same picture. `trace_visibility` traces a few rays from every second pixel of every second row, and stores which
pixels they hit. `bounced_stokes` computes the light along these rays for the materials of a training step.
`mirrored_surroundings` adds the mirror image of a backdrop and of the ground where no part of the object hides them.
`synth/interreflection.py` compares it with the other simulation of this light.
"""

from dataclasses import dataclass
from math import log, pi

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from polcap.image_values import Bools, Floats, Indices
from polcap.optics import brdf, frames, mesh_tracer, shade
from polcap.optics.mesh_tracer import GBuffer, Tracer
from polcap.optics.projection import project
from polcap.synth.interreflection import LIFT
from polcap.training import light_transport
from polcap.training.materials import Surface

COARSE = 2  # pixels of the cache between traced pixels
_COSINE_RAYS = 4  # rays of a pixel, distributed by the cosine about the smooth normal
_LOBES = ((3, 0.5**2), (3, 0.2**2))  # more rays: their number, and the α of the GGX facets that distribute them
RAYS = _COSINE_RAYS + sum(count for count, _ in _LOBES)
SHARP = _LOBES[-1][0]  # the last rays, nearest to the mirror direction
NOWHERE = 65535  # the ray meets a place that the camera does not see
ESCAPED = 65534  # the ray leaves the object
_MIN_ROUGHNESS = 0.2  # smoother surfaces mirror bounced light as if they had this roughness
_SAME_PLACE = 2  # px of the cache: hits nearer than this are the place itself
_MAX_DISTANCE = 0.01  # from a hit to the place that its pixel shows, in longest sides of the object
_LOG_ALBEDO = (log(0.01), log(0.5))  # of backdrop and ground: dark cloth to paper


@dataclass(frozen=True)
class ObjectPixels:
    """The M pixels of all objects of a batch of views, one object after the other."""

    index: Tensor  # (M,) into B·H·W
    owner: Tensor  # (M,) number of the object
    v: Tensor  # (M, 3) ray, camera frame, surface to camera
    normal: Tensor  # (M, 3) camera frame, without bumps
    position: Tensor  # (M, 3) object frame
    place: Tensor  # (M, 3) camera frame, in units of the object's distance
    depth: Tensor  # (M,) units of traced_views.depth_unit, mean 0
    lit: Tensor  # (M,) 1 where the flash reaches, else 0
    met: Tensor  # (M, RAYS) number, among the M, of the pixel that each ray meets; −1 for none
    open: Tensor  # (M,) share of the rays near the mirror direction that leave the object
    hidden: Tensor  # (M,) share of all rays that meet the object


def trace_visibility(
    tracer: Tracer, buffer: GBuffer, pose: light_transport.LitPose, rng: np.random.Generator
) -> tuple[Bools, NDArray[np.uint16]]:
    """Trace one view: the pixels (H, W) that the flash reaches, and the pixels that bounce rays hit.

    The latter are flat indices (H/2, W/2, RAYS); ESCAPED or NOWHERE for rays that hit no pixel of the picture.
    """
    mask = buffer.mask
    height, width = mask.shape
    v = frames.rays(buffer.view, height, width)
    lens = -pose.translation @ pose.rotation
    _, flat = tracer.first_hits(np.broadcast_to(lens, (int(mask.sum()), 3)), -v[mask] @ pose.rotation)
    lit = np.zeros_like(mask)
    lit[mask] = light_transport.flash_light(tracer, buffer.position[mask], flat, pose)[1] > 0

    outward = mesh_tracer.scatter(flat, np.flatnonzero(mask), mask.shape)
    traced = np.zeros_like(mask)
    traced[::COARSE, ::COARSE] = True
    traced &= mask
    normal = frames.to_ray_frame(buffer.normal[traced], v[traced])
    directions = frames.from_ray_frame(_draw_directions(normal, rng), v[traced][:, None])  # (M, RAYS, 3)
    lift = LIFT * tracer.size
    origin = buffer.position[traced] + lift * outward[traced]
    start = np.broadcast_to(origin[:, None], directions.shape).reshape(-1, 3)
    direction = directions.reshape(-1, 3) @ pose.rotation
    distance, _ = tracer.first_hits(start, direction)
    hit = np.flatnonzero(np.isfinite(distance) & (distance > lift))
    point = start[hit] + distance[hit, None] * direction[hit]
    pixel = np.where(np.isfinite(distance), NOWHERE, ESCAPED).astype(np.uint16)
    pixel[hit] = _find_pixels(point, np.argwhere(traced)[hit // RAYS], buffer, pose, tracer.size)
    out = np.full((height, width, RAYS), NOWHERE, np.uint16)
    out[traced] = pixel.reshape(-1, RAYS)
    return lit, out[::COARSE, ::COARSE]


def _draw_directions(normal: Floats, rng: np.random.Generator) -> Floats:
    """Draw random ray directions (M, RAYS, 3) about normals (M, 3), in ray frames, with the density `_density`."""
    turn, shift = rng.uniform(0, 1, (2, len(normal)))
    directions = []
    for number, alpha in ((_COSINE_RAYS, None), *_LOBES):
        for k in range(number):
            axis, _ = light_transport.draw_directions(normal, k, number, shift, turn, alpha)
            directions.append(axis if alpha is None else 2 * axis[:, 2:] * axis - [0, 0, 1])
    return np.stack(directions, axis=1)


def _find_pixels(
    place: Floats, origin: Indices, buffer: GBuffer, pose: light_transport.LitPose, size: float
) -> NDArray[np.uint16]:
    """Flat index of the pixel in which the camera sees each `place` (N, 3) that a bounce ray hits.

    `origin` (N, 2) are row and column of the pixel from which the ray started. NOWHERE if the camera does not see the
    place, or sees it next to `origin`: the grid is too coarse for the direction between neighbors.
    """
    height, width = buffer.mask.shape
    seen = place @ pose.rotation.T + pose.translation
    x, y = np.round(project(buffer.view, seen)).astype(np.int64).T
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = np.where(inside, x, 0), np.where(inside, y, 0)
    inside &= np.linalg.norm(buffer.position[y, x] - place, axis=1) < _MAX_DISTANCE * size
    inside &= np.maximum(np.abs(y - origin[:, 0]), np.abs(x - origin[:, 1])) > _SAME_PLACE
    return np.where(inside & buffer.mask[y, x], y * width + x, NOWHERE).astype(np.uint16)


def bounced_stokes(pixels: ObjectPixels, normal: Tensor, surface: Surface, body: Tensor) -> Tensor:
    """Stokes parameters (3, M, 3) of the flash light that each pixel reflects after one bounce on the object.

    normal (M, 3) has bumps and is in the frames of the rays; body (M, 3) is diffuse S0 under the flash alone. All rays
    are used for diffuse and for mirrored light, weighted by the balance heuristic. The result is noisy; `smooth`
    follows.

    References
    ----------
    Veach & Guibas, Optimally combining sampling techniques for Monte Carlo rendering, SIGGRAPH 1995.
    """
    here, ray = (pixels.met >= 0).nonzero(as_tuple=True)
    there = pixels.met[here, ray]
    v, light = pixels.v[here], body[there] / RAYS
    direction = frames.to_ray_frame(F.normalize(pixels.place[there] - pixels.place[here], dim=1), v)
    irradiance = 1 / (pi * _density(frames.to_ray_frame(pixels.normal[here], v), direction).clamp(min=1e-3))
    n, rough, ior = normal[here], surface.roughness[here].clamp(min=_MIN_ROUGHNESS), surface.ior[here]
    diffuse, specular = surface.diffuse[here] * light, surface.specular[here]
    diffuse_part = shade.stokes(n, diffuse, 0 * specular, rough, ior, direction, irradiance, surface.law.at(here))
    facet_ior = light_transport.facet_ior(specular.mean(dim=1), ior)
    mirrored = shade.stokes(n, 0 * diffuse, specular * light, rough, facet_ior, direction, irradiance)
    return normal.new_zeros(3, len(normal), 3).index_add(1, here, diffuse_part + mirrored)


def mirrored_surroundings(
    pixels: ObjectPixels, flash: Tensor, normal: Tensor, surface: Surface, strength: Tensor
) -> Tensor:
    """Stokes parameters (3, M, 3) of the specular reflection of backdrop and ground in the object's surface.

    Near the outline this is most of the light: reflectance tends to 1 there, and the mirrored ray points away from the
    camera. Each pixel has one ray, about its own normal, weighted by the share of the sharpest rays that leave the
    object. strength (B,) as in `Simulator.photograph`, flash (B, 3) as in `ViewBatch`. A third of the objects have
    neither backdrop nor ground.
    """
    count, device, own = len(strength), normal.device, pixels.owner

    def u(low: float, high: float, columns: int = 1) -> Tensor:
        return low + (high - low) * torch.rand(count, columns, device=device)

    gray, tint = torch.exp(u(*_LOG_ALBEDO)), torch.exp(0.1 * torch.randn(count, 3, device=device))
    albedo = gray * tint * (u(0, 1) > 1 / 3)  # channels differ by 10 %; black for a third of the objects: none
    turn = u(0, 2 * pi)
    down = torch.cat([torch.cos(turn), torch.sin(turn), 0 * turn], dim=1)  # the ground's normal is −down
    below = (pixels.place * down[own]).sum(dim=1)  # depth of each pixel below the lens
    lowest = torch.full((count,), -9.0, device=device).scatter_reduce(0, own, below, "amax")
    # depth of the ground below the lens: the object lies on it; 40 % have none, it is 9 lower, where no ray meets it
    ground = lowest + 9 * (u(0, 1)[:, 0] > 0.6)
    behind = 1.35 + 1.5 * u(0, 1)[:, 0] ** 2  # distance of the backdrop from the lens, mostly near the object

    camera_normal = frames.from_ray_frame(normal, pixels.v)
    direction = 2 * normal[:, 2:] * camera_normal - pixels.v
    to_ground = (ground[own] - below) / (direction * down[own]).sum(dim=1).clamp(min=1e-4)
    to_backdrop = (behind[own] + pixels.place[:, 2]) / (-direction[:, 2]).clamp(min=1e-4)
    place = pixels.place + torch.minimum(to_ground, to_backdrop)[:, None] * direction
    facing = torch.where((to_ground < to_backdrop)[:, None], -down[own], down.new_tensor([0.0, 0.0, 1.0]))
    to_flash = flash[own] - place
    distance = to_flash.norm(dim=1)
    received = strength[own] * pixels.open * (to_flash * facing).sum(dim=1).clamp(min=0) / distance**3
    light = albedo[own] * received[:, None]

    rough = surface.roughness.clamp(min=_MIN_ROUGHNESS)
    mirror = 2 * normal[:, 2:] * normal - normal.new_tensor([0.0, 0.0, 1.0])
    # cancels D / (4 cos θ) of the GGX law in the mirror direction, D = 1 / (π rough⁴), so S0 is F · G · light
    unit_lobe = 4 * normal[:, 2] * rough**4
    ior = light_transport.facet_ior(surface.specular.mean(dim=1), surface.ior)
    return shade.stokes(normal, 0 * light, surface.specular * light, rough, ior, mirror, unit_lobe)


def _density(normal: Tensor, direction: Tensor) -> Tensor:
    """Probability density [1/sr] with which `_draw_directions` draws `direction` (N, 3) about `normal` (N, 3)."""
    density = _COSINE_RAYS / RAYS * (normal * direction).sum(dim=1).clamp(min=0) / pi
    half = F.normalize(direction + direction.new_tensor([0.0, 0.0, 1.0]), dim=1)
    cosine = (normal * half).sum(dim=1).clamp(min=0)
    for number, alpha in _LOBES:
        facets = brdf.ggx_distribution(cosine, alpha) * cosine / (4 * half[:, 2].clamp(min=1e-3))
        density = density + number / RAYS * facets
    return density


def smooth(stokes: Tensor, mask: Tensor) -> Tensor:
    """Smooth bounced Stokes parameters (3, B, H, W, 3): mean over the object's pixels (B, H, W) among each 3 × 3."""
    count, height, width = mask.shape
    flat = stokes.permute(1, 0, 4, 2, 3).reshape(count, 9, height, width)
    inside = mask[:, None].to(stokes.dtype)
    share = F.avg_pool2d(inside, 3, 1, 1).clamp(min=0.1)
    mean = F.avg_pool2d(flat * inside, 3, 1, 1) / share * inside
    return mean.reshape(count, 3, 3, height, width).permute(1, 0, 3, 4, 2)
