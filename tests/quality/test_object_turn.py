"""The turn of an object is measured in degrees, and polarization alone does not look like a turn."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polcap.optics import frames, mueller, shade
from polcap.quality import object_turn
from polcap.quality.rerendering import under_flash
from polcap.stage_values import AngleStack, SurfaceMaps
from tests import scenes


def photographs(turn_deg: tuple[float, float, float], noise: float = 0.003) -> AngleStack:
    """A ball of colored stone that turns about x, y, z from each shot to the next, by as much."""
    y, x = np.mgrid[0 : scenes.HEIGHT, 0 : scenes.WIDTH].astype(float)
    normal, inside = scenes.normals(x, y)
    light = np.broadcast_to([0.0, 0.0, 1.0], normal.shape)
    ones = np.ones(x.shape)
    values = []
    for k, angle in enumerate(scenes.ANGLES):
        u, v, w = np.moveaxis(Rotation.from_euler("xyz", [-k * t for t in turn_deg], degrees=True).apply(
            scenes.RADIUS * normal.reshape(-1, 3)).reshape(normal.shape), -1, 0)  # fmt: skip
        grey = scenes.texture(u + 0.4 * w, v - 0.3 * w)
        albedo = grey * np.stack([1 + 0.4 * np.sin(0.21 * u + 0.3 * w), ones, 1 + 0.4 * np.sin(0.25 * v - 0.2 * w)], -1)
        stokes = shade.stokes(normal, albedo, 0.04 * np.ones_like(albedo), 0.5 * ones, 1.5 * ones, light, ones)
        values.append(np.tensordot(mueller.analyzer(np.array([angle]))[0], stokes, 1) * inside[..., None])
    value = np.stack(values) + noise * np.random.default_rng(4).normal(size=(3, *normal.shape))
    return replace(scenes.stack(), value=value.astype(np.float32))


def measured(radiance: AngleStack, maps: SurfaceMaps | None = None) -> object_turn.ObjectTurn:
    return object_turn.measure(radiance, scenes.still(), scenes.ball_object(), maps)


def of_relief(share: float) -> SurfaceMaps:
    """Maps of the ball with its depth times `share`."""
    normal, mask = scenes.truth()
    radius = np.sqrt(mask.sum() / np.pi)
    flat = np.ones(mask.shape, np.float32)
    color = np.repeat(flat[..., None], 3, -1)
    x0, y0, _, _ = scenes.ball_object().crop
    view = replace(scenes.VIEW, origin=(float(x0), float(y0)))
    prior = -share * scenes.RADIUS / radius * normal[..., 2]
    return SurfaceMaps(normal, color, color, flat, prior, flat, mask, view, "network")


@pytest.mark.parametrize("turn", [(0.5, 0.0, 0.0), (0.0, -0.5, 0.0), (0.0, 0.0, 0.5), (0.3, 0.3, -0.3)])
def test_a_turn_about_any_axis_is_measured_in_degrees(turn: tuple[float, float, float]) -> None:
    """Twice as large in the third shot as in the second; the shape of a ball follows from its outline."""
    found = measured(photographs(turn))
    each = float(np.linalg.norm(turn))
    assert found.degrees[0] == 0
    assert found.degrees[1:] == pytest.approx([each, 2 * each], rel=0.2)


def test_polarization_of_a_still_object_is_no_turn() -> None:
    found = measured(photographs((0.0, 0.0, 0.0)))
    assert (found.degrees[1:] < 0.1).all()


def test_the_depth_of_the_maps_gives_the_turn_where_it_is_known() -> None:
    """A surface of half the relief turns by twice the angle for the same displacements."""
    turns = [measured(photographs((0.0, 0.4, 0.0)), of_relief(share)).degrees[2] for share in (1.0, 0.5)]
    assert turns == pytest.approx([0.8, 1.6], rel=0.2)


def test_a_small_shift_of_a_flat_object_is_no_large_turn() -> None:
    """Polarization shifts detail by a twentieth of a pixel, which a flat surface does only if it turns far."""
    found = measured(photographs((0.0, 0.06, 0.0)), of_relief(0.05))
    assert found.degrees[2] > 1.5 and found.degrees[2] < 2 * found.sigma[2]
    assert found.shift[2] < 0.002  # of the radius


def test_the_surface_shifts_as_far_as_the_turn_moves_it() -> None:
    """A roll by ω moves a disc by ω r; root mean square of r over a disc of radius 1: 1/√2."""
    found = measured(photographs((0.0, 0.0, 0.5)))
    assert found.shift[1] == pytest.approx(np.radians(0.5) / np.sqrt(2), rel=0.15)


def test_the_error_covers_what_noise_does() -> None:
    found = measured(photographs((0.0, 0.0, 0.0), noise=0.05))
    assert (found.degrees[1:] < 3 * found.sigma[1:] + 0.1).all()


def test_a_mosaic_holds_all_angles_at_once() -> None:
    radiance = replace(photographs((0.0, 2.0, 0.0)), offset_px=np.zeros((3, 2)))
    assert not measured(radiance).degrees.any()


def test_polarization_that_the_maps_explain_is_no_turn() -> None:
    """A gray ball with fine relief: the polarizer changes its shading almost as motion would."""
    normal, mask = scenes.truth()
    x0, y0, _, _ = scenes.ball_object().crop
    y, x = np.mgrid[: mask.shape[0], : mask.shape[1]]
    relief = np.stack([np.sin(0.6 * x), np.sin(0.5 * y + 0.3 * x), 0 * x], -1)
    rough = frames.unit(normal + 0.15 * relief).astype(np.float32)
    maps = replace(of_relief(1.0), normal=np.where(mask[..., None], rough, normal).astype(np.float32))
    radiance = scenes.stack()
    stokes, shots = under_flash(maps, radiance.angle, 1.5)
    value = np.full(radiance.value.shape, 1e-3, np.float32)
    light = stokes[0] * shots[..., None] * mask[..., None]
    value[:, y0 : y0 + mask.shape[0], x0 : x0 + mask.shape[1]] += light.astype(np.float32)
    still = replace(radiance, value=value)
    assert measured(still, replace(maps, normal=normal)).shift[1:].max() > 4 * measured(still, maps).shift[1:].max()
