"""Half-turns against shapes with known normals."""

import numpy as np
import pytest

from polcap.image_values import View
from polcap.optics import frames
from polcap.stages.infer.shape import half_turns, planar_faces

SIZE = 120
Y, X = np.mgrid[:SIZE, :SIZE].astype(float)


def ball(x0=59.5, y0=59.5, radius=50.0):
    """Normals (H, W, 3) of a ball in the frame of each ray, and its mask."""
    u, v = (X - x0) / radius, -(Y - y0) / radius
    mask = u * u + v * v < 1
    z = np.sqrt(np.maximum(1 - u * u - v * v, 1e-4))
    return frames.unit(np.stack([u, v, z], axis=-1)), mask


def opposite(normal):
    return normal * [-1, -1, 1]


def doubt(overview, sigma=20.0, opposed=0.0):
    """Doubt (H, W) of a network that predicts the normals `overview` (H, W, 3) from smaller pictures."""
    ones = np.ones(overview.shape[:2])
    return half_turns.NetworkDoubt(sigma * ones, opposed * ones, np.moveaxis(overview[..., :2], -1, 0))


def leaning(normal):
    return np.hypot(normal[..., 0], normal[..., 1]) > 0.3


@pytest.mark.parametrize("region", ["whole", "half", "patch at the outline"])
def test_a_region_of_a_ball_that_was_turned_is_turned_back(region: str) -> None:
    normal, mask = ball()
    wrong = mask & {"whole": X > -1, "half": X > 60, "patch at the outline": np.hypot(X - 100, Y - 60) < 22}[region]
    normals = np.where(wrong[..., None], opposite(normal), normal)
    found = half_turns.resolve(normals, mask, doubt(normal, 25.0))
    judged = mask & leaning(normal)
    assert (found.turned == wrong)[judged].mean() > 0.97


def test_a_right_ball_keeps_its_normals_without_doubt() -> None:
    normal, mask = ball()
    found = half_turns.resolve(normal, mask, doubt(normal))
    assert not found.turned.any()
    assert found.doubt.max() == 0


def test_a_true_dent_stays_a_dent() -> None:
    """A hollow inside a ball: its normals lean inward, and the network is as sure of it as of the rest."""
    normal, mask = ball()
    dent = np.hypot(X - 59.5, Y - 59.5) < 22
    u, v = (X - 59.5) / 30, -(Y - 59.5) / 30
    hollow = frames.unit(np.stack([-u, -v, np.sqrt(np.maximum(1 - u * u - v * v, 0.1))], axis=-1))
    normals = np.where(dent[..., None], hollow, normal)
    assert not half_turns.resolve(normals, mask, doubt(normals, 10.0)).turned.any()


def test_a_neck_that_the_mask_cuts_does_not_anchor() -> None:
    """A cylinder leans to its two sides; the straight ends of its mask are no evidence."""
    across = np.clip((X - 59.5) / 40, -1, 1)
    normal = np.stack([across, 0 * X, np.sqrt(np.maximum(1 - across**2, 1e-4))], axis=-1)
    mask = (np.abs(X - 59.5) < 40) & (Y > 10) & (Y < 100)
    evidence = half_turns._outline_evidence(half_turns.coarse(normal, mask))
    ends = mask & ((Y < 14) | (Y > 96)) & (np.abs(X - 59.5) < 35)
    sides = mask & (np.abs(X - 59.5) > 38) & (Y > 14) & (Y < 96)
    assert np.abs(evidence[ends]).max() < 0.05
    assert evidence[sides].min() > 0.2


def test_where_the_picture_ends_nothing_anchors() -> None:
    """Half of a ball that leaves the picture: the cut edge is no outline."""
    normal, mask = ball(x0=0.0)
    evidence = half_turns._outline_evidence(half_turns.coarse(normal, mask))
    assert np.abs(evidence[:, 0][mask[:, 0]][3:-3]).max() < 1e-6


