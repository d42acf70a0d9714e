"""Distance fields never exceed the true distance, and their surfaces are where geometry puts them."""

from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polcap.optics import frames
from polcap.synth import trace
from polcap.synth.distance_fields import Bumps, Cluster, Shape, Vase
from polcap.synth.scenes import random_scene

SHAPES: dict[str, Shape] = {
    "cluster": Cluster(((0, 0, 0, 0.03), (0.04, 0.01, 0, 0.02), (0, -0.03, 0.02, 0.025))),
    "bumps": Bumps((0.05, 0.06, 0.07), ((0.05, 4, 1, 0, 0.3), (0.04, 0, 3, 5, 1.0))),
    "vase": Vase(0.14, ((0, 0.03), (0.4, 0.055), (0.85, 0.024), (1, 0.034)), 9, 0.05, ((0.0008, 90, 40, 10, 1.0),)),
}


def rays(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from a sphere of 0.3 m to points near the middle."""
    random = np.random.default_rng(seed)
    origin = 0.3 * frames.unit(random.normal(size=(count, 3)))
    return origin, frames.unit(random.uniform(-0.06, 0.06, (count, 3)) - origin)


def surface(shape: Shape, seed: int, count: int) -> np.ndarray:
    origin, direction = rays(seed, count)
    index, distance = trace._march(shape, origin, direction, 0.0)
    return origin[index] + direction[index] * distance[:, None]


@pytest.mark.parametrize("name", SHAPES)
def test_a_step_of_the_stated_distance_never_enters_the_shape(name: str) -> None:
    shape = SHAPES[name]
    points = surface(shape, 0, 3000)
    assert len(points) > 600 and np.linalg.norm(points, axis=-1).max() <= shape.radius
    reach = np.repeat([0.003, 0.02, 0.08, 0.2], 100)[:, None]
    outside = points[:400] + np.random.default_rng(1).normal(size=(400, 3)) * reach
    promised = shape.distance(outside)
    nearest = np.linalg.norm(outside[:, None] - points[None], axis=-1).min(axis=1)
    assert (promised <= nearest + 1e-6)[promised > 0].all()


@pytest.mark.parametrize("name", SHAPES)
def test_rays_end_on_the_front_of_the_surface(name: str) -> None:
    shape = SHAPES[name]
    side = np.linspace(-0.1, 0.1, 60)
    v = frames.unit(np.stack(np.meshgrid(side, side, [1.0]), axis=-1).reshape(-1, 3))
    hits = trace.trace(shape, (0.0, 0.0, -0.8), Rotation.from_rotvec([20, 30, 0], degrees=True), v)
    assert len(hits.index) > 300
    assert np.abs(shape.distance(hits.local)).max() < 2e-6
    np.testing.assert_allclose(np.linalg.norm(hits.normal, axis=-1), 1.0, rtol=1e-9)
    assert (
        frames.dot(hits.normal, v[hits.index]).min() > -0.02
    )  # a ray that grazes within 1 µm may hit just behind the outline
    np.testing.assert_allclose(hits.point, -v[hits.index] * hits.distance[:, None], atol=1e-12)


def test_sphere_hits_solve_the_quadratic_equation() -> None:
    ball, middle = Cluster(((0, 0, 0, 0.06),)), np.array([0.05, -0.02, -0.7])
    v = frames.unit(-np.array([[0.05, -0.02, -0.7], [0.08, 0.0, -0.7], [0.2, 0.2, -0.7]]))
    hits = trace.trace(ball, tuple(middle), Rotation.from_rotvec([0.0, 40, 0], degrees=True), v)
    b = -(v @ middle)
    root = b**2 - middle @ middle + 0.06**2
    assert hits.index.tolist() == [0, 1] and root[2] < 0
    np.testing.assert_allclose(hits.distance, b[:2] - np.sqrt(root[:2]), atol=2e-6)
    expected = (-v[:2] * (b[:2] - np.sqrt(root[:2]))[:, None] - middle) / 0.06
    np.testing.assert_allclose(hits.normal, expected, atol=1e-4)


def test_a_ball_hides_another_from_a_light_behind_it() -> None:
    front = np.array([0.0, 0.04, 0.06])
    pair = Cluster(((0, 0, 0, 0.03), (*front, 0.012)))
    place, still = (0.0, 0.0, -0.7), Rotation.identity()
    hits = trace.trace(pair, place, still, np.array([[0.0, 0.0, 1.0]]))  # the middle of the rear ball
    np.testing.assert_allclose(hits.point, [[0, 0, -0.67]], atol=2e-6)
    behind = hits.point[0] + 5 * (front + place - hits.point[0])
    point = hits.point + trace.LIFT * hits.normal
    assert trace.in_shadow(pair, place, still, point, tuple(behind)).tolist() == [True]
    assert trace.in_shadow(pair, place, still, point, (behind[0], -behind[1], behind[2])).tolist() == [False]


@pytest.mark.parametrize("kind", ["bumps", "clusters", "vase"])
def test_a_seed_gives_one_scene(kind: Literal["bumps", "clusters", "vase"]) -> None:
    assert random_scene(4, kind) == random_scene(4, kind) != random_scene(5, kind)
