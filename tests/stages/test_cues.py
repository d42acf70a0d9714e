"""The cues: the paper's sphere figure, and one code for NumPy and torch."""

from dataclasses import fields, replace
from types import SimpleNamespace
from typing import Literal

import numpy as np
import pytest

from polcap.chart_values import ChartLight
from polcap.image_values import Quality
from polcap.optics import body, fresnel
from polcap.stages import cues, stokes
from tests import scenes

CHART = replace(scenes.no_color(), source="chart")


def solve(**scene):
    """Stokes parameters of the ball."""
    shots, settings = scenes.stack(**scene), stokes.StokesSettings()
    return stokes.solve(shots, scenes.still(), scenes.equal(), scenes.ball_object(), settings)


@pytest.fixture(scope="module")
def solved():
    return solve()


@pytest.fixture(scope="module")
def ball():
    """Cues of a plain ball, as the pipeline makes them."""
    return cues.compute(solve(textured=False), scenes.no_color())


def test_the_normalised_stokes_map_of_a_sphere_turns_twice_around_it(ball):
    """The paper's figure: green (S1) peaks left and right, blue (S2) up-right and down-left."""
    normal, mask = scenes.truth()
    phi = np.arctan2(normal[..., 1], normal[..., 0])
    tilted = mask & (normal[..., 2] < 0.8) & (normal[..., 2] > 0.3)
    assert np.abs(ball.normalized_stokes[0] - np.cos(2 * phi))[tilted].max() < 0.06  # 1.7° of AoLP off axis
    assert np.abs(ball.normalized_stokes[1] - np.sin(2 * phi))[tilted].max() < 0.06


def test_dolp_of_a_sphere_follows_atkinson_and_hancock(ball):
    normal, mask = scenes.truth()
    ring = mask & (normal[..., 2] < np.cos(np.radians(40))) & (normal[..., 2] > np.cos(np.radians(70)))
    law = body.dolp(normal[..., 2], 0.0, 1.5)
    assert np.abs(ball.dolp[ring] / law[ring] - 1).max() < 0.03  # the shared highlight dilutes by up to 2 %


def test_dolp_of_noise_is_not_mistaken_for_tilt():
    rng = np.random.default_rng(0)
    sigma, rho = 0.01, 0.03
    values, covariance = np.zeros((3, 200, 200, 3)), np.zeros((6, 200, 200, 3))  # all in one channel
    values[0, ..., 1] = 1
    values[1, ..., 1] = rho + sigma * rng.normal(size=(200, 200))
    values[2, ..., 1] = sigma * rng.normal(size=(200, 200))
    covariance[[3, 5], ..., 1] = sigma**2
    _, found, dolp, _ = cues.polarization(values, covariance)
    assert np.allclose(found, sigma)
    assert abs(dolp.mean() - rho) < 0.0004  # 0.0017 without the correction


def test_diffuse_color_is_the_fitted_least_intensity(ball):
    expected = np.array([1, 1, 1]) / np.sqrt(3)
    inside = ball.mask & (ball.quality == 0)
    assert np.allclose(ball.diffuse_color[inside], expected, atol=1e-3)


def test_albedo_of_a_ball_is_within_the_error_of_the_chart_s_depth(solved):
    """Inverse squares over the visible half, seen and lit along the axis; the chart anywhere next to the ball."""
    doubt = cues.scale.sigma(solved, CHART)
    assert cues.scale.sigma(solved, scenes.no_color()) is None
    radius = np.sqrt(solved.mask.sum() / np.pi) / solved.view.focal
    ahead = radius * np.sqrt(np.linspace(0, 1, 1001))  # cos θ of places that are spread evenly over the disc
    rule = (1 - radius / 2) ** 2
    error = {z: np.mean(((1 - z) / (1 - ahead)) ** 2) * rule - 1 for z in (-radius, 0.0, radius)}
    assert abs(error[0.0]) < doubt / 2 and doubt < 1.5 * max(map(abs, error.values()))
    assert error[-radius] > doubt and -2 * doubt < error[radius] < -doubt / 2 and error[-radius] < 2.5 * doubt


def test_radiance_of_a_frontal_patch_is_its_albedo(ball):
    """White balance is on S0: ρ T₊(0)² at the middle, plus the highlight's π F0 D/4 (α = ¼: 4 F0)."""
    front = ball.radiance[90, 90]
    lobe = 0.04 / (4 * 0.25**2)
    assert front == pytest.approx(0.5 * fresnel.transmission(1.0, 1.5)[0] ** 2 + lobe, rel=0.02)


def test_torch_and_numpy_give_the_same_channels(ball):
    torch = pytest.importorskip("torch", reason="torch comes with the [train] extra")
    values = {f.name: getattr(ball, f.name) for f in fields(ball) if f.name != "view"}
    values = {name: value for name, value in values.items() if value is not None}  # None without a crossed shot
    batch = SimpleNamespace(
        **{
            name: torch.as_tensor(np.asarray(value))[:, None] if name in ("ratio", "normalized_stokes")
            else torch.as_tensor(np.asarray(value))[None]
            for name, value in values.items()
        }
    )  # fmt: skip
    found = cues.channels(batch)
    expected = cues.channels(ball)
    assert found.shape == (1, len(cues.CHANNELS), *ball.mask.shape)
    assert np.allclose(found[0].numpy(), expected, atol=1e-4)


