"""Random meshes: closed, and facing outwards."""

import numpy as np
import pytest

from polcap.training import random_shapes


def test_branches_are_closed_and_face_outwards() -> None:
    """A surface whose faces turn outwards encloses a positive volume (the divergence theorem)."""
    for seed in range(4):
        start, rng = np.array([0.0, 0.3, 0.1]), np.random.default_rng(seed)
        vertices, faces = random_shapes._branch(start, 0.04, 0.8, np.ones(3), rng)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        volume = np.einsum("ni,ni->n", a, np.cross(b, c)).sum() / 6
        assert 0 < volume < np.pi * 0.06**2 * 2
    mesh = random_shapes.compose_with_branches(np.random.default_rng(2))
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(1, abs=1e-5)
