"""The object's mask."""

from dataclasses import replace

import numpy as np
import pytest

from polcap.chart_values import ChartPlace
from polcap.errors import ObjectError
from polcap.stages import mask
from polcap.stages.mask import graph_cut, likely_regions, mask_channels
from polcap.stages.mask import network as mask_network
from tests import scenes
from tests.fake_network import FakeNetwork, run

CHANNEL = mask_channels.CHANNELS.index


def bright_is_object(inputs):
    """In place of a trained network: the object is brighter than 1/32 of the bright parts, and is no chart."""
    return {"logit": np.where(inputs[:, CHANNEL("chart")] > 0, -9, 40 * (inputs[:, CHANNEL("log")]))[:, None]}


def network(answer=bright_is_object):
    return FakeNetwork("of the test", mask_channels.CHANNELS, {"native_size": "160"}, answer=answer)


def segment(radiance, color, user=None, model=None):
    return mask.segment(radiance, scenes.still(), color, user, model, run, mask.MaskSettings())


def reduced(radiance, alignment=None, box=(0, 0, scenes.WIDTH, scenes.HEIGHT), longest=160):
    """The network's input picture, without a chart."""
    chart = np.zeros((scenes.HEIGHT, scenes.WIDTH), np.uint8)
    return mask_network.reduced_picture(radiance, alignment or scenes.still(), scenes.no_color(), chart, box, longest)


def overlap(one, other):
    return (one & other).sum() / (one | other).sum()


def chart_color():
    corners = np.array([[223, 29], [301, 29], [301, 201], [223, 201]], float)
    return replace(scenes.no_color(), place=ChartPlace(np.zeros((24, 4, 2)), corners), source="chart")


@pytest.mark.parametrize("model", [None, network()])
def test_the_ball_is_found_and_the_chart_is_not_the_object(model):
    found = segment(scenes.stack(noise=0.004), chart_color(), model=model)
    assert overlap(found.mask, scenes.ball_object().mask) > 0.97
    assert not found.mask[:, 230:].any()
    assert found.crop[0] < 36 and found.crop[2] > 204
    assert (found.doubt is None) == (model is None)


def test_close_ups_show_the_found_part_with_its_estimate():
    seen = []

    def answer(inputs):
        seen.append(inputs)
        return bright_is_object(inputs)

    segment(scenes.stack(), chart_color(), model=network(answer))
    first, second, third = seen[::4]  # each pass in four positions
    assert third.shape == second.shape
    assert first.shape[2:] == (128, 160)  # 120 rows, up to a multiple of 16
    assert not first[0, CHANNEL("looked")].any() and (second[0, CHANNEL("looked")] == 1).all()
    hint = second[0, CHANNEL("chance")]
    assert hint.max() > 0.9 and hint.min() < -0.9
    x = second[0, CHANNEL("x")]
    assert x.min() > -0.98 and x.max() < 0.6  # the ball's part of the picture


def test_answers_that_depend_on_the_side_cancel():
    """A network that goes by left and right, up and down and the sense of the polarization, and one that goes by S1."""

    def one_sided(inputs):
        return {"logit": 5 * sum(inputs[:, CHANNEL(name)] for name in ("x", "y", "s2"))[:, None]}

    channels = np.random.default_rng(0).uniform(-1, 1, (len(mask_channels.CHANNELS), 20, 35)).astype(np.float32)
    np.testing.assert_allclose(mask_network._run(network(one_sided), run, channels), 0.5, atol=1e-5)
    by_s1 = network(lambda inputs: {"logit": inputs[:, CHANNEL("s1")][:, None]})
    fair = mask_network._run(by_s1, run, channels)
    np.testing.assert_allclose(fair, 1 / (1 + np.exp(-channels[CHANNEL("s1")])), rtol=1e-5)


def test_channels_do_not_depend_on_exposure():
    """Radiance and reflectance in any unit give the same channels."""
    pictures = (reduced(scenes.stack(scale=scale)) for scale in (0.5, 0.05))
    one, other = (mask_channels.encode(picture, mask_channels.brightness(picture.color)) for picture in pictures)
    np.testing.assert_allclose(one, other, atol=2e-5)


