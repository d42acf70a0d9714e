"""A ball's place, its flash and the ring's zero are found in rendered light, under both laws."""

from typing import Literal

import msgspec
import numpy as np
import pytest

from polcap.calibrate import ball_light
from polcap.calibrate.ball_outline import Ball
from polcap.image_values import Floats, View
from polcap.optics import frames, mueller
from polcap.synth import render, scenes
from polcap.synth.distance_fields import Cluster
from polcap.synth.scene_materials import Coat

VIEW = View(focal=560.0, center=(80.0, 48.0), scale=2.0)
SHAPE = (112, 112)
PLACE, RADIUS, FLASH = (-0.03, -0.01, -0.7), 0.055, (0.1, 0.04, 0.0)


def light(law: Literal["smooth", "rough"], roughness: float) -> Floats:
    """Stokes parameters (3, H, W) of a ball under a flash 10 cm off the lens, four rays per pixel."""
    scene = scenes.random_scene(3, "ball")
    gloss = msgspec.structs.replace(scene.coat.materials[0], roughness=(roughness, roughness))
    scene = msgspec.structs.replace(
        scene, shape=Cluster(((0.0, 0.0, 0.0, RADIUS),)), coat=Coat((gloss,)), position=PLACE, light=FLASH, law=law,
        chart=None,
    )  # fmt: skip
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    steps = [render.stokes(scene, VIEW, x + dx, y + dy) for dx in (-0.25, 0.25) for dy in (-0.25, 0.25)]
    return np.mean(steps, axis=0).sum(axis=-1).astype(np.float64)


def true_ball() -> Ball:
    distance = float(np.linalg.norm(PLACE))
    return Ball(np.array(PLACE) / distance, float(np.arcsin(RADIUS / distance)))


@pytest.mark.parametrize(("law", "roughness"), [("smooth", 0.2), ("rough", 0.4)])
def test_edge_and_flash_are_found_in_the_light(law: Literal["smooth", "rough"], roughness: float) -> None:
    true = true_ball()
    off = true.direction + np.array([0.6, -0.6, 0.0]) / VIEW.focal
    guess = Ball(off / np.linalg.norm(off), true.angular_radius - 0.5 / VIEW.focal)  # as of a mask
    found = ball_light.fit(light(law, roughness)[0], guess, VIEW)
    assert VIEW.focal * np.abs(found.ball.direction - true.direction).max() < 0.1  # px
    assert VIEW.focal * abs(found.ball.angular_radius - true.angular_radius) < 0.15
    np.testing.assert_allclose(found.flash * np.linalg.norm(PLACE), FLASH[:2], atol=0.005)  # m


@pytest.mark.parametrize("error_deg", [-2.0, 0.0, 2.0])
def test_a_wrong_zero_of_the_ring_is_found(error_deg: float) -> None:
    seen = light("smooth", 0.3)
    stated = np.radians([0.0, 45.0, 90.0])
    rays = frames.rays(VIEW, *SHAPE)
    axis = np.stack([frames.axis_on_ray(angle + np.radians(error_deg), rays) for angle in stated])
    shots = np.einsum("khws,shw->khw", mueller.analyzer(axis), seen)
    solved = np.einsum("sk,khw->shw", np.linalg.inv(mueller.analyzer(stated)), shots)
    ring = ball_light.read_ring(solved, true_ball(), VIEW, np.ones(SHAPE, bool))
    assert np.degrees(ring.offset) == pytest.approx(error_deg, abs=0.3)
