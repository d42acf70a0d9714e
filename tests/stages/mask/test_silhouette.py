"""The outline of the mask: bright parts by the setting `mask.silhouette`, and pixels decided by their coverage."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from msgspec.structs import replace as with_setting

from polcap.image_values import Bools, Quality
from polcap.stage_values import AngleStack
from polcap.stages import mask
from polcap.stages.mask import MaskSettings, backdrop
from tests.fusion import board_views
from tests.fusion.test_board_eraser import STILL

LEG = np.s_[150:190, 98:101]
BALL = np.hypot(*(np.mgrid[:220, :200] - 100)) < 55


def stack(erased: bool) -> AngleStack:
    """A bright ball on a thin leg before a dark backdrop, of which the lowest rows may show an erased board."""
    value = np.where(BALL[..., None], [0.5, 0.4, 0.3], 0.01)
    value[LEG] = 0.4
    merged = board_views.stack(value)
    flags = np.where((np.mgrid[:220, :200][0] > 200) & erased, Quality.ERASED, Quality(0)).astype(np.uint8)
    return replace(merged, quality=merged.quality | flags)


def found(erased: bool, silhouette: str) -> Bools:
    settings = with_setting(MaskSettings(), silhouette=silhouette)
    return mask.segment(stack(erased), STILL, board_views.COLOR, None, None, lambda *_: {}, settings).mask


def test_thin_parts_are_added_where_a_board_was_erased_or_always(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backdrop, "find_object", lambda *_: BALL)
    assert not found(erased=False, silhouette="never")[LEG][10:].any()
    assert np.array_equal(found(erased=False, silhouette="board"), found(erased=False, silhouette="never"))
    assert found(erased=True, silhouette="board")[LEG][10:-4].all()
    assert np.array_equal(found(erased=False, silhouette="always"), found(erased=True, silhouette="board"))
    assert np.array_equal(found(erased=True, silhouette="never"), found(erased=False, silhouette="never"))


def test_pixels_on_the_outline_are_decided_by_their_coverage(monkeypatch: pytest.MonkeyPatch) -> None:
    coverage = cv2.GaussianBlur(BALL.astype(np.float32), (0, 0), 0.5)
    view = board_views.stack(0.01 + coverage[..., None] * [0.5, 0.4, 0.3])
    narrow = np.hypot(*(np.mgrid[:220, :200] - 100)) < 54
    monkeypatch.setattr(backdrop, "find_object", lambda *_: narrow)
    mask_ = mask.segment(view, STILL, board_views.COLOR, None, None, lambda *_: {}, MaskSettings()).mask
    assert (mask_ ^ BALL).sum() < 0.2 * (narrow ^ BALL).sum()