@pytest.mark.parametrize("shot", range(3))
def test_channels_do_not_depend_on_the_flash_energy_of_a_shot(shot):
    radiance = scenes.stack()
    energy = np.where(np.arange(3) == shot, 0.7, 1.0).astype(np.float32)[:, None, None, None]
    one, other = (reduced(replace(radiance, value=value)).stokes for value in (radiance.value, radiance.value * energy))
    bright = one[0] > 0.1 * one[0].max()
    np.testing.assert_allclose((other[1:] / other[0])[:, bright], (one[1:] / one[0])[:, bright], atol=0.03)


def test_a_black_shot_leaves_the_channels_finite():
    radiance = scenes.stack()
    value = radiance.value * np.array([1, 1, 0], np.float32)[:, None, None, None]
    assert np.isfinite(reduced(replace(radiance, value=value)).stokes).all()


def test_channels_hold_the_polarization_of_the_aligned_shots():
    """S1 and S2 of a ball in shots that are shifted by up to three pixels."""
    moved = np.tile(np.eye(3), (3, 1, 1))
    moved[1, 0, 2], moved[2, 1, 2] = 3.0, -2.0
    radiance = scenes.stack(list(moved), textured=False)
    alignment = replace(scenes.still(), transform=moved)
    picture = reduced(radiance, alignment=alignment, box=(40, 30, 200, 210), longest=1000)
    y, x = np.mgrid[30:210, 40:200].astype(float)
    true, inside = scenes.stokes(x, y, textured=False)
    inner = inside & (np.hypot(x - scenes.CENTER[0], y - scenes.CENTER[1]) < 78)
    inner[:, :5], inner[:, -5:], inner[:5], inner[-5:] = False, False, False, False  # the box ends there
    for k in (1, 2):
        error = picture.stokes[k] / picture.stokes[0] - true[k].sum(-1) / true[0].sum(-1)
        assert np.abs(error[inner]).max() < 0.01


def test_doubtful_holes_are_filled_openings_stay_and_specks_go():
    chance = np.full((100, 100), 0.01, np.float32)
    chance[20:80, 20:80] = 0.99
    chance[30:40, 30:40] = 0.3  # a hollow in shadow
    chance[50:60, 50:60] = 0.02  # the opening of a handle
    chance[5:7, 5:7] = 0.9
    found = likely_regions.likely_regions(chance)
    assert found[30:40, 30:40].all() and not found[50:60, 50:60].any() and not found[5:7, 5:7].any()


def test_colors_decide_where_probabilities_are_open():
    """A ring seen by a network that is sure of its left half alone, and of the picture's rim."""
    y, x = np.mgrid[:120, :160].astype(float)
    away = np.hypot(x - 80, y - 60)
    true = (away < 45) & (away > 20)
    rng = np.random.default_rng(0)
    picture = np.where(true[..., None], [0.5, 0.2, 0.1], [0.1, 0.2, 0.3]) * rng.normal(1, 0.02, (120, 160, 1))
    chance = np.where(away < 55, 0.6, 0.001)
    chance[true & (x < 70)] = 0.999
    found = graph_cut.sharpen(
        picture.astype(np.float32), chance > 0.5, np.zeros(true.shape, np.uint8), chance.astype(np.float32)
    )
    assert overlap(found, true) > 0.97 and overlap(chance > 0.5, true) < 0.6


def test_colors_are_not_followed_against_the_network():
    """A square, which colors made higher by a row, and much larger."""
    chance = np.full((100, 100), 0.01)
    chance[20:80, 20:80] = 0.95
    learned = chance > 0.5
    near, far = learned.copy(), learned.copy()
    near[19, 20:80] = True
    far[:, 10:90] = True
    assert likely_regions.choose(near, learned, chance) is near
    assert likely_regions.choose(far, learned, chance) is learned


def test_cleaning_keeps_openings():
    drawn = np.zeros((100, 100), bool)
    drawn[20:80, 20:80] = True
    drawn[30:40, 30:40] = False  # an opening
    drawn[50, 50] = False
    drawn[5, 5] = True
    drawn[80:100, 85:95] = True  # colors alone took it for the object
    found = likely_regions.clean(drawn, np.where(np.arange(100) < 82, 0.6, 0.1) * np.ones((100, 1)))
    assert found.sum() == 3600 - 100 and not found[30:40, 30:40].any() and found[50, 50]


