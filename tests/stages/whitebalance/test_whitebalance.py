"""The chart found where it is, refused where it is not, and colors on the scale of its white patch."""

import functools
import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest

from polcap.chart_values import ChartReference, ChartRequest, ColorCalibration
from polcap.errors import ChartError
from polcap.formats import shipped_data
from polcap.image_values import Floats, View
from polcap.optics.projection import transform_points
from polcap.stage_values import ColorSensor
from polcap.stages.whitebalance import chart, chart_in_mask, chart_search, patches
from tests.stages.whitebalance.chart_pictures import (
    AUTO,
    CAMERA,
    CLASSIC,
    HEIGHT,
    WIDTH,
    draw,
    measure,
    photograph,
    pose,
    stack,
)


@functools.cache
def plain() -> tuple[Floats, Floats]:
    place = pose(24, 8, (260, 170), (2e-3, -1e-3))
    return photograph(place), place


def chart_coordinates(place: Floats) -> Floats:
    """Coordinates u, v (2, H, W) of the picture's pixels on the chart: 0…6 × 0…4."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    return np.moveaxis(transform_points(np.linalg.inv(place), np.stack([x, y], axis=-1)), -1, 0)


def corners(place: Floats, off: Floats | float = 0.0, patch: float = 0.87) -> ChartRequest:
    """The outer corners of a chart as the user states them in RAW px, with an error [binned px]."""
    at = chart.Placement(place, patch).corners() + off
    return ChartRequest("corners", corners=2 * at + 0.5)  # binned px (i, j) ↔ RAW px (2i + ½, 2j + ½)


def centers_off(color: ColorCalibration, homography: Floats) -> Floats:
    """Distance of each found patch center from the true one (24,), px."""
    assert color.place is not None
    found = np.array([_center(quad) for quad in color.place.quads])
    return np.linalg.norm(found - transform_points(homography, chart.centers()), axis=-1)


def _center(quad: Floats) -> Floats:
    """Where a quad's diagonals cross: the image of the square's center."""
    first, second = quad[2] - quad[0], quad[3] - quad[1]
    share = np.linalg.solve(np.stack([first, -second], axis=1), quad[1] - quad[0])[0]
    return quad[0] + share * first


@pytest.mark.parametrize(
    ("pitch", "turn", "tilt"),
    [(13, 3, (0, 0)), (24, -20, (3e-3, 2e-3)), (24, 95, (0, 4e-3)), (24, 180, (0, 0)), (40, -140, (-2e-3, 1e-3))],
)
def test_chart_is_placed_within_a_tenth_of_a_pixel(pitch, turn, tilt):
    place = pose(pitch, turn, (235, 185), tilt)
    color = measure(photograph(place))
    assert color.source == "chart"
    assert centers_off(color, place).max() < 0.1
    assert np.nanmean(color.patches.delta_e) < 1  # noise only


def test_chart_of_eight_pixel_patches_is_known_by_its_colors():
    """In superpixels red and blue are half a pixel apart, so 24 flat patches explain less than 0.9 of small ones."""
    raw = photograph(pose(17, 2, (235, 185)), samples=1)
    image = np.stack([raw[::2, ::2, 0], raw[::2, 1::2, 1], raw[1::2, 1::2, 2]], axis=-1)
    place = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]]) @ pose(17, 2, (235, 185))
    start = chart.from_centers(transform_points(place, chart.centers()))
    assert chart.refine(image / image.max(), start).explained < 0.9
    color = measure(image)
    assert color.source == "chart" and centers_off(color, place).max() < 0.3
    assert np.nanmean(color.patches.delta_e) < 1


def test_chart_that_was_taken_for_the_object_is_recognized():
    image, place = plain()
    card = np.zeros(image.shape[:2], np.uint8)
    edge = transform_points(place, np.array([[-0.1, -0.1], [6.1, -0.1], [6.1, 4.1], [-0.1, 4.1]]))
    cv2.fillConvexPoly(card, np.round(edge).astype(np.int32), 1)
    ball = np.hypot(*np.mgrid[-60 : HEIGHT - 60.0, -70 : WIDTH - 70.0]) < 50
    both = (card > 0) | ball
    assert chart_in_mask.share(stack(image), both, CLASSIC) == pytest.approx(card.sum() / both.sum())
    assert chart_in_mask.share(stack(image), ball, CLASSIC) == 0
    table = np.where(card[..., None] > 0, image[:80, :80].mean((0, 1)), image)  # an even card
    assert chart_in_mask.share(stack(table), both, CLASSIC) == 0
    other = photograph(place, np.random.default_rng(0).uniform(0.1, 0.8, (24, 3)))  # 24 tiles of other colors
    assert chart_in_mask.share(stack(other), both, CLASSIC) == 0


def test_s0_of_the_white_patch_is_its_reflectance():
    image, place = plain()
    color = measure(image)
    x, y = np.round(transform_points(place, np.array([0.5, 3.5]))).astype(int)
    s0 = 2 * image[y - 4 : y + 5, x - 4 : x + 5].mean(axis=(0, 1))
    assert color.matrix @ s0 == pytest.approx(CLASSIC.rec709[18], abs=0.01)
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.02)


@pytest.mark.parametrize("edition", [CLASSIC, *CLASSIC.editions], ids=["since 2014", "before", "sRGB values"])
def test_colors_decide_the_edition_of_the_chart(edition: ChartReference):
    _, place = plain()
    color = measure(photograph(place, edition.rec709))
    assert color.patches.edition == edition.name
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.02)


def test_faded_patches_do_not_change_the_edition():
    """Each off by 3 %, as on cards in use: no edition suits them clearly better than another."""
    _, place = plain()
    before = CLASSIC.editions[0].rec709 * (1 + 0.03 * np.random.default_rng(3).normal(size=(24, 3)))
    color = measure(photograph(place, before))
    assert color.patches.edition == CLASSIC.name


def test_matrix_ignores_exposure_and_the_place_does_too():
    image, _ = plain()
    one, other = (measure(k * image) for k in (1.0, 0.01))
    assert 0.01 * other.matrix == pytest.approx(one.matrix, rel=1e-3)
    assert other.place.quads == pytest.approx(one.place.quads, abs=1e-2)


def test_sloping_light_and_glare_are_taken_out_of_the_matrix():
    image, place = plain()
    u, v = chart_coordinates(place)
    light = 1 + 0.03 * (u - 0.5) - 0.02 * (v - 3.5)
    veil = 0.02 * CAMERA.sum(axis=1) / 2
    color = measure(image * light[..., None] + veil)
    assert color.patches.falloff == pytest.approx((0.03, -0.02), abs=0.002)
    assert color.patches.glare == pytest.approx(0.02, abs=0.002)
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.02)


def test_overexposed_patches_are_left_out():
    image, _ = plain()
    clip = 0.5 * float((CLASSIC.rec709[19] @ CAMERA.T)[1]) * 0.9  # white and neutral 8 saturate, and more
    color = measure(stack(image, clip=clip))
    assert color.patches.delta_e is not None
    left_out = np.isnan(color.patches.delta_e)
    assert left_out[18] and left_out[19] and left_out.sum() < 12
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.03)


def test_a_chart_burnt_out_asks_for_a_shorter_exposure():
    image, place = plain()
    with pytest.raises(ChartError, match=r"over-exposed.*shorter exposure"):
        measure(stack(image, clip=0.02), corners(place))


def painted(columns: slice, rows: slice, color: Floats | float) -> Floats:
    """`plain()`, with something over these columns and rows of the chart: (u, v) 0…6 × 0…4."""
    image, place = plain()
    u, v = chart_coordinates(place)
    over = (u > columns.start) & (u < columns.stop) & (v > rows.start) & (v < rows.stop)
    return np.where(over[..., None], color if np.ndim(color) else color * image, image)


def test_hidden_patches_are_left_out_and_named():
    """A thumb over three patches and half a fourth."""
    color = measure(painted(slice(4.2, 7), slice(0, 1.9), CAMERA @ np.array([0.45, 0.25, 0.17]) / 2))
    assert color.patches.use is not None and color.patches.predicted is not None
    assert set(np.flatnonzero(color.patches.use)) >= {5, 10, 11} and (color.patches.use > 0).sum() <= 5
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.02)
    assert np.isnan(color.patches.predicted[11]) and np.nanmean(color.patches.predicted) < 1
    assert "12" in patches.left_out(color.patches.use)


def test_patches_in_shade_are_left_out():
    color = measure(painted(slice(4.5, 7), slice(-1, 5), 0.5))  # the last column, and an edge across the one before
    assert color.patches.use is not None
    assert (color.patches.use[[4, 5, 10, 11, 16, 17, 22, 23]] > 0).sum() >= 6
    assert (color.patches.use.reshape(4, 6)[:, :4] == 0).all()
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.03)


def test_block_of_an_sg_chart_is_read_at_its_corners():
    sg, place = shipped_data.colorchecker("sg"), pose(24, 8, (260, 170))
    color = measure(photograph(place, sg.rec709), corners(place), sg, chart="sg")
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.03)
    assert np.nanmean(color.patches.delta_e) < 1
    assert color.patches.surroundings is not None and np.isnan(color.patches.surroundings).all()  # only a table


SG, SG_PLACE = shipped_data.colorchecker("sg"), pose(22, 6, (230, 120), (2e-4, -1e-4))


def sg_picture(spread: float = 0.0, patch: float = 0.9, seed: int = 7) -> Floats:
    """A whole SG, 14 × 10 patches, each with a color that differs by `spread` from the reference (1σ)."""
    assert SG.surroundings is not None
    colors = np.zeros((10, 14, 3))
    for rec709, center in ((SG.rec709, chart.centers()), (SG.surroundings.rec709, SG.surroundings.center)):
        column, row = np.floor(center + np.array([4, 1])).astype(int).T
        colors[row, column] = rec709
    colors *= 1 + spread * np.random.default_rng(seed).normal(size=colors.shape)
    whole = SG_PLACE @ np.array([[1, 0, -4], [0, 1, -1], [0, 0, 1]])
    return np.asarray(draw(whole, colors.reshape(140, 3), patch, size=(14, 10)) @ CAMERA.T / 2)


def sg_corners(whole: bool, patch: float = 0.9) -> ChartRequest:
    """RAW px of the outer corners of the whole SG, or of its block."""
    if not whole:
        return corners(SG_PLACE, patch=patch)
    left, top, right, bottom = -3.5 - patch / 2, -0.5 - patch / 2, 9.5 + patch / 2, 8.5 + patch / 2
    at = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
    return ChartRequest("corners", corners=2 * transform_points(SG_PLACE, at) + 0.5)


@pytest.mark.parametrize("whole", [True, False], ids=["corners of all", "corners of the block"])
def test_all_patches_of_an_sg_are_fitted(whole: bool) -> None:
    color = measure(sg_picture(), sg_corners(whole), SG, chart="sg")
    assert centers_off(color, SG_PLACE).max() < 0.2
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.02)
    assert color.patches.surroundings.shape == (116,) and np.nanmax(color.patches.surroundings) < 1
    assert np.isfinite(color.patches.surroundings).sum() == 116


@pytest.mark.parametrize(("turn_deg", "pitch"), [(-18, 22), (-161, 17)])
def test_a_whole_sg_is_found_by_itself(turn_deg: float, pitch: float, monkeypatch: pytest.MonkeyPatch) -> None:
    place = pose(pitch, turn_deg, (240, 180), (1e-4, -1e-4)) @ np.array([[1, 0, 0], [0, 1, -2], [0, 0, 1]])
    monkeypatch.setitem(globals(), "SG_PLACE", place)
    color = measure(sg_picture(spread=0.02), AUTO, SG, chart="sg")
    assert centers_off(color, place).max() < 0.2 and np.isfinite(color.patches.surroundings).sum() > 110


def test_patches_of_other_colors_are_no_sg(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the first picture that is searched; the others show the same patches."""
    pictures = chart_search._pictures
    monkeypatch.setattr(chart_search, "_pictures", lambda value: itertools.islice(pictures(value), 1))
    with pytest.raises(ChartError, match="no ColorChecker SG in the reference shot"):
        measure(photograph(pose(40, 5, (240, 180)), np.roll(CLASSIC.rec709, 7, axis=0)), AUTO, SG, chart="sg")


