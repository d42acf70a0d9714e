"""Traced light against closed forms: the integrating sphere, and a shadow where geometry puts it."""

import numpy as np
import pytest

from polcap.image_values import Floats
from polcap.optics import fresnel
from polcap.optics.mesh_tracer import Tracer, Triangles, smooth
from polcap.training import light_transport, random_shapes

_RADIUS, _ALBEDO = 0.5, 0.6


def _sphere() -> Triangles:
    points, faces = random_shapes._sphere(96, 128)
    return smooth(_RADIUS * points, faces)


def _inside(
    roughness: float, specular: float, ior: float
) -> tuple[Tracer, light_transport.SurfacePoints, light_transport.LitPose]:
    """Places inside a sphere, each seen along its normal; the flash in the middle."""
    scene = Tracer(_sphere())
    rng = np.random.default_rng(3)
    out = rng.normal(size=(400, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    distance, flat = scene.first_hits(0 * out, out)
    one = np.ones((len(out), 3))
    places = light_transport.SurfacePoints(
        np.ones((20, 20), bool), out * distance[:, None], flat, np.tile([0.0, 0.0, 1.0], (len(out), 1)), -out,
        _ALBEDO * one, specular * one, np.full(len(out), roughness), ior,
    )  # fmt: skip
    pose = light_transport.LitPose(np.eye(3), np.zeros(3), np.zeros(3), _RADIUS**2)  # irradiance 1 everywhere
    return scene, places, pose


def _albedo(place: Floats, facing: Floats) -> Floats:
    return np.full((len(place), 3), _ALBEDO)


def test_integrating_sphere_spreads_a_bounce_evenly() -> None:
    """Inside a sphere each place receives the mean radiosity: one bounce of ρ adds ρ to an irradiance of 1."""
    scene, places, pose = _inside(0.5, 0.0, 1.0 + 1e-6)  # no interface
    light = light_transport.stokes(scene, places, pose, _albedo, np.random.default_rng(0))
    assert light[0].mean() == pytest.approx(_ALBEDO * (1 + _ALBEDO), rel=0.01)


def test_smooth_surface_mirrors_the_bounce() -> None:
    """A near mirror seen along its normal shows F0 times the wall opposite."""
    ior, f0 = 1.5, 0.1
    scene, places, pose = _inside(0.12, f0, ior)
    indirect = light_transport.IndirectLight(scene, places, pose, _albedo)
    wall = _ALBEDO * fresnel.transmission(1.0, ior)[0] ** 2
    assert indirect.mirrored(np.random.default_rng(0))[0].mean() == pytest.approx(f0 * wall, rel=0.03)


def test_flash_casts_shadows() -> None:
    """A small sphere before a large one: its shadow, seen from the flash, is the cone behind it."""
    points, faces = random_shapes._sphere(48, 64)
    ball = points * 0.05 + [0, 0, 0.8]
    mesh = smooth(np.concatenate([points * 0.5, ball]), np.concatenate([faces, faces + len(points)]))
    scene = Tracer(mesh)
    x = np.linspace(-0.2, 0.2, 201)
    place = np.stack([x, 0 * x, np.sqrt(0.25 - x**2)], axis=1)
    pose = light_transport.LitPose(np.eye(3), np.zeros(3), np.array([0, 0, 2.0]), 1.0)
    _, irradiance = light_transport.flash_light(scene, place, place / 0.5, pose)
    cone = np.tan(np.arcsin(0.05 / 1.2))
    dark = np.abs(x) < cone * (2 - place[:, 2])
    assert np.mean((irradiance == 0) == dark) > 0.97
    lit = ~dark & (irradiance > 0)
    assert irradiance[lit] == pytest.approx(1 / np.sum((place - [0, 0, 2]) ** 2, axis=1)[lit], rel=1e-5)
