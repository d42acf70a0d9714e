"""Gloss of a ball of one or two materials: what a network got wrong is pooled, and bounded by highlights."""

from dataclasses import replace

import numpy as np
import pytest

from polcap.image_values import Floats, Quality
from polcap.optics import frames, shade
from polcap.stage_values import Cues, SurfaceMaps
from polcap.stages.infer import highlights
from tests import scenes

ROUGH, F0 = 0.4, 0.042


@pytest.fixture(scope="module")
def ball() -> Cues:
    return scenes.seen(textured=False)


def lit(ball: Cues, *values: Floats | float) -> tuple[SurfaceMaps, Cues]:
    """The ball's light for an albedo and a roughness, and the maps of a network that predicts another roughness.

    All three `values` are maps (H, W) or the same everywhere.
    """
    albedo, roughness, predicted = (np.broadcast_to(value, ball.mask.shape) for value in values)
    normal, mask = scenes.truth()
    light = np.zeros_like(normal)
    light[..., 2] = 1
    color, f0 = np.repeat(albedo[..., None], 3, -1), np.full_like(normal, F0)
    radiance = shade.stokes(normal, color, f0, roughness, 1.5 * np.ones_like(albedo), light, np.ones_like(albedo))[0]
    seen = replace(ball, radiance=(radiance * ball.mask[..., None]).astype(np.float32))
    maps = SurfaceMaps(
        normal=np.asarray(frames.from_ray_frame(normal, ball.rays), np.float32),
        diffuse=color.astype(np.float32), specular=f0.astype(np.float32), roughness=predicted.astype(np.float32),
        depth_prior=None, confidence=np.zeros_like(predicted), mask=mask & ball.mask, view=ball.view,
        estimator="network",
    )  # fmt: skip
    return maps, seen


def found(maps: SurfaceMaps, seen: Cues) -> Floats:
    return highlights.pool_gloss(maps, seen).roughness[maps.mask]


def error(maps: SurfaceMaps, seen: Cues) -> float:
    """Expected error of the ball's roughness, the same in all its pixels."""
    stated = highlights.pool_gloss(maps, seen).roughness_error
    assert stated is not None and np.ptp(stated[maps.mask]) < 1e-6
    return float(stated[maps.mask][0])


def test_a_bright_highlight_lowers_the_roughness_of_its_whole_material(ball: Cues) -> None:
    roughness = found(*lit(ball, 0.2, ROUGH, 0.55))
    assert np.ptp(roughness) < 1e-4
    assert roughness.mean() == pytest.approx(ROUGH, abs=0.04)


def test_a_roughness_that_its_highlight_allows_stays(ball: Cues) -> None:
    assert found(*lit(ball, 0.2, ROUGH, 0.3)) == pytest.approx(0.3, abs=1e-3)


def test_a_white_albedo_hides_a_weak_highlight(ball: Cues) -> None:
    assert found(*lit(ball, 0.8, 0.65, 0.8)) == pytest.approx(0.8, abs=1e-3)


def test_a_whiter_albedo_hides_a_highlight_without_a_jump(ball: Cues) -> None:
    albedos = np.linspace(0.2, 0.8, 31)
    roughness = np.array([found(*lit(ball, a, 0.5, 0.62)).mean() for a in albedos])
    assert np.ptp(roughness) > 0.05
    assert np.abs(np.diff(roughness)).max() < 0.01


def test_speckle_of_the_network_is_pooled(ball: Cues) -> None:
    speckle = 0.35 + 0.02 * np.random.default_rng(0).standard_normal(ball.mask.shape)
    assert found(*lit(ball, 0.2, ROUGH, speckle)).std() < 0.02 * 0.7


def test_two_materials_keep_their_two_roughnesses(ball: Cues) -> None:
    left = np.indices(ball.mask.shape)[1] < scenes.CENTER[0]
    roughness = np.where(left, 0.35, 0.7)
    maps, seen = lit(ball, np.where(left, 0.1, 0.5), roughness, roughness)
    both = highlights.pool_gloss(maps, seen).roughness
    assert np.abs(both - roughness)[maps.mask].max() < 0.03


def test_the_roughness_is_less_certain_without_a_highlight_or_with_a_clipped_one(ball: Cues) -> None:
    shown, hidden = (lit(ball, albedo, 0.65, 0.65) for albedo in (0.05, 0.8))
    flagged = replace(
        shown[1], quality=np.where(shown[1].radiance.sum(-1) > 0.3, np.uint8(Quality.CLIPPED), np.uint8(0))
    )
    clipped = shown[0], flagged
    of_shown, of_hidden, of_clipped = (error(*of) for of in (shown, hidden, clipped))
    assert of_hidden == of_clipped > 2 * of_shown > 0.1


@pytest.mark.parametrize("said", [0.3, 0.8])
def test_a_material_that_only_faces_the_flash_gets_a_usual_roughness(ball: Cues, said: float) -> None:
    """A facing plane shows no place without highlight, so the roughness of usual materials counts, too."""
    maps, seen = lit(ball, 0.2, said, said)
    facing = frames.from_ray_frame(np.broadcast_to([0.0, 0, 1], maps.normal.shape), ball.rays)
    flat = highlights.pool_gloss(replace(maps, normal=facing), seen)
    roughness, whole = flat.roughness[maps.mask], found(maps, seen)
    assert np.abs(roughness - 0.5).max() < 0.7 * np.abs(whole - 0.5).min()
    assert error(replace(maps, normal=facing), seen) > 0.12


def test_the_roughness_is_less_certain_where_the_normals_are(ball: Cues) -> None:
    maps, seen = lit(ball, 0.05, 0.65, 0.65)
    unsure = replace(maps, confidence=np.where(maps.mask, np.float32(20), np.float32(0)))
    assert error(unsure, seen) > 1.5 * error(maps, seen)


@pytest.mark.parametrize(("predicted", "common"), [(0.06, 0.0435), (0.16, 0.16)])
def test_f0_is_that_of_common_surfaces_unless_it_is_far_above(ball: Cues, predicted: float, common: float) -> None:
    maps, seen = lit(ball, 0.2, ROUGH, 0.3)
    bright = replace(maps, specular=np.full_like(maps.specular, predicted))
    assert highlights.pool_gloss(bright, seen).specular[maps.mask] == pytest.approx(common, abs=1e-4)


def test_an_empty_mask_has_no_materials(ball: Cues) -> None:
    maps, seen = lit(ball, 0.2, ROUGH, 0.3)
    nothing = replace(maps, mask=np.zeros_like(maps.mask))
    assert highlights.pool_gloss(nothing, seen) is nothing
