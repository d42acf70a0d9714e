"""Ambient occlusion of a closed mesh, where geometry gives the share of the sky."""

import itertools

import numpy as np
import pytest
import trimesh

pytest.importorskip("uvunwrap")
pytest.importorskip("embreex")

from polcap.fusion import atlas as atlases
from polcap.fusion.atlas import Atlas
from polcap.fusion.mesh_occlusion import ambient_occlusion
from polcap.fusion.values import ClosedMesh
from tests.fusion import ellipsoid

PROFILE = [(0, 0), (2, 0), (2, 2), (1, 2), (1, 1), (0, 1)]  # of a pot with a pit of radius 1 and depth 1, around z


@pytest.fixture(scope="module")
def pot() -> Atlas:
    fine = np.concatenate([np.linspace(a, b, 20, endpoint=False) for a, b in itertools.pairwise(PROFILE)])
    body = trimesh.creation.revolve(np.vstack([fine, PROFILE[-1]]), sections=96)
    return atlases.chart(ClosedMesh(body.vertices.astype(np.float32), body.faces.astype(np.int32)), 512, 6)


def test_the_middle_of_a_pit_sees_its_share_of_the_sky(pot: Atlas) -> None:
    """Of a uniform sky, a round opening of half-angle a sends sin² a: ½ where the pit is as deep as its radius."""
    share = ambient_occlusion(pot)[pot.covered]
    x, y, z = pot.position.T
    bottom = (np.hypot(x, y) < 0.1) & (np.abs(z - 1) < 0.01)
    assert bottom.sum() > 20 and share[bottom] == pytest.approx(0.5, abs=0.02)


def test_convex_surfaces_see_the_whole_sky(pot: Atlas) -> None:
    x, y, _ = pot.position.T
    assert ambient_occlusion(pot)[pot.covered][np.hypot(x, y) > 1.1].min() > 0.99
    ball = atlases.chart(ellipsoid.mesh(), 256, 6)
    assert ambient_occlusion(ball)[ball.covered].min() > 0.99
