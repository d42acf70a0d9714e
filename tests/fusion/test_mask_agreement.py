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


def view(k: int, shift: Floats | None = None) -> Silhouette:
    at = board_views.pose(360 * k / COUNT)
    mask = render.gbuffer(board_views.scene(at, SNOWMAN, shift=shift), VIEW, HEIGHT, WIDTH).mask
    return Silhouette(f"view{k + 1:02d}", mask, CAMERA, at)


def overlap(one: Bools, other: Bools) -> float:
    return float((one & other).sum() / (one | other).sum())


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    """A grid with half of the points, for speed."""
    monkeypatch.setattr(silhouettes, "_GRID", 64)


@pytest.fixture(scope="module")
def whole() -> list[Silhouette]:
    return [view(k) for k in range(COUNT)]


@pytest.fixture
def views(whole: list[Silhouette]) -> list[Silhouette]:
    """The same, with masks that a test may change."""
    return [replace(one, mask=one.mask.copy()) for one in whole]


def compare_all(views: list[Silhouette]) -> list[Bools]:
    """The masks after a comparison that leaves no view out."""
    used, left_out = mask_agreement.compare_set(views)
    assert not left_out
    return [one.mask for one in used]


def rows(mask: Bools) -> np.ndarray:
    return np.flatnonzero(mask.any(axis=1))


def remove_head(mask: Bools) -> None:
    mask[: rows(mask)[len(rows(mask)) // 3]] = False


def test_masks_of_one_object_agree_and_stay_as_they_are(whole: list[Silhouette]) -> None:
    assert all(overlap(found, right.mask) > 0.99 for right, found in zip(whole, compare_all(whole), strict=True))


@pytest.mark.filterwarnings("error")
def test_a_point_near_the_plane_of_the_lens_is_not_in_the_picture(views: list[Silhouette]) -> None:
    distorted = replace(views[0], camera=replace(CAMERA, k1=0.1, k2=0.1))
    near_lens = distorted.pose.rotation.T @ (np.array([0.05, 0, -1e-7]) - distorted.pose.translation)
    shown = distorted.shows(np.array([near_lens, [0.0, 0.0, 0.0]]), 0.002)
    assert shown.tolist() == [False, True]


def test_outlines_that_err_by_two_pixels_agree(views: list[Silhouette]) -> None:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    for k, one in enumerate(views):
        one.mask[:] = (cv2.erode if k % 2 else cv2.dilate)(one.mask.astype(np.uint8), disc)
    compare_all(views)


def test_pieces_of_the_board_are_removed_from_the_masks_that_hold_them(
    whole: list[Silhouette], views: list[Silhouette]
) -> None:
    views[2].mask[-160:-90, 150:330] = True
    views[5].mask[-200:-60, 380:600] = True
    for right, found in zip(whole, compare_all(views), strict=True):
        assert overlap(found, right.mask) > 0.97, right.name


def test_a_slit_of_one_mask_is_closed(whole: list[Silhouette], views: list[Silhouette]) -> None:
    middle = rows(views[3].mask)[len(rows(views[3].mask)) // 2]
    views[3].mask[middle : middle + 4] = False
    assert overlap(compare_all(views)[3], whole[3].mask) > 0.99


def test_a_small_hole_of_one_mask_is_filled(whole: list[Silhouette], views: list[Silhouette]) -> None:
    high, wide = (np.flatnonzero(whole[3].mask.any(axis=axis)) for axis in (1, 0))
    side = round(np.sqrt(0.008 * whole[3].mask.sum()))
    top, left = high[len(high) * 2 // 3], wide[len(wide) // 2]
    hole = np.s_[top : top + side, left : left + side]
    views[3].mask[hole] = False
    masks = compare_all(views)
    assert masks[3][hole].all()
    assert all(overlap(mask, right.mask) > 0.99 for mask, right in zip(masks, whole))


def test_a_mask_that_lacks_a_part_of_the_object_is_left_out(views: list[Silhouette]) -> None:
    remove_head(views[5].mask)
    assert list(mask_agreement.compare_set(views)[1]) == ["view06"]


def test_two_masks_that_lack_the_same_part_do_not_outvote_whole_ones(views: list[Silhouette]) -> None:
    for k in (2, 5):
        remove_head(views[k].mask)
    assert sorted(mask_agreement.compare_set(views)[1]) == ["view03", "view06"]


def test_a_view_in_which_the_object_had_slid_is_left_out(
    views: list[Silhouette], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(silhouettes, "_GRID", GRID)  # a coarse one does not show a slide of a centimetre
    _, left_out = mask_agreement.compare_set([*views[:-1], view(COUNT - 1, np.array([0.008, 0, 0.005]))])
    assert list(left_out) == ["view08"]
    assert "moved on the board" in left_out["view08"]


def test_pieces_of_the_board_at_the_object_in_two_masks_leave_no_view_out(views: list[Silhouette]) -> None:
    for k, height in ((1, 0.28), (5, -0.22)):  # of the piece under the mask's middle, of its height
        mask = views[k].mask
        middle = int(np.nonzero(mask)[0].mean() + height * np.ptp(rows(mask)))
        edge = np.flatnonzero(mask[middle]).max()
        mask[middle - 9 : middle + 9, edge : edge + 28] = True
    compare_all(views)


def test_an_object_that_slid_halfway_is_refused(views: list[Silhouette]) -> None:
    slid = [view(k, np.array([0.012, 0, 0.0])) for k in range(4, COUNT)]
    with pytest.raises(CaptureError, match="moved on the board"):
        mask_agreement.compare_set([*views[:4], *slid])