def test_axes_of_a_ball_get_their_sides_and_a_bulge_its_own() -> None:
    """Sides drawn at random come out as those of the truth, on a ball with a smaller one before it."""
    normal, mask = ball()
    small, front = ball(52.0, 65.0, 20.0)
    normal = np.where(front[..., None], small, normal)
    random = np.random.default_rng(0).random(mask.shape) < 0.5
    axes = np.where(random[..., None], opposite(normal), normal)
    found = half_turns.resolve(axes, mask)
    right = (found.turned == random)[mask & leaning(normal)]
    assert right.mean() > 0.97
    assert found.doubt[mask & leaning(normal)].mean() < 0.1


def test_positions_that_disagree_raise_the_odds_of_a_region() -> None:
    """The same wrong patch, at the edge of being believed: with the network's positions at odds it is turned."""
    normal, mask = ball()
    wrong = np.hypot(X - 95, Y - 60) < 18
    normals = np.where(wrong[..., None], opposite(normal), normal)
    agreed, split = (half_turns.resolve(normals, mask, doubt(0 * normals, 20.0, opposed)) for opposed in (0.0, 0.5))
    assert not agreed.turned.any() and agreed.doubt.max() > 0.02
    assert split.turned[wrong & mask & leaning(normal)].mean() > 0.9


def test_the_expected_error_is_the_mean_over_both_sides() -> None:
    """A normal at 40° with the wrong side one time in four: ¾ · 4° + ¼ · 80°."""
    error = half_turns.error_with_doubt(np.array(4.0), np.array(0.25), np.cos(np.radians(40.0)))
    assert error == pytest.approx(23.0)


def test_an_empty_mask_has_no_half_turns() -> None:
    normal, mask = ball()
    found = half_turns.resolve(normal, np.zeros_like(mask))
    assert not found.turned.any() and not found.doubt.any()


def tilted_plane(tilt_deg, focal_px=500.0):
    """A plane that leans to the right in a frontal flash: normals in ray frames, mask, light without albedo, rays."""
    rays = frames.rays(View(focal_px, (59.5, 59.5), 1.0), SIZE, SIZE)
    normal = np.array([np.sin(np.radians(tilt_deg)), 0, np.cos(np.radians(tilt_deg))])
    light = frames.dot(normal, rays) ** 3  # its distance from the flash is in proportion to 1 / (n · ray)
    mask = (np.abs(X - 59.5) < 50) & (np.abs(Y - 59.5) < 40)
    return frames.to_ray_frame(np.broadcast_to(normal, rays.shape), rays), mask, light, rays


def chequered(light):
    """Radiance (H, W, 3) of a print of two colors, with noise."""
    noise = np.random.default_rng(0).normal(1, 0.01, (*light.shape, 1))
    squares = ((X // 12 + Y // 12) % 2 == 0)[..., None]
    return light[..., None] * np.where(squares, [0.6, 0.3, 0.2], [0.1, 0.2, 0.4]) * noise


def plane_odds(normal, mask, flash):
    grid = half_turns.coarse(normal, mask)
    return planar_faces.light_odds(grid.lean, grid.mask, flash, mask)


@pytest.mark.parametrize("wrong", [X > -1, X > 70], ids=["whole", "part"])
@pytest.mark.parametrize("tilt", [30.0, 50.0])
def test_a_plane_leans_to_where_the_light_of_the_flash_decreases(tilt: float, wrong: np.ndarray) -> None:
    """The network is wrong in all positions and sizes, and neither the outline nor the albedo contradicts it."""
    normal, mask, light, rays = tilted_plane(tilt)
    normals = np.where(wrong[..., None], opposite(normal), normal)
    flash = planar_faces.FlashPicture(chequered(light), rays)
    found = half_turns.resolve(normals, mask, doubt(normals, 12.0), flash)
    inner = mask & (np.abs(X - 70) > 3)
    assert (found.turned == wrong)[inner].mean() > 0.97
    assert not half_turns.resolve(normals, mask, doubt(normals, 12.0)).turned[inner].any()


def test_light_that_no_plane_explains_decides_nothing() -> None:
    """A bump's light, across the lean of the plane; a ball has no planes."""
    normal, mask, _, rays = tilted_plane(35.0)
    across = planar_faces.FlashPicture(chequered(np.exp(2 * rays[..., 1])), rays)
    assert not plane_odds(normal, mask, across).any()
    round_, disc = ball()
    assert (plane_odds(round_, disc, planar_faces.FlashPicture(chequered(X), rays)) != 0).mean() < 0.02
