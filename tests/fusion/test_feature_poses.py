"""Poses without a board: a patterned object gives them, up to scale; one without pattern is refused."""

from dataclasses import replace as replace_field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from msgspec import UNSET
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from polcap.capture_values import ShotOrder
from polcap.errors import CaptureError
from polcap.fusion import feature_poses, object_features
from polcap.fusion.object_features import ObjectFeatures
from polcap.fusion.poses import SessionPoses
from polcap.image_values import View
from polcap.stage_values import OrderTest
from polcap.synth import render, scene_materials
from polcap.synth.distance_fields import Cluster
from polcap.synth.scene_materials import Coat, Material
from tests.fusion import board_views

SHAPE = Cluster(((0, 0, 0, 0.03), (0.022, 0.01, 0.01, 0.02), (-0.02, -0.005, 0.012, 0.018)))
PATTERN = Coat((Material((0.7, 0.6, 0.5), (0.2, 0.3, 0.25), "noise", size=0.004, roughness=(0.5, 0.5), seed=3),))
SIDE = 400  # px
VIEW = View(2600.0, ((SIDE - 1) / 2, (SIDE - 1) / 2), 1.0)
DISTANCE = 0.7  # m
SWAPPED = ShotOrder((1, 0))
TURNS = {f"view{k + 1:02d}": board_views.pose(15 * k) for k in range(8)}


def maps(name: str, coat: Coat, seed: int = 0) -> Any:
    """Traced maps of a view, with normals that err by 6°, as far as the poses need them."""
    scene = replace(board_views.scene(TURNS[name], SHAPE), coat=coat, board=UNSET, cast_shadows=False)
    seen = render.gbuffer(scene, VIEW, SIDE, SIDE)
    diffuse = np.zeros((*seen.mask.shape, 3))
    diffuse[seen.mask] = scene_materials.evaluate(coat, seen.position[seen.mask], seen.facing[seen.mask])[0]
    random = np.random.default_rng([seed, list(TURNS).index(name)])
    diffuse += 0.003 * random.normal(size=diffuse.shape)
    normal = seen.normal + np.radians(6.0) / np.sqrt(2) * random.normal(size=diffuse.shape)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    lean = seen.normal[..., 0] + 1j * seen.normal[..., 1]  # of a rounded object
    stokes = np.stack([seen.mask + 0.0, 0.3 * (lean**2).real, 0.3 * (lean**2).imag])[..., None] * np.ones(3)
    confidence = np.full(seen.mask.shape, 6.0)
    return SimpleNamespace(
        mask=seen.mask, diffuse=diffuse, normal=normal, view=VIEW, order=None, stokes=stokes, confidence=confidence
    )


def features(one: Any, metres_per_px: float | None = None, as_stated: bool = True) -> ObjectFeatures:
    """Features in these maps, of a view whose outline fits the stated order of its angles, or another one."""
    radiance = board_views.stack(np.zeros((4, 4, 3)))
    color = replace_field(board_views.COLOR, metres_per_px=metres_per_px)
    outline = SimpleNamespace(as_stated=as_stated, best=SWAPPED, rival=None, concentration=0.9)
    calibration: Any = SimpleNamespace(outline=outline)
    return object_features.find(replace_field(radiance, view=VIEW), color, one, calibration, one, one)


def solve(seen: dict[str, Any], metres_per_px: float | None = None) -> SessionPoses:
    named = {name: features(one, metres_per_px) for name, one in seen.items()}
    camera = replace_field(board_views.capture(VIEW.focal), principal_px=VIEW.center, size_px=(SIDE, SIDE))
    return feature_poses.solve(named, camera)


@pytest.fixture(scope="module")
def patterned() -> dict[str, Any]:
    return {name: maps(name, PATTERN) for name in TURNS}


def test_a_patterned_object_gives_turns_to_a_third_of_a_degree(patterned: dict[str, Any]) -> None:
    found = solve(patterned)
    assert not found.left_out and not found.metric
    assert found.views["view01"].pose.rotation[0, 0] > 0.99  # the frame begins at the first view
    first = TURNS["view01"].rotation.T @ found.views["view01"].pose.rotation
    for name, one in found.views.items():
        wrong = Rotation.from_matrix(one.pose.rotation @ first.T @ TURNS[name].rotation.T).magnitude()
        assert np.degrees(wrong) < 0.35, name
        assert one.residual_px < 1.0


def test_the_chart_gives_the_scale(patterned: dict[str, Any]) -> None:
    some = {name: patterned[name] for name in list(TURNS)[:6]}
    found = solve(some, DISTANCE / VIEW.focal)
    assert found.metric
    for one in found.views.values():
        assert np.linalg.norm(one.pose.center) == pytest.approx(DISTANCE, rel=0.1)  # of a point on the axis


def test_a_view_of_something_else_is_left_out(patterned: dict[str, Any]) -> None:
    other = Coat((replace(PATTERN.materials[0], seed=77),))
    found = solve({**{name: patterned[name] for name in list(TURNS)[:6]}, "view07": maps("view07", other)})
    assert list(found.left_out) == ["view07"]
    assert "turn it by 15° or less" in found.left_out["view07"]


def test_a_view_with_swapped_angles_is_refused_with_the_remedy(patterned: dict[str, Any]) -> None:
    with pytest.raises(CaptureError, match=r"The outline fits the order 90°, 0° .*Rename the folders 0° to 90°"):
        features(patterned["view01"], as_stated=False)


def test_a_view_whose_angles_the_network_contradicts_is_refused(patterned: dict[str, Any]) -> None:
    one = patterned["view01"]
    with pytest.raises(CaptureError, match=r"2.0 times smaller errors for the order 90°, 0°"):
        features(SimpleNamespace(**{**vars(one), "order": OrderTest(SWAPPED, 0.5)}))
    assert len(features(SimpleNamespace(**{**vars(one), "order": OrderTest(SWAPPED, 2.0)})).ray)


def test_an_object_without_pattern_is_refused() -> None:
    plain = {name: maps(name, board_views.PALE) for name in list(TURNS)[:4]}
    with pytest.raises(CaptureError, match=r"no view shows a board, and 0 of 4 views have 12 features"):
        solve(plain)
