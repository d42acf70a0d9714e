"""What is flat, what has sharp edges, and what is rounded, by polarization, light and normals of ideal objects."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from polcap.quality import flatness
from polcap.quality.flatness import Flatness

SIDE = 160  # px
Y, X = (np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2) / (0.4 * SIDE)


def measure(normal: Any, mask: Any, dolp: Any, light: Any) -> Flatness:
    """Flatness of a surface with normals (H, W, 3), polarized by `dolp` (H, W) along their azimuth."""
    azimuth = np.arctan2(normal[..., 1], normal[..., 0])
    stokes = light * np.stack([np.ones_like(dolp), dolp * np.cos(2 * azimuth), dolp * np.sin(2 * azimuth)])
    image: Any = SimpleNamespace(mask=mask, stokes=np.repeat((stokes * mask)[..., None] / 3, 3, axis=-1))
    maps: Any = SimpleNamespace(mask=mask, normal=normal, confidence=np.full(mask.shape, 15.0))
    found = flatness.measure(image, maps)
    assert found is not None
    return found


def ball(polarizing: Any = 0.35) -> Flatness:
    mask = np.hypot(X, Y) < 1
    z = np.sqrt(np.maximum(1 - X**2 - Y**2, 0))
    return measure(np.stack([X, -Y, z], axis=-1), mask, polarizing * (1 - z**2), 0.2 + 0.8 * z)


def faces(*tilts_deg: float, relief_deg: float = 0.0) -> Flatness:
    """Upright strips of equal width in a square, turned about the upright axis, with a random relief."""
    random = np.random.default_rng(1)
    strip = np.clip(((X + 1) / 2 * len(tilts_deg)).astype(int), 0, len(tilts_deg) - 1)
    slope = np.tan(np.radians(np.array(tilts_deg)))[strip]
    relief = np.tan(np.radians(relief_deg)) * random.normal(size=(2, SIDE, SIDE))
    normal = np.stack([slope + relief[0], relief[1], np.ones_like(X)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    mask = np.maximum(np.abs(X), np.abs(Y)) < 1
    return measure(normal, mask, 0.35 * (1 - normal[..., 2] ** 2), normal[..., 2])


def test_a_ball_is_rounded() -> None:
    seen = ball()
    assert not seen.sharp_edged and not seen.flat
    assert seen.contour > 0.9 and seen.common < 0.05 and seen.aligned == pytest.approx(2 / 3, abs=0.02)


def test_each_part_of_an_outline_is_judged_by_itself() -> None:
    assert ball(polarizing=np.where(X > 0.5, 0.35, 0.01)).contour == pytest.approx(1 / 3, abs=0.05)


def test_a_ball_that_hardly_polarizes_is_not_taken_for_a_plane() -> None:
    """Wax, or a polarizer that was off: the outline is dimmed as that of a rounded surface."""
    seen = ball(polarizing=0.01)
    assert seen.contour == 0 and not seen.sharp_edged and not seen.flat


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0, 45.0])
def test_a_plane_with_relief_is_flat(tilt_deg: float) -> None:
    seen = faces(tilt_deg, relief_deg=4.0)
    assert seen.flat and seen.facing == pytest.approx(np.cos(np.radians(tilt_deg)), abs=0.01)


def test_a_box_has_sharp_edges_and_is_not_flat() -> None:
    seen = faces(-50.0, 40.0)
    assert seen.sharp_edged and not seen.flat


def test_a_crumpled_sheet_is_neither_flat_nor_rounded_and_no_order_of_its_shots_is_known() -> None:
    """Figures of a simulated sheet; the network expects 1.2 times smaller errors in a wrong order."""
    sheet = Flatness(
        contour=0.08, common=0.08, rim_dolp=0.22, rim_light=1.09, aligned=0.8, facing=0.95, expected_deg=29.0
    )
    assert sheet.sheet and not sheet.flat
    assert not sheet.decides(0.84) and sheet.decides(0.4)
    for rounded in (replace(sheet, contour=0.3), replace(sheet, aligned=0.7), replace(sheet, rim_dolp=0.04)):
        assert not rounded.sheet and rounded.decides(0.84)
    assert not replace(sheet, expected_deg=8.0).sheet


def test_a_can_seen_from_above_has_sharp_edges_although_its_wall_is_dim() -> None:
    """Figures of a simulated can, whose lid faces the camera."""
    can = Flatness(
        contour=0.17, common=0.41, rim_dolp=0.166, rim_light=0.52, aligned=0.7, facing=0.99, expected_deg=3.3
    )
    assert can.sharp_edged and not can.flat
    assert not replace(can, rim_dolp=0.05).sharp_edged  # wax


def test_a_small_object_is_not_measured() -> None:
    mask = np.zeros((20, 20), bool)
    mask[10, 10] = True
    image: Any = SimpleNamespace(mask=mask, stokes=np.ones((3, 20, 20, 3)))
    assert flatness.measure(image, SimpleNamespace(mask=mask, normal=np.ones((20, 20, 3)))) is None  # type: ignore[arg-type]
