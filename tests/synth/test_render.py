"""Diffuse polarization follows the law of the surface model, rough or smooth."""

import msgspec
import numpy as np
import pytest

from polcap.image_values import Floats, View
from polcap.optics import body, frames
from polcap.synth import render, scenes
from polcap.synth.scene_materials import Coat

SIZE = 48


@pytest.mark.parametrize(("roughness", "law"), [(0.5, "smooth"), (0.3, "rough"), (0.6, "rough")])
def test_dolp_of_diffuse_light_follows_the_law(roughness: float, law: str) -> None:
    plain = msgspec.structs.replace(
        scenes.random_scene(3, "clusters").coat.materials[0], roughness=(roughness, roughness), specular=0.0, ior=1.5
    )
    scene = msgspec.structs.replace(
        scenes.random_scene(3, "clusters"), coat=Coat((plain,)), position=(0.0, 0.0, -0.7), chart=None, law=law
    )
    view = View(focal=200.0, center=(SIZE / 2, SIZE / 2), scale=1.0)
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    seen = render.gbuffer(scene, view, SIZE, SIZE)
    s0, s1, s2 = (part.sum(axis=-1) for part in render.stokes(scene, view, x, y))
    normal: Floats = frames.to_ray_frame(seen.normal, frames.rays(view, SIZE, SIZE))
    lit = seen.mask & (s0 > 0.01) & (normal[..., 2] > 0.1)
    assert lit.sum() > 200
    alpha = roughness**2 if law == "rough" else 0.0
    expected = body.dolp(normal[..., 2][lit].astype(np.float64), alpha, 1.5)
    np.testing.assert_allclose(np.hypot(s1, s2)[lit] / s0[lit], expected, atol=2e-4)
