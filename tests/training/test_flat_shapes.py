"""Flat and sharp-edged meshes for training: closed, facing outwards, and mostly seen from their front."""

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from polcap.optics.mesh_tracer import Tracer, Triangles, centred
from polcap.optics.morphology import erode
from polcap.training import flat_shapes, traced_views

SIZE = 64
PLANES = (flat_shapes._slab, flat_shapes._coin, flat_shapes._tile, flat_shapes._sheet)


@pytest.mark.parametrize("kind", dict.fromkeys(flat_shapes._KINDS), ids=lambda kind: kind.__name__)
def test_surfaces_are_closed_and_face_outwards(kind: Callable[[np.random.Generator], Triangles]) -> None:
    """Each edge is shared by two faces that run through it in opposite directions; the volume is positive."""
    mesh = centred(kind(np.random.default_rng(1)))
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(1, abs=1e-5)
    _, same = np.unique(np.round(mesh.vertices / 1e-6), axis=0, return_inverse=True)
    corners = same.reshape(-1)[mesh.faces]
    edges = Counter(map(tuple, np.concatenate([corners[:, [k, (k + 1) % 3]] for k in range(3)])))
    assert all(edges[b, a] == count for (a, b), count in edges.items() if a != b)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(float) for k in range(3))
    assert np.einsum("ni,ni->n", a, np.cross(b, c)).sum() > 0
    assert (np.einsum("ni,nji->nj", np.cross(b - a, c - a), mesh.corner_normals) > -1e-9).all()


def test_the_edge_between_front_and_side_is_sharp() -> None:
    """Shading normals at a box's edges are those of its faces, not their mean."""
    x, y = flat_shapes._rectangle(0.6)
    mesh = flat_shapes._solid(x, y, np.zeros_like(x), 0.3)
    assert np.abs(mesh.corner_normals).max(axis=-1).min() == pytest.approx(1, abs=1e-6)


def test_most_views_of_flat_things_show_their_front_facing_or_tilted() -> None:
    rng = np.random.default_rng(0)
    tilt = [flat_shapes.rotation(rng)[2, 2] for _ in range(800)]
    degrees = np.degrees(np.arccos(tilt))
    assert 0.35 < (degrees < 12).mean() < 0.5
    assert 0.3 < ((degrees > 12) & (degrees < 70)).mean() < 0.6


def test_relief_spans_flat_to_steep() -> None:
    """Root mean square tilts of facing plates, from a plane to a carving."""
    tilts = []
    for seed in range(24):
        rng = np.random.default_rng([3, seed])
        mesh = centred(PLANES[seed % len(PLANES)](rng))
        buffer, _, _ = traced_views.trace_random_view("a plate", Tracer(mesh), SIZE, rng, lambda _: np.eye(3))
        inside = erode(buffer.mask, 2)
        tilts.append(float(np.degrees(np.arccos(np.clip(buffer.normal[inside][:, 2], -1, 1))).mean()))
    assert min(tilts) < 2 and np.median(tilts) < 15 and max(tilts) > 10
