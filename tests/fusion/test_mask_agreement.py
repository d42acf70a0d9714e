"""Masks of one object agree; what only one shows is removed; a mask without a part, and a slid object, are named."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.fusion import mask_agreement, silhouettes
from polcap.fusion.poses import SessionCamera
from polcap.fusion.silhouettes import Silhouette
from polcap.image_values import Bools, Floats
from polcap.synth import render
from polcap.synth.distance_fields import Cluster
from tests.fusion import board_views
from tests.fusion.board_views import FOCAL, HEIGHT, VIEW, WIDTH

SNOWMAN = Cluster(((0, 0, 0, 0.03), (0, 0.04, 0, 0.02), (0.025, 0.04, 0, 0.012)))
COUNT = 8
GRID = silhouettes._GRID
CAMERA = SessionCamera(FOCAL, 1.0, VIEW.center, 0.0, 0.0)


def view(k: int, shift: Floats | None = None, count: int = COUNT) -> Silhouette:
    at = board_views.pose(360 * k / count)
    mask = render.gbuffer(board_views.scene(at, SNOWMAN, shift=shift), VIEW, HEIGHT, WIDTH).mask
    return Silhouette(f"view{k + 1:02d}", mask, CAMERA, at)


def overlap(one: Bools, other: Bools) -> float:
    return float((one & other).sum() / (one | other).sum())


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid with half of the points, for speed."""
    monkeypatch.setattr(silhouettes, "_GRID", 64)


@pytest.fixture(scope="module")
def views() -> list[Silhouette]:
    return [view(k) for k in range(COUNT)]


def test_masks_of_one_object_agree_and_stay_as_they_are(views: list[Silhouette]) -> None:
    used, left_out = mask_agreement.compare_set(views)
    assert not left_out
    assert all(overlap(found.mask, right.mask) > 0.99 for right, found in zip(views, used, strict=True))


def test_outlines_that_err_by_two_pixels_agree(views: list[Silhouette]) -> None:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    wrong = [
        replace(one, mask=(cv2.erode if k % 2 else cv2.dilate)(one.mask.astype(np.uint8), disc) > 0)
        for k, one in enumerate(views)
    ]
    assert not mask_agreement.compare_set(wrong)[1]


def test_pieces_of_the_board_are_removed_from_the_masks_that_hold_them(views: list[Silhouette]) -> None:
    wrong = list(views)
    for k, box in ((2, np.s_[-160:-90, 150:330]), (5, np.s_[-200:-60, 380:600])):
        mask = views[k].mask.copy()
        mask[box] = True
        wrong[k] = replace(views[k], mask=mask)
    used, left_out = mask_agreement.compare_set(wrong)
    assert not left_out
    for right, found in zip(views, used, strict=True):
        assert overlap(found.mask, right.mask) > 0.97, found.name


def test_a_slit_of_one_mask_is_closed(views: list[Silhouette]) -> None:
    mask = views[3].mask.copy()
    rows = np.flatnonzero(mask.any(axis=1))
    mask[rows[len(rows) // 2] : rows[len(rows) // 2] + 4] = False
    used, left_out = mask_agreement.compare_set([*views[:3], replace(views[3], mask=mask), *views[4:]])
    assert not left_out
    assert overlap(used[3].mask, views[3].mask) > 0.99


def test_a_small_hole_of_one_mask_is_filled(views: list[Silhouette]) -> None:
    mask = views[3].mask.copy()
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    side = round(np.sqrt(0.008 * mask.sum()))
    top, left = rows[len(rows) * 2 // 3], columns[len(columns) // 2]
    mask[top : top + side, left : left + side] = False
    used, left_out = mask_agreement.compare_set([*views[:3], replace(views[3], mask=mask), *views[4:]])
    assert not left_out
    assert used[3].mask[top : top + side, left : left + side].all()
    assert all(overlap(one.mask, whole.mask) > 0.99 for one, whole in zip(used, views))


def test_a_mask_that_lacks_a_part_of_the_object_is_left_out(views: list[Silhouette]) -> None:
    mask = views[5].mask.copy()
    rows = np.flatnonzero(mask.any(axis=1))
    mask[: rows[len(rows) // 3]] = False  # the head
    _, left_out = mask_agreement.compare_set([*views[:5], replace(views[5], mask=mask), *views[6:]])
    assert list(left_out) == ["view06"]


def test_two_masks_that_lack_the_same_part_do_not_outvote_whole_ones() -> None:
    twelve = [view(k, count=12) for k in range(12)]
    for k in (2, 7):
        rows = np.flatnonzero(twelve[k].mask.any(axis=1))
        twelve[k].mask[: rows[len(rows) // 3]] = False
    assert sorted(mask_agreement.compare_set(twelve)[1]) == ["view03", "view08"]


def test_a_view_in_which_the_object_had_slid_is_left_out(
    views: list[Silhouette], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(silhouettes, "_GRID", GRID)  # a coarse one does not show a slide of a centimetre
    _, left_out = mask_agreement.compare_set([*views[:-1], view(COUNT - 1, np.array([0.008, 0, 0.005]))])
    assert list(left_out) == ["view08"]
    assert "moved on the board" in left_out["view08"]


def test_pieces_of_the_board_at_the_object_in_two_masks_leave_no_view_out(views: list[Silhouette]) -> None:
    wrong = list(views)
    for k, height in ((1, 0.28), (5, -0.22)):  # of the piece under the mask's middle, of its height
        mask = views[k].mask.copy()
        rows = np.flatnonzero(mask.any(axis=1))
        middle = int(np.nonzero(mask)[0].mean() + height * np.ptp(rows))
        edge = np.flatnonzero(mask[middle]).max()
        mask[middle - 9 : middle + 9, edge : edge + 28] = True
        wrong[k] = replace(views[k], mask=mask)
    assert not mask_agreement.compare_set(wrong)[1]


def test_an_object_that_slid_halfway_is_refused(views: list[Silhouette]) -> None:
    slid = [view(k, np.array([0.012, 0, 0.0])) for k in range(4, COUNT)]
    with pytest.raises(CaptureError, match="moved on the board"):
        mask_agreement.compare_set([*views[:4], *slid])
