"""Masks of one object agree; a wrong mask and an object that slid on the board are named."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from polcap.errors import CaptureError
from polcap.fusion import mask_agreement
from polcap.fusion.values import FusionView
from polcap.images import Floats
from polcap.synth import render
from polcap.synth.distance_fields import Cluster
from tests.fusion import board_views
from tests.fusion.board_views import HEIGHT, VIEW, WIDTH

SNOWMAN = Cluster(((0, 0, 0, 0.03), (0, 0.04, 0, 0.02), (0.025, 0.04, 0, 0.012)))
COUNT = 8


def view(k: int, aside: Floats | None = None) -> FusionView:
    at = board_views.pose(360 * k / COUNT)
    mask = render.gbuffer(board_views.scene(at, SNOWMAN, aside=aside), VIEW, HEIGHT, WIDTH).mask
    empty: Floats = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    flat: Floats = empty[..., 0]
    return FusionView(f"view{k + 1:02d}", at, VIEW, np.zeros(3), mask, empty, flat, empty, empty, flat)


@pytest.fixture(scope="module")
def views() -> list[FusionView]:
    return [view(k) for k in range(COUNT)]


def test_masks_of_one_object_agree(views: list[FusionView]) -> None:
    used, left_out = mask_agreement.agreeing(views)
    assert len(used) == COUNT
    assert not left_out


def test_outlines_that_err_by_two_pixels_agree(views: list[FusionView]) -> None:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    wrong = [
        replace(one, mask=(cv2.erode if k % 2 else cv2.dilate)(one.mask.astype(np.uint8), disc) > 0)
        for k, one in enumerate(views)
    ]
    assert not mask_agreement.agreeing(wrong)[1]


def test_a_mask_that_holds_a_piece_of_the_board_is_left_out(views: list[FusionView]) -> None:
    mask = views[2].mask.copy()
    mask[-160:-90, 150:330] = True
    used, left_out = mask_agreement.agreeing([*views[:2], replace(views[2], mask=mask), *views[3:]])
    assert list(left_out) == ["view03"]
    assert len(used) == COUNT - 1


def test_a_mask_that_lacks_a_part_of_the_object_is_left_out(views: list[FusionView]) -> None:
    mask = views[5].mask.copy()
    rows = np.flatnonzero(mask.any(axis=1))
    mask[: rows[len(rows) // 3]] = False  # the head
    _, left_out = mask_agreement.agreeing([*views[:5], replace(views[5], mask=mask), *views[6:]])
    assert list(left_out) == ["view06"]


def test_a_view_in_which_the_object_had_slid_is_left_out(views: list[FusionView]) -> None:
    _, left_out = mask_agreement.agreeing([*views[:-1], view(COUNT - 1, np.array([0.008, 0, 0.005]))])
    assert list(left_out) == ["view08"]
    assert "moved on the board" in left_out["view08"]


def test_an_object_that_slid_halfway_is_refused(views: list[FusionView]) -> None:
    slid = [view(k, np.array([0.012, 0, 0.0])) for k in range(4, COUNT)]
    with pytest.raises(CaptureError, match="moved on the board"):
        mask_agreement.agreeing([*views[:4], *slid])
