"""Sets of views between which the object was laid on its side are joined by its shape and albedo."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polcap.errors import CaptureError
from polcap.fusion import joining, shape
from polcap.fusion.joining import JoinedSet
from polcap.fusion.values import FusionView
from polcap.optics.mesh_tracer import Tracer, smooth
from polcap.quality.limits import FusedGateLimits
from tests.fusion.traced_views import Body, capture, ring, solid_texture, stand, with_errors

trimesh = pytest.importorskip("trimesh")
COUNT = 8  # views of a set
COARSE = ((joining, "_GRID", 60), (joining, "_TURNS", 300), (shape, "_FIRST_ROUNDS", 1), (shape, "_ROUNDS", 3))
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
    """Views with errors, of the standing body or of the laid one; its texture is fixed to the body."""
    out = []
    for pose in ring(body, COUNT):
        view = capture(body, pose, 160)
        if shift is not None:
            position = body.tracer.trace(pose.rotation, pose.translation, view.camera, 160, 160).position
            own = TIP.inv().apply((position - shift).reshape(-1, 3)).reshape(position.shape)
            albedo = np.where(view.mask[..., None], solid_texture(own / body.size), 0).astype(np.float32)
            view = replace(view, diffuse=albedo)
        out.append(with_errors(body, view, rng))
    return out


def named(some: list[FusionView], folder: str) -> tuple[FusionView, ...]:
    """The views with names in the folder of a set."""
    return tuple(replace(view, name=f"{folder}/view{k:02d}".lstrip("/")) for k, view in enumerate(some, 1))


class Session(NamedTuple):
    """Three sets of views, joined: setA of the standing body, setB of the laid one, setC of another body."""

    body: Body
    shift: np.ndarray  # (3,) m, after the turn TIP
    views: tuple[FusionView, ...]
    joined: tuple[JoinedSet, ...]


@pytest.fixture(scope="module")
def session() -> Session:
    rng, body = np.random.default_rng(6), pear()
    (other, shift), torus = laid(body), trimesh.creation.torus(1.0, 0.35, 48, 24)
    sets = [views(body, None, rng), views(other, shift, rng), views(stand(torus.vertices, torus.faces), None, rng)]
    made = sum((named(one, f"set{letter}") for one, letter in zip(sets, "ABC")), ())
    with pytest.MonkeyPatch.context() as patch:
        for module, name, value in COARSE:
            patch.setattr(module, name, value)
        return Session(body, shift, made, joining.join(made))


def test_a_laid_object_is_turned_back(session: Session) -> None:
    first, second = session.views[:COUNT], session.views[COUNT : 2 * COUNT]
    assert session.joined[0].folder == "setB" and session.joined[0].shared > 0.85
    placed = joining.place(session.views, session.joined)
    assert placed[:COUNT] == first
    back = joining.Motion(TIP.inv().as_matrix(), -TIP.inv().apply(session.shift))
    for view, before in zip(placed[COUNT:], second):
        true = back.pose(before.pose)
        turn = Rotation.from_matrix(view.pose.rotation @ true.rotation.T).magnitude()
        assert np.degrees(turn) < 1.0  # a pixel of these views at the object's rim
        away = (view.pose.rotation - true.rotation) @ session.body.middle + view.pose.translation - true.translation
        assert np.linalg.norm(away) < 0.006 * session.body.size  # half a pixel and more


def test_another_object_is_recognized(session: Session) -> None:
    other = session.joined[1:]
    with pytest.raises(CaptureError, match=r"setC: the first set confirms .* fusion.gates.min_shared = 70% is needed"):
        joining.require_shared(other, FusedGateLimits().min_shared)
    joining.require_shared(other, 0.0)


def test_a_single_set_needs_no_joining(session: Session) -> None:
    alone = named(list(session.views[:COUNT]), "")
    assert joining.join(alone) == () and joining.place(alone, ()) == alone
