"""The synthetic camera's renderer against Mitsuba 3 `pplastic`: same shapes, same flash, off axis, direct light only.

Both are Baek's model, and nothing is fitted: index, k_s, α and the light's intensity are the same numbers.
"""

from typing import Any

import numpy as np
import plastic
import pytest

from polcap.image_values import Floats, View
from polcap.optics import frames
from polcap.synth import distance_fields, forward_camera, render, trace
from polcap.synth.render import Scene
from polcap.synth.scene_materials import Coat, Material
from polcap.training import random_shapes

SIDE, SAMPLES, FINE, FOV = 96, 144, 4, 36.0
ALBEDO, ALPHA, IOR, STRENGTH = 0.6, 0.16, 1.55, 0.8
VIEW = View(SIDE / 2 / np.tan(np.radians(FOV / 2)), ((SIDE - 1) / 2,) * 2, 1)
LIGHT = (0.04, 0.06, 0.0)
BALL, BALL_AT = distance_fields.Cluster(((0, 0, 0, 0.085),)), (0.11, 0.09, -0.7)
WAVES = ((0.07, 5.0, 1.0, 2.0, 0.3), (0.05, -2.0, 6.0, 1.0, 1.1), (0.04, 1.0, -3.0, 7.0, 2.0))
BUMPS, BUMPS_AT = distance_fields.Bumps((0.09, 0.075, 0.08), WAVES), (-0.11, -0.1, -0.72)
COAT = Coat((Material((ALBEDO,) * 3, (ALBEDO,) * 3, "plain", roughness=(ALPHA**0.5,) * 2, specular=STRENGTH, ior=IOR),))
GREY, FULL = {"type": "uniform", "value": ALBEDO}, {"type": "uniform", "value": STRENGTH}
MATERIAL = plastic.plastic(ALPHA, IOR, GREY, FULL)


def scene(shape: distance_fields.Shape, position: trace.Vector) -> Scene:
    return Scene(shape, COAT, position, light=LIGHT, chart=None, backdrop_albedo=0.0)


@pytest.fixture(scope="module")
def mi() -> Any:
    mitsuba = pytest.importorskip("mitsuba", reason="mitsuba is not installed (extra [test])")
    mitsuba.set_variant("scalar_spectral_polarized")  # the one polarized variant that needs no LLVM library
    return mitsuba


def theirs(mi: Any, body: Any, reference: float) -> Floats:
    """(3, H, W) in our frame. `reference` is the squared distance at which a white plane is to have S0 = 1."""
    found = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "stokes", "nested": {"type": "direct"}},
            "sensor": plastic.camera(mi, VIEW, SIDE, "stratified", SAMPLES),
            "light": {"type": "point", "position": list(LIGHT), "intensity": np.pi * reference},
            "body": body,
        }
    )
    image = np.array(mi.render(found))[..., -12::3]  # S0.R … S3.R are the last channels
    assert np.abs(image[..., 3]).max() < 1e-3 * image[..., 0].max()  # no circular part
    return plastic.in_ray_frame(image, VIEW)


def ours(which: Scene) -> tuple[Floats, Floats]:
    """Every sample of every pixel's square: Stokes parameters (F², 3, H, W), and cos of the zenith, 0 outside."""
    stokes, facing = [], []
    for x, y in forward_camera.pixel_samples(SIDE, SIDE, FINE):
        v = frames.rays_at(VIEW, x, y).reshape(-1, 3)
        stokes.append(render.stokes(which, VIEW, x, y)[..., 0])
        hits = trace.trace(which.shape, which.position, which.turn, v)
        cosine = np.zeros(SIDE * SIDE)
        cosine[hits.index] = frames.dot(hits.normal, v[hits.index])
        facing.append(cosine.reshape(SIDE, SIDE))
    return np.array(stokes), np.array(facing)


def tessellated(mi: Any, shape: distance_fields.Bumps, at: trace.Vector, rings: int = 250) -> Any:
    """The waved ellipsoid as triangles a millimetre across, with its own normals at their corners."""
    unit, faces = random_shapes._sphere(rings, 2 * rings)
    raised = np.sum([a * np.sin(unit @ [x, y, z] + phase) for a, x, y, z, phase in shape.waves], axis=0)
    point = unit * (1 + raised)[:, None] * shape.size
    normal = trace.gradient(shape, point)
    settings = mi.Properties()
    settings["bsdf"] = mi.load_dict(MATERIAL)
    mesh = mi.Mesh("bumps", len(point), len(faces), has_vertex_normals=True, props=settings)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = (point + at).astype(np.float32).ravel()
    parameters["vertex_normals"] = normal.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters.update()
    return mesh


@pytest.mark.parametrize("kind", ["ball", "bumps"])
def test_stokes_parameters_are_those_of_another_renderer(mi: Any, kind: str) -> None:
    if kind == "ball":
        which = scene(BALL, BALL_AT)
        body = {"type": "sphere", "center": list(BALL_AT), "radius": 0.085, "bsdf": MATERIAL}
    else:
        which, body = scene(BUMPS, BUMPS_AT), tessellated(mi, BUMPS, BUMPS_AT)
    reference = float(np.sum((np.array(LIGHT) - which.position) ** 2))
    other = theirs(mi, body, reference)
    fine, facing = ours(which)
    here = fine.mean(axis=0)
    least_cosine = np.cos(np.radians(70))
    lit = (facing > least_cosine).all(axis=0) & (fine[:, 0] > 0).all(axis=0)
    assert lit.sum() > 250
    s0 = other[0][lit] / here[0][lit] - 1
    polarized = np.maximum(np.hypot(here[1], here[2]), 0.003 * here[0])  # S0·DoLP, which is 0 where n = v
    linear = np.hypot(*(other - here)[1:, lit]) / polarized[lit]
    tilted = lit & (polarized > 0.02 * here[0])
    turn = np.degrees(np.angle((other[1] + 1j * other[2]) / (here[1] + 1j * here[2]))[tilted]) / 2
    print(f"{kind}: S0 {np.abs(s0).max():.5f}, S1 and S2 {linear.max():.4f}, AoLP {np.abs(turn).max():.3f}°")
    assert np.abs(s0).max() < 0.01
    assert linear.max() < 0.03 and np.abs(turn).max() < 0.5
