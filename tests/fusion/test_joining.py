"""Sets of views between which the object was laid on its side are joined by its shape and albedo."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polcap.errors import CaptureError
from polcap.fusion import joining
from polcap.fusion.values import FusionView
from polcap.optics.mesh_tracer import Tracer, smooth
from polcap.quality.limits import FusedGateLimits
from tests.fusion.traced_views import Body, capture, ring, solid_texture, stand, with_errors

trimesh = pytest.importorskip("trimesh")
TIP = Rotation.from_euler("yxz", [40, 87, 5], degrees=True)


def pear() -> Body:
    """A body without symmetry."""
    ball = trimesh.creation.icosphere(4)
    x, y, z = ball.vertices.T
    bumps = 1 + 0.25 * y + 0.12 * np.sin(3 * x + 1) + 0.1 * np.cos(4 * z - 2 * x)
    return stand(ball.vertices * bumps[:, None] * [1, 0.9, 0.75], ball.faces)


def laid(body: Body) -> tuple[Body, np.ndarray]:
    """The body on its side, and the shift (3,) m after the turn TIP."""
    turned = TIP.apply(body.triangles.vertices)
    shift = np.array([0.004, -turned[:, 1].min(), -0.003])
    triangles = smooth(turned + shift, body.triangles.faces)
    middle = (triangles.vertices.min(axis=0) + triangles.vertices.max(axis=0)) / 2
    return Body(triangles, Tracer(triangles), middle, body.size), shift


def views(body: Body, shift: np.ndarray | None, rng: np.random.Generator) -> list[FusionView]:
    """Eight views with errors, of the standing body or of the laid one; its texture is fixed to the body."""
    out = []
    for pose in ring(body, 8):
        view = capture(body, pose, 160)
        if shift is not None:
            position = body.tracer.trace(pose.rotation, pose.translation, view.view, 160, 160).position
            own = TIP.inv().apply((position - shift).reshape(-1, 3)).reshape(position.shape)
            albedo = np.where(view.mask[..., None], solid_texture(own / body.size), 0).astype(np.float32)
            view = replace(view, diffuse=albedo)
        out.append(with_errors(body, view, rng))
    return out


def named(some: list[FusionView], folder: str) -> tuple[FusionView, ...]:
    """The views with names in the folder of a set."""
    return tuple(replace(view, name=f"{folder}/view{k:02d}".lstrip("/")) for k, view in enumerate(some, 1))


def test_a_laid_object_is_turned_back(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joining, "_GRID", 60)
    body = pear()
    other, shift = laid(body)
    first, second = views(body, None, rng), views(other, shift, rng)
    views_ = named(first, "setA") + named(second, "setB")
    (joined,) = joining.join(views_)
    assert joined.folder == "setB" and joined.shared > 0.85
    placed = joining.place(views_, (joined,))
    assert placed[: len(first)] == views_[: len(first)]
    true = [joining.Motion(TIP.inv().as_matrix(), -TIP.inv().apply(shift)).pose(view.pose) for view in second]
    for view, pose in zip(placed[len(first) :], true, strict=True):
        turn = Rotation.from_matrix(view.pose.rotation @ pose.rotation.T).magnitude()
        assert np.degrees(turn) < 1.0  # a pixel of these views at the object's rim
        away = (view.pose.rotation - pose.rotation) @ body.middle + view.pose.translation - pose.translation
        assert np.linalg.norm(away) < 0.006 * body.size  # half a pixel and more


def test_another_object_is_recognized(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(joining, "_GRID", 40)
    monkeypatch.setattr(joining, "_TURNS", 500)
    torus = trimesh.creation.torus(1.0, 0.35, 48, 24)
    other = stand(torus.vertices, torus.faces)
    joined = joining.join(named(views(pear(), None, rng), "setA") + named(views(other, None, rng), "setB"))
    with pytest.raises(CaptureError, match=r"setB: the first set confirms .* fusion.gates.min_shared = 70% is needed"):
        joining.require_shared(joined, FusedGateLimits().min_shared)
    joining.require_shared(joined, 0.0)


def test_a_single_set_needs_no_joining(rng: np.random.Generator) -> None:
    alone = named(views(pear(), None, rng), "")
    assert joining.join(alone) == () and joining.place(alone, ()) == alone