def test_more_patches_make_the_matrix_better() -> None:
    """By about √(24/140) where each patch has an error of its own."""
    block, off = replace(SG, surroundings=None), []
    for seed in range(3):
        picture = sg_picture(spread=0.03, seed=seed)
        found = [
            measure(picture, sg_corners(whole=True), SG, chart="sg"),
            measure(picture, sg_corners(whole=False), block, chart="sg"),
        ]
        off.append([color.matrix @ CAMERA - np.eye(3) for color in found])
    of_all, of_block = np.sqrt(np.mean(np.square(off), axis=(0, 2, 3)))
    assert of_all < 0.7 * of_block


def test_hidden_patches_of_an_sg_are_left_out() -> None:
    picture = sg_picture()
    picture[chart_coordinates(SG_PLACE)[0] < -2] = CAMERA @ [0.35, 0.2, 0.15] / 2  # a hand on the first two columns
    color = measure(picture, sg_corners(whole=True), SG, chart="sg")
    used = np.isfinite(color.patches.surroundings)
    hidden = SG.surroundings.center[:, 0] < -2
    assert used[~hidden].mean() > 0.95 and used[hidden].mean() < 0.2
    assert color.matrix @ CAMERA == pytest.approx(np.eye(3), abs=0.02)


REFUSED = {
    "24 patches of other colors": (r"max_delta_e = 15.*--no-chart", lambda: photograph(
        pose(24, 8, (260, 170)), np.random.default_rng(5).permutation(CLASSIC.rec709))),
    "mirrored": ("no ColorChecker Classic", lambda: plain()[0][:, ::-1]),
    "too small": (r"patches are spaced by 15 RAW px, at least 16 are needed: show it larger",
        lambda: photograph(pose(7.6, 3, (260, 170)))),
    "no chart": (r"no ColorChecker Classic.*--chart x0.*--chart FILE.*--no-chart",
        lambda: draw(pose(24, 0, (-900, -900)), CLASSIC.rec709, samples=1)),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_picture_without_a_usable_chart_is_refused_with_the_reason(name: str):
    message, picture = REFUSED[name]
    with pytest.raises(ChartError, match=message):
        measure(picture())


def test_manual_corners_in_raw_pixels_are_drawn_to_the_chart():
    image, place = plain()
    color = measure(image, corners(place, off=np.array([[3.0, -2], [-3, 2], [2, 3], [-2, -3]])))  # an unsteady hand
    assert color.source == "corners" and np.isnan(color.cost)
    assert centers_off(color, place).max() < 0.1
    assert color.place.corners == pytest.approx(chart.Placement(place, 0.87).corners(), abs=0.15)


def test_corners_from_the_wrong_end_are_named():
    image, place = plain()
    with pytest.raises(ChartError, match="upside down"):
        measure(image, corners(place @ [[-1.0, 0, 6], [0, -1.0, 4], [0, 0, 1]]))


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        (None, "four outer corners of the patches"),
        ([[10, 10], [10, 200], [300, 200], [300, 10]], "clockwise"),
        ([[10, 10], [3000, 10], [3000, 2000], [10, 2000]], "outside the picture"),
        ([[10, 10], [40, 10], [40, 30], [10, 30]], "space the patches by"),
        ([[10, 10], [310, 10], [310, 210], [10, 210]], "do not show a ColorChecker Classic"),
    ],
)
def test_impossible_corners_are_one_clear_line(stated, message):
    request = ChartRequest("corners", corners=None if stated is None else np.array(stated, float))
    with pytest.raises(ChartError, match=message):
        measure(plain()[0], request)


