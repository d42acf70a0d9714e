"""Traced flash light on a mesh, for the evaluation's pictures: direct, with shadows, and after one diffuse bounce.

Rays find the points that the flash reaches, and the diffuse light that each point receives from other points
(`synth/interreflection.py`). A point reflects this light diffusely and by its facets.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi
from typing import Any

import numpy as np

from polcap.image_values import Bools, Floats, Indices
from polcap.optics import brdf, frames, fresnel, shade
from polcap.optics.body import SMOOTH, Law
from polcap.optics.mesh_tracer import Tracer
from polcap.optics.morphology import masked_mean
from polcap.optics.namespace import array_namespace
from polcap.synth import interreflection
from polcap.synth.interreflection import LIFT

_HEMISPHERE_RAYS, _MIRROR_RAYS = 12, 6  # per place: over the hemisphere, and about the mirror direction
_SMOOTH = 0.004  # 1σ of the average of traced light, picture sides

Albedo = Callable[[Floats, Floats], Floats]  # places, facing directions (M, 3) -> diffuse albedo (M, 3)


@dataclass(frozen=True)
class LitPose:
    """Position of mesh and flash in the camera frame: point = rotation @ vertex + translation."""

    rotation: Floats  # (3, 3)
    translation: Floats  # (3,)
    flash: Floats  # (3,) camera frame
    strength: float  # S0 of a white plane that faces the flash at distance 1


@dataclass(frozen=True)
class SurfacePoints:
    """Positions, normals and material of a mesh at the M visible pixels of a picture."""

    mask: Bools  # (H, W)
    position: Floats  # (M, 3) mesh frame
    flat: Floats  # (M, 3) geometric normals of the triangles, mesh frame, towards the camera
    normal: Floats  # (M, 3) in the frame of each ray, with relief
    rays: Floats  # (M, 3) camera frame, surface to camera
    diffuse: Floats  # (M, 3)
    specular: Floats  # (M, 3)
    roughness: Floats  # (M,)
    ior: float
    law: Law = SMOOTH

    def take(self, which: Indices) -> "SurfacePoints":
        """Select the points `which`; mask, ior and law do not change."""
        taken = {name: value[which] for name, value in vars(self).items() if name not in ("mask", "ior", "law")}
        return replace(self, **taken)


def flash_light(tracer: Tracer, place: Floats, flat: Floats, pose: LitPose) -> tuple[Floats, Floats]:
    """Direct flash light at points (M, 3) of a mesh in its frame, as of `interreflection.flash_light`."""
    flash = (pose.flash - pose.translation) @ pose.rotation
    return interreflection.flash_light(tracer, place, flat, flash, pose.strength)


def stokes(tracer: Tracer, places: SurfacePoints, pose: LitPose, albedo: Albedo, rng: np.random.Generator) -> Floats:
    """Stokes parameters (3, M, 3) of a mesh under the flash, with shadows and one bounce, in the frame of each ray."""
    to_flash, irradiance = flash_light(tracer, places.position, places.flat, pose)
    toward = frames.to_ray_frame(to_flash @ pose.rotation.T, places.rays)
    direct = _shade(places, places.diffuse, places.specular, places.ior, toward, irradiance)
    indirect = IndirectLight(tracer, places, pose, albedo)
    return np.asarray(direct + indirect.diffuse(rng) + indirect.mirrored(rng))


def _shade(
    places: SurfacePoints, diffuse: Floats, specular: Floats, ior: Floats | float, toward: Floats, irradiance: Floats
) -> Floats:
    lit = places.roughness, np.broadcast_to(ior, irradiance.shape), toward, irradiance
    return np.asarray(shade.stokes(places.normal, diffuse, specular, *lit, places.law))


class IndirectLight:
    """Flash light that reaches visible places of a mesh by one bounce on its other parts."""

    def __init__(self, tracer: Tracer, places: SurfacePoints, pose: LitPose, albedo: Albedo) -> None:
        self.tracer, self.places, self.pose, self.albedo = tracer, places, pose, albedo

    def diffuse(self, rng: np.random.Generator) -> Floats:
        """Stokes parameters (3, M, 3) of the diffuse reflection of one-bounce light at visible points.

        By rays with a cosine distribution.
        """
        places, count = self.places, len(self.places.normal)
        shift, turn = rng.uniform(0, 1, (count, 2)).T
        received: Floats = np.zeros((count, 3))
        for k in range(_HEMISPHERE_RAYS):
            direction, cosine = draw_directions(places.normal, k, _HEMISPHERE_RAYS, shift, turn)
            hit, incoming = self.light(direction, np.arange(count))
            received[hit] += incoming * fresnel.transmission(np.maximum(cosine[hit], 1e-3), places.ior)[0][:, None]
        # `_shade` lets the share `entered` of light along the normal pass the surface, which `received` has passed
        entered = fresnel.transmission(1.0, places.ior)[0]
        received = self.smooth(received / (_HEMISPHERE_RAYS * entered))
        one = np.ones(count)
        return _shade(places, places.diffuse * received, 0 * places.specular, places.ior, places.normal, one)

    def mirrored(self, rng: np.random.Generator) -> Floats:
        """Specular reflection (3, M, 3) of one-bounce light at visible points, by random facets of the GGX law.

        Facets have an index of their own, `facet_ior`, that gives the F0 of the material. A scaled Fresnel curve of the
        material's index would reflect more than 100 % at grazing angles.
        """
        places, count = self.places, len(self.places.normal)
        ior = facet_ior(places.specular.mean(axis=1), np.full(count, places.ior))
        alpha = places.roughness**2
        (shift, turn), total = rng.uniform(0, 1, (count, 2)).T, np.zeros((3, count, 3))
        for k in range(_MIRROR_RAYS):
            half, cos_h = draw_directions(places.normal, k, _MIRROR_RAYS, shift, turn, alpha)
            cos_d = half[:, 2]
            direction = 2 * cos_d[:, None] * half - [0, 0, 1]
            possible = (cos_d > 0.01) & (np.sum(direction * places.normal, axis=1) > 0.01)
            hit, incoming = self.light(direction, np.flatnonzero(possible))
            density = pi * brdf.ggx_distribution(cos_h[hit], alpha[hit]) * cos_h[hit] / (4 * cos_d[hit])
            irradiance = 1 / np.maximum(density * _MIRROR_RAYS, 1e-9)
            reflected = places.specular[hit] * incoming
            total[:, hit] += _shade(places.take(hit), 0 * incoming, reflected, ior[hit], direction[hit], irradiance)
        return np.stack([self.smooth(part) for part in total])

    def light(self, directions: Floats, which: Indices) -> tuple[Indices, Floats]:
        """Trace a ray from each of the points `which`; returns those with a ray that hits the mesh, and S0 (·, 3).

        `directions` (M, 3) are those of all points, in ray frames. S0 is the diffuse flash light that the hit place
        sends back along the ray.
        """
        tracer, places, pose = self.tracer, self.places, self.pose
        direction = frames.from_ray_frame(directions[which], places.rays[which]) @ pose.rotation
        origin = (places.position + LIFT * tracer.size * places.flat)[which]
        distance, flat = tracer.first_hits(origin, direction)
        hit = np.flatnonzero(np.isfinite(distance) & (distance > LIFT * tracer.size))
        origin, direction, distance, flat = origin[hit], direction[hit], distance[hit, None], flat[hit]
        point = origin + distance * direction
        lit = flash_light(tracer, point, flat, pose)
        return which[hit], interreflection.diffuse_light(lit, flat, -direction, self.albedo(point, flat), places.ior)

    def smooth(self, value: Floats) -> Floats:
        """Smooth bounced light (M, C) by means over nearby pixels of the object."""
        mask = self.places.mask
        image = np.zeros((*mask.shape, value.shape[1]), np.float32)
        image[mask] = value
        return np.asarray(masked_mean(image, mask, _SMOOTH * max(mask.shape))[mask])


def draw_directions(
    normal: Floats, index: int, count: int, shift: Floats, turn: Floats, alpha: Floats | float | None = None
) -> tuple[Floats, Floats]:
    """Direction `index` of `count` about each normal (M, 3): unit vectors (M, 3), and their cosines (M,) with it.

    Their density is the cosine, or with `alpha` that of GGX facets. shift and turn (M,) are random numbers 0…1.
    """
    share = (index + shift) / count
    cosine = np.sqrt(1 - share if alpha is None else (1 - share) / (1 + (alpha**2 - 1) * share))
    azimuth = 2 * pi * (index * 0.618034 + turn)  # the golden ratio spreads them evenly
    e_x, e_y = frames.basis(normal)
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    x, y = (a[:, None] for a in (sine * np.cos(azimuth), sine * np.sin(azimuth)))
    return np.asarray(x * e_x + y * e_y + cosine[:, None] * normal), cosine


def facet_ior(f0: Any, ior: Any) -> Any:
    """Refractive index (M,) of specular facets that gives F0 (M,); at least the material's `ior` (M,)."""
    xp = array_namespace(f0)
    root = xp.sqrt(xp.maximum(f0, fresnel.normal_reflectance(ior)))
    return (1 + root) / (1 - root)
