"""The solver of weighted Laplacians: right answers, in few iterations, whatever the weights."""

import numpy as np
import pytest
from scipy import sparse

from polcap.stages.surface.multigrid import Multigrid, TwoGrid, conjugate_gradients

SIZE = 120


def laplacian(kind: str, rng: np.random.Generator) -> tuple[sparse.csr_matrix, np.ndarray]:
    number = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)
    p = np.concatenate([number[:, :-1].ravel(), number[:-1].ravel()])
    q = np.concatenate([number[:, 1:].ravel(), number[1:].ravel()])
    weight = np.ones(len(p))
    if kind == "random":
        weight = 10 ** rng.uniform(-2, 0, len(p))
    if kind == "cut":  # a square all but cut out of the plane, and links missing here and there
        inside = np.zeros((SIZE, SIZE), dtype=bool)
        inside[30:90, 40:80] = True
        weight = np.where(inside.ravel()[p] != inside.ravel()[q], 1e-8, rng.choice([1.0, 1e-4], len(p), p=[0.9, 0.1]))
    right_and_down = sparse.coo_matrix((-weight, (p, q)), (SIZE**2, SIZE**2))
    off = (right_and_down + right_and_down.T).tocsr()
    matrix = (off + sparse.diags(1e-8 - np.asarray(off.sum(axis=1)).ravel())).tocsr()
    return matrix, np.stack(np.divmod(np.arange(SIZE**2), SIZE), axis=-1)


@pytest.mark.parametrize("kind", ["even", "random", "cut"])
def test_few_iterations_reach_the_solution(kind: str, rng: np.random.Generator) -> None:
    matrix, pixel = laplacian(kind, rng)
    truth = np.cumsum(rng.normal(size=SIZE**2))
    truth -= truth.mean()
    right = matrix @ truth
    x, taken = conjugate_gradients(matrix, right, np.zeros(SIZE**2), Multigrid(matrix, pixel), 1e-8, 60)
    assert taken <= 40
    assert np.linalg.norm(right - matrix @ x) <= 1e-8 * np.linalg.norm(right)
    assert np.sqrt((x - truth) @ (matrix @ (x - truth))) < 1e-4 * np.sqrt(truth @ right)  # in the energy's norm


def two_grid(kind: str, rng: np.random.Generator) -> tuple[sparse.csr_matrix, TwoGrid]:
    """The even grid above one of half its resolution, whose links weigh the same."""
    matrix, pixel = laplacian(kind, rng)
    parent = (pixel[:, 0] // 2) * (SIZE // 2) + pixel[:, 1] // 2
    group = sparse.csr_matrix((np.ones(len(parent)), parent, np.arange(len(parent) + 1)))
    coarse = (group.T @ (matrix @ group) / 2).tocsr()  # two fine links cross each border
    return matrix, TwoGrid(
        matrix, parent, Multigrid(coarse, np.stack(np.divmod(np.arange(len(parent) // 4), SIZE // 2), -1))
    )


@pytest.mark.parametrize("kind", ["even", "random"])
def test_half_resolution_preconditions_the_whole(kind: str, rng: np.random.Generator) -> None:
    matrix, cycle = two_grid(kind, rng)
    truth = np.cumsum(rng.normal(size=SIZE**2))
    truth -= truth.mean()
    right = matrix @ truth
    x, taken = conjugate_gradients(matrix, right, np.zeros(SIZE**2), cycle, 1e-3, 40)
    assert taken <= 30
    assert np.sqrt((x - truth) @ (matrix @ (x - truth))) < 1e-2 * np.sqrt(truth @ right)


def test_preconditioners_are_symmetric(rng: np.random.Generator) -> None:
    """Conjugate gradients need it."""
    matrix, pixel = laplacian("random", rng)
    a, b = rng.normal(size=(2, SIZE**2))
    for cycle, rounding in ((Multigrid(matrix, pixel), 1e-9), (two_grid("random", rng)[1], 1e-3)):  # float32
        assert a @ cycle(b) == pytest.approx(b @ cycle(a), rel=rounding)