def test_profile_brings_its_matrix_and_leaves_its_chart_behind():
    image, _ = plain()
    profile = measure(image)
    color = measure(0 * image, ChartRequest("profile", profile=profile))
    assert color.matrix is profile.matrix
    assert (color.source, color.place) == ("profile", None)


def test_without_a_chart_the_camera_is_believed_with_sensor_white_at_one():
    image, _ = plain()
    matrix = np.array([[1.9, -0.7, -0.2], [-0.2, 1.5, -0.3], [0.0, -0.5, 1.5]])
    known = stack(image, sensor=ColorSensor(matrix, np.array([2.0, 1, 1.5])))
    color = measure(known, ChartRequest("none"))
    assert color.source == "camera"
    assert 2 * color.matrix == pytest.approx(matrix)
    balance = stack(image, sensor=ColorSensor(white_balance=np.array([2.0, 1, 1.5])))
    color = measure(balance, ChartRequest("none"))
    assert 2 * color.matrix == pytest.approx(np.diag([2.0, 1, 1.5]))
    color = measure(image, ChartRequest("none"))
    assert (color.source, color.metres_per_px) == ("none", None)
    assert 2 * color.matrix == pytest.approx(np.eye(3))


def test_scale_comes_from_the_charts_width_and_only_from_it():
    """A chart of pitch 15.5 mm, 0.7 m away, turned and tilted: Z/f."""
    view = View(1100.0, (WIDTH / 2, HEIGHT / 2), 2.0)
    turn = cv2.Rodrigues(np.radians([8.0, -12.0, 10.0]))[0]
    camera = np.array([[view.focal, 0, view.center[0]], [0, view.focal, view.center[1]], [0, 0, 1]])
    flat = np.stack([0.0155 * turn[:, 0], 0.0155 * turn[:, 1], [0.04, 0.01, 0.7]], axis=1)
    place = camera @ flat @ np.array([[1, 0, -3], [0, 1, -2], [0, 0, 1]])
    radiance = stack(photograph(place / place[2, 2]), view)
    width = 0.0155 * 5.87
    color = measure(radiance, chart_width_m=width)
    assert color.metres_per_px == pytest.approx(0.7 / 1100, rel=3e-3)
    assert measure(radiance).metres_per_px is None
