"""Small training data: meshes, texture sets, and a few traced views of two simple objects."""

from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("embreex")

import torch
from numpy.typing import NDArray

from polcap.image_values import Floats
from polcap.training import evaluation_materials, materials, random_shapes, traced_views
from polcap.training.simulator import Simulator

EXPORT_WARNINGS = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning", "ignore::UserWarning"
)
RECIPE = traced_views.ViewsRecipe(views=6, procedural=2, size=64, seed=5, per_shape=3, flat=2)


@pytest.fixture(autouse=True)
def seeded() -> None:
    """Random numbers of a test do not depend on earlier tests."""
    torch.manual_seed(0)


def write_mesh(path: Path, seed: int) -> None:
    """A mesh in the data folder's format."""
    mesh = random_shapes.compose(np.random.default_rng(seed))
    write(path, mesh.vertices, mesh.faces)


def write_blob(path: Path, seed: int) -> None:
    """A coarse ellipsoid with waves, which is traced fast."""
    unit, faces = random_shapes._sphere(24, 32)
    rng = np.random.default_rng(seed)
    lumps = 1 + 0.15 * np.sin(unit @ rng.normal(size=(3, 3)) * 4).sum(axis=1, keepdims=True)
    write(path, unit * lumps * rng.uniform(0.5, 1, 3), faces)


def write(path: Path, vertices: Floats, faces: NDArray[np.int32]) -> None:
    low, scale = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max())
    path.parent.mkdir(parents=True, exist_ok=True)
    quantized = np.round((vertices - low) / scale * 65535).astype(np.uint16)
    np.savez(path, vq=quantized, vmin=low, vscale=np.float32(scale), faces=faces)


def write_textures(folder: Path, seed: int) -> None:
    """A texture set of the data folder."""
    rng = np.random.default_rng(seed)
    folder.mkdir(parents=True)
    for name, channels in (("albedo", 3), ("roughness", 1), ("height", 1)):
        coarse = rng.integers(30, 220, (8, 8, channels), dtype=np.uint8)
        cv2.imwrite(str(folder / f"{name}.jpg"), cv2.resize(coarse, (64, 64)))


@pytest.fixture(scope="session")
def test_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As many test meshes and texture sets as the evaluation has in polcap's pages."""
    folder = tmp_path_factory.mktemp("test-data")
    for k in range(6):
        write_blob(folder / "meshes" / "test" / f"shape-{k}.npz", k)
    for k in range(evaluation_materials.TEXTURES):
        write_textures(folder / "materials" / "test" / f"set-{k}", k)
    return folder


@pytest.fixture(scope="session")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write_mesh(folder / "meshes" / "train" / "one.npz", 1)
    write_mesh(folder / "meshes" / "test" / "two.npz", 2)
    return folder


@pytest.fixture(scope="session")
def views(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("views")
    traced_views.open_cache(folder, [data / "meshes" / "train" / "one.npz"], RECIPE)
    return folder


@pytest.fixture(scope="session")
def simulator(data: Path, views: Path) -> Simulator:
    device = torch.device("cpu")
    cache = traced_views.open_cache(views, [data / "meshes" / "train" / "one.npz"], RECIPE)
    return Simulator(cache, materials.MaterialLibrary(None, device), device)