def test_channels_hold_the_values_of_their_names(ball):
    seen, length = dict(zip(cues.CHANNELS, cues.channels(ball))), np.maximum(np.hypot(*ball.ratio), 1e-9)
    turned = ball.mask & (np.abs(ball.ratio[0]) > 0.01) & (np.abs(ball.ratio[1]) > 0.01)  # no two directions alike
    expected_values = {
        "log_r": np.log(ball.radiance[..., 0] + 0.02), "log_b": np.log(ball.radiance[..., 2] + 0.02),
        "s1": 10 * ball.ratio[0], "s2": 10 * ball.ratio[1],
        "cos_2phi": ball.ratio[0] / length, "sin_2phi": ball.ratio[1] / length,
        "ray_x": ball.rays[..., 0], "ray_y": ball.rays[..., 1], "mask": 1.0, "clipped": 0.0,
    }  # fmt: skip
    for name, expected in expected_values.items():
        assert np.abs(seen[name] - expected)[turned].max() < 1e-4, name
    zenith = np.hypot(seen["zenith_x"], seen["zenith_y"])[turned]
    assert body.dolp(np.cos(zenith), 0.0, 1.5) == pytest.approx(ball.dolp[turned], abs=1e-4)
    assert np.arctan2(seen["zenith_y"], seen["zenith_x"])[turned] == pytest.approx(
        np.arctan2(ball.ratio[1], ball.ratio[0])[turned], abs=1e-4
    )


@pytest.mark.parametrize("source", ["camera", "none"])
def test_without_a_chart_the_object_alone_sets_the_scale(solved, source: Literal["camera", "none"]) -> None:
    light = np.where(solved.mask[..., None], solved.stokes, 7 * solved.stokes.max()).astype(np.float32)
    found = cues.compute(replace(solved, stokes=light), replace(scenes.no_color(), source=source))
    assert np.percentile(found.radiance[found.mask], 99) == pytest.approx(0.8, rel=1e-5)


def test_nothing_outside_the_mask_reaches_the_network(ball):
    assert (cues.channels(ball)[:, ~ball.mask] == 0).all()


def test_clipping_reaches_the_network(ball):
    clipped = replace(ball, quality=np.full_like(ball.quality, Quality.CLIPPED))
    channel = cues.channels(clipped)[cues.CHANNELS.index("clipped")]
    assert (channel[ball.mask] == 1).all()


@pytest.mark.parametrize("size", [0.05, 0.1, 0.2])
def test_the_chart_is_level_with_the_middle_of_the_object(solved, size: float):
    """Irradiance of the chart by that of the visible surface lies between those of a cone and of a ball.

    size: radius over distance; inverse-square law, both solids as deep as half their width.
    """
    focal = float(np.sqrt(solved.mask.sum() / np.pi)) / size
    sized = replace(solved, view=replace(solved.view, focal=focal))
    free, charted = (cues.compute(sized, color) for color in (scenes.no_color(), CHART))
    factor = float(np.median(charted.radiance[solved.mask] / free.radiance[solved.mask]))
    r = np.sqrt((np.arange(1000) + 0.5) / 1000)  # evenly over the disc
    cone, ball = (1 / np.mean(1 / (1 - size * height) ** 2) for height in (1 - r, np.sqrt(1 - r * r)))
    assert ball < factor < cone


def test_a_profile_with_its_charts_light_has_the_charts_scale(solved):
    """The views of one session share chart, flash and camera: albedo must not depend on which view shows the chart."""
    light = ChartLight(np.array([0.1, 0.0, -1.0]), np.array([0.0, 0.0, 1.0]), np.zeros(3), np.zeros((5, 5)))
    shown, shared = (cues.compute(solved, replace(color, light=light)) for color in (CHART, scenes.no_color()))
    assert np.array_equal(shown.radiance, shared.radiance)
    assert shown.scale_sigma == shared.scale_sigma is not None


@pytest.mark.parametrize(("turn", "offset"), [(0.0, 0.0), (0.4, 0.0), (0.0, 0.15)])
def test_a_turned_or_offset_chart_gets_less_light_than_the_object(solved, turn: float, offset: float):
    """n·l / d² of a chart under a flash at the lens: cos of its turn, or cos³ of the angle to the axis."""
    white, normal = np.array([offset, 0.0, -1.0]), np.array([np.sin(turn), 0.0, np.cos(turn)])
    light = ChartLight(white, normal, np.zeros(3), np.zeros((5, 5)))
    factor = cues.scale.factor(solved, replace(CHART, light=light)) / cues.scale.factor(solved, CHART)
    assert factor == pytest.approx(np.cos(turn) * np.cos(np.arctan(offset)) ** 3, rel=1e-6)


def test_the_scale_follows_a_flash_at_the_chart_s_side_and_its_doubt_widens_the_scale_s(solved):
    """The object is on the axis: a flash nearer to the chart lights that more, by its distances squared."""
    row, column = (axis.mean() for axis in np.nonzero(solved.mask))
    found = replace(solved, view=replace(solved.view, center=(column, row)))
    white, flash = np.array([0.2, 0.0, -1.0]), np.array([0.1, 0.0, 0.0])
    facing = np.array([0.0, 0.0, 1.0])
    at_lens, off_axis, doubtful = (
        replace(CHART, light=ChartLight(white, facing, at, spread))
        for at, spread in ((0 * flash, np.zeros((5, 5))), (flash, np.zeros((5, 5))), (flash, 0.01 * np.eye(5)))
    )
    ahead = 1 - np.sqrt(found.mask.sum() / np.pi) / found.view.focal / 2
    doubtful.light.normal.flags.writeable = False  # as the store hands them out
    lit = (1.01 / 1.04) ** -1.5 * (ahead**2 + 0.01) / ahead**2
    assert cues.scale.factor(found, off_axis) / cues.scale.factor(found, at_lens) == pytest.approx(lit, rel=1e-6)
    assert cues.scale.sigma(found, doubtful) > cues.scale.sigma(found, off_axis) + 0.002