def test_a_drawn_mask_is_taken_as_drawn():
    drawn = np.zeros((scenes.HEIGHT, scenes.WIDTH), bool)
    drawn[50:100, 60:130] = True
    found = segment(scenes.stack(), chart_color(), drawn, network())
    assert np.array_equal(found.mask, drawn) and found.source == "user" and found.doubt is None


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(ObjectError, match="10×10 px"):
        segment(scenes.stack(), chart_color(), np.ones((10, 10), bool))


def test_an_empty_picture_is_refused():
    radiance = scenes.stack()
    dark = replace(radiance, value=np.full_like(radiance.value, 0.002))
    with pytest.raises(ObjectError, match="no object differs"):
        segment(dark, chart_color())
    nothing = network(lambda inputs: {"logit": np.full((1, 1, *inputs.shape[2:]), -9.0)})
    with pytest.raises(ObjectError, match=r"no object found.*--mask"):
        segment(dark, chart_color(), model=nothing)


def test_shape_counts_islands_holes_and_the_picture_edge():
    drawn = np.zeros((40, 60), bool)
    drawn[0:20, 0:20] = True
    drawn[5:10, 5:10] = False  # 25 of 375
    drawn[30:35, 40:45] = True  # 25 of 400
    islands, holes, border = likely_regions.measure_shape(drawn)
    assert islands == pytest.approx(25 / 400) and holes == pytest.approx(25 / 400)
    assert border == pytest.approx(39 / (2 * 60 + 2 * 38))
    for line in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        on_edge = np.zeros((40, 60), bool)
        on_edge[line] = True
        assert likely_regions.measure_shape(on_edge)[2] == pytest.approx(on_edge.sum() / (2 * 60 + 2 * 38))


def test_expected_error_is_one_minus_the_mean_overlap():
    """Over true masks drawn pixel by pixel with the probabilities."""
    rng = np.random.default_rng(0)
    chance = rng.beta(0.3, 0.3, (200, 200))
    found = chance > 0.5
    overlaps = [overlap(rng.random(chance.shape) < chance, found) for _ in range(20)]
    assert 1 - likely_regions.expected_error(found, chance) == pytest.approx(np.mean(overlaps), abs=0.005)


@pytest.mark.parametrize(("light", "less"), [(0.02, True), (0.5, False)])
def test_colors_settle_a_doubt_only_if_object_and_backdrop_differ(light, less):
    """The network is sure of a core and of the backdrop, and doubts the rest of an object on a dark or equal backdrop.

    A mask that lacks the doubted part is as doubtful as before, or more.
    """
    random = np.random.default_rng(0)
    rows, columns = np.mgrid[:80, :120]
    object_ = np.hypot(rows - 40, columns - 60) < 30
    core = np.hypot(rows - 40, columns - 60) < 15
    picture = np.where(object_, 0.5, light)[..., None] * random.lognormal(0, 0.1, (80, 120, 3))
    chance = np.where(core, 0.99, np.where(object_, 0.6, 0.01)).astype(np.float32)
    chart = np.zeros(object_.shape, np.uint8)
    by_network = likely_regions.expected_error(object_, chance)
    by_color = likely_regions.expected_error_by_color(picture.astype(np.float32), object_, chance, chart)
    without = [measure(core) for measure in (
        lambda found: likely_regions.expected_error(found, chance),
        lambda found: likely_regions.expected_error_by_color(picture.astype(np.float32), found, chance, chart),
    )]  # fmt: skip
    assert by_color < by_network / 2 if less else by_color == pytest.approx(by_network, abs=0.03)
    assert without[1] > without[0] - 0.03


def test_parts_of_a_mask_are_numbered_by_area() -> None:
    mask = np.zeros((20, 40), bool)
    mask[2:6, 2:6], mask[5:15, 20:35] = True, True
    assert likely_regions.nth_part(mask, 1).sum() == 150 and likely_regions.nth_part(mask, 2).sum() == 16
    assert not likely_regions.nth_part(mask, 3).any()
