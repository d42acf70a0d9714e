"""A handful of traced views of two simple objects, enough to try the training path on."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("embreex")

import torch

from polcap.training import gbuffers, materials, shapes
from polcap.training.dataset import Simulator


def write_mesh(path: Path, seed: int) -> None:
    """A mesh in the data folder's format."""
    mesh = shapes.compose(np.random.default_rng(seed))
    low, scale = mesh.vertices.min(axis=0), float(np.ptp(mesh.vertices, axis=0).max())
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path, vq=np.round((mesh.vertices - low) / scale * 65535).astype(np.uint16), vmin=low, vscale=np.float32(scale),
        faces=mesh.faces,
    )  # fmt: skip


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_mesh(folder / "meshes" / "train" / "one.npz", 1)
    write_mesh(folder / "meshes" / "test" / "two.npz", 2)
    return folder


@pytest.fixture(scope="session")
def views(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("views")
    gbuffers.build(folder, [data / "meshes" / "train" / "one.npz"], views=6, procedural=2, per_shape=3, size=64, seed=5)
    return folder


@pytest.fixture(scope="session")
def simulator(views: Path) -> Simulator:
    device = torch.device("cpu")
    return Simulator(gbuffers.load(views), materials.Library(None, device), device)
