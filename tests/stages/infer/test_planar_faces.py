"""Planar faces: their smooth errors go, their fine relief stays; curved surfaces and certain normals do not change."""

import numpy as np
import pytest

from polcap.image_values import Bools, Floats
from polcap.optics import frames
from polcap.stages.infer.shape import planar_faces

SIZE = 96
Y, X = np.mgrid[-1 : 1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
EVERYWHERE = np.ones((SIZE, SIZE), bool)
PLANE = frames.unit(np.array([0.4, -0.2, 1.0]))


def surface(x: Floats, y: Floats) -> Floats:
    """Unit normals (H, W, 3) with slopes x and y."""
    return frames.unit(np.stack([x, y, np.ones_like(x)], axis=-1))


def error(found: Floats, true: Floats, where: Bools = EVERYWHERE) -> float:
    return float(frames.angle_deg(found, true)[where].mean())


def flattened(normal: Floats, expected_deg: float, mask: Bools = EVERYWHERE) -> Floats:
    return planar_faces.flatten(normal.astype(np.float32), np.full(mask.shape, expected_deg, np.float32), mask)


def test_a_plane_loses_its_smooth_error_and_keeps_its_relief() -> None:
    """The error bends the plane by 4° RMS over half of its side; the relief has a period of six pixels."""
    relief = 0.05 * np.sin(2 * np.pi * np.arange(SIZE) / 6)[None, :]
    bent, true = 0.1 * np.sin(np.pi * Y), np.full_like(Y, 0.2)
    found = flattened(surface(true + relief + bent, true), 10.0)
    assert error(surface(true + relief + bent, true), surface(true + relief, true)) > 3
    assert error(found, surface(true + relief, true)) < 0.5


def test_two_faces_keep_their_edge() -> None:
    left = X < 0
    true = np.where(left[..., None], PLANE, PLANE * [-1, 1, 1])
    bent = surface(true[..., 0] / true[..., 2] + 0.05 * np.sin(np.pi * Y), true[..., 1] / true[..., 2])
    inner = abs(X) > 0.1
    assert error(flattened(bent, 10.0), true, inner) < error(bent, true, inner) / 5


@pytest.mark.parametrize(
    "slopes",
    [(X, Y), (X, 0 * Y), (0.5 * X, 0.5 * Y), (0.3 * X, -0.3 * Y)],
    ids=["dome", "cylinder", "flat dome", "saddle"],
)
def test_curved_surfaces_do_not_change(slopes: tuple[Floats, Floats]) -> None:
    true = surface(*slopes)
    assert error(flattened(true, 20.0), true) < 0.1


def test_normals_that_are_certain_do_not_change() -> None:
    """A bent sheet: the expected error does not explain that it varies by 4°."""
    true = surface(0.1 * np.sin(np.pi * Y), 0 * X)
    assert error(flattened(true, 4.0), true) < 0.1


def test_an_object_of_few_pixels_or_none_passes() -> None:
    normal = np.broadcast_to(PLANE, (5, 7, 3))
    few = np.zeros((5, 7), bool)
    assert not flattened(normal, 5.0, few).any()
    few[2, 3] = True
    assert np.allclose(flattened(normal, 5.0, few)[2, 3], PLANE)


def test_normals_of_which_none_is_like_another_make_no_face():
    """Nor like itself: a mean of opposite normals is shorter than one."""
    mask = np.ones((40, 40), bool)
    normal = np.tile(np.array([0.0, 0.0, 0.5], np.float32), (40, 40, 1))
    assert list(planar_faces.faces(normal, mask)) == []
