"""The cache of traced views is complete, reproducible, and follows its conventions."""

from collections import namedtuple
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap.errors import InputError, StorageError
from polcap.optics.mesh_tracer import Tracer, Triangles
from polcap.training import traced_views
from tests.training.conftest import RECIPE


@pytest.fixture(scope="module")
def meshes(data: Path) -> list[Path]:
    return [data / "meshes" / "train" / "one.npz"]


@pytest.fixture(scope="module")
def cache(views: Path, meshes: list[Path]) -> dict[str, Any]:
    return traced_views.open_cache(views, meshes, RECIPE)


def test_an_interrupted_cache_is_traced_again_and_the_same_seed_gives_the_same_views(
    meshes: list[Path], cache: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "camera.npy").write_bytes(b"half a file")
    again = traced_views.open_cache(tmp_path, meshes, RECIPE)
    for name in cache:
        np.testing.assert_array_equal(cache[name], again[name])


def test_interrupted_tracing_continues_after_its_last_mesh(
    meshes: list[Path], cache: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(traced_views, "_SAVE_S", 0.0)
    lines: list[str] = []

    def stop_after_first(text: str) -> None:
        lines.append(text)
        if text.startswith("9 of"):
            raise KeyboardInterrupt

    monkeypatch.setattr(traced_views, "_REPORT_S", 0.0)
    with pytest.raises(KeyboardInterrupt):
        traced_views.open_cache(tmp_path, meshes, RECIPE, stop_after_first)
    assert lines[0].startswith("tracing 18 views of 1 meshes, 2 random shapes and 2 flat ones") and "GB in" in lines[0]
    assert lines[1].startswith("1 of 18 views") and lines[1].endswith("min left")
    lines.clear()
    again = traced_views.open_cache(tmp_path, meshes, RECIPE, lines.append)
    assert lines[0].endswith("; 6 of them are there") and lines[1].startswith("7 of 18")
    for name in cache:
        np.testing.assert_array_equal(cache[name], again[name])


def test_a_cache_larger_than_the_disk_is_refused_before_tracing(
    meshes: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage(10**9, 10**9 - 1000, 1000))
    with pytest.raises(StorageError, match=r"18 traced views need .* GB are free; take fewer with --views"):
        traced_views.open_cache(tmp_path / "views", meshes, RECIPE)


def test_the_stated_size_is_that_of_the_files(views: Path, cache: dict[str, Any]) -> None:
    stored = sum(file.stat().st_size for file in views.glob("*.npy"))
    assert traced_views.cache_bytes(len(cache["camera"]), RECIPE.size) == pytest.approx(stored, rel=0.01)


def test_depth_is_centered_and_in_units_of_the_equivalent_disc(cache: dict[str, Any]) -> None:
    for index, camera in enumerate(cache["camera"]):
        mask = cache["mask"][index, ..., 0]
        assert abs(cache["depth"][index, ..., 0][mask].astype(float).mean()) < 2e-3  # fp16
        assert camera[4] == pytest.approx(np.sqrt(mask.sum() / np.pi) * camera[3] / camera[0], rel=1e-5)


def test_objects_are_inside_the_picture_and_turns_are_rotations(cache: dict[str, Any]) -> None:
    border = np.ones((64, 64), bool)
    border[1:-1, 1:-1] = False
    assert (cache["mask"][..., 0] & border).mean() < 0.002
    assert cache["mask"].mean(axis=(1, 2, 3)).min() > 0.05
    turn = cache["camera"][:, 5:14].reshape(-1, 3, 3)
    np.testing.assert_allclose(turn @ turn.transpose(0, 2, 1), np.broadcast_to(np.eye(3), turn.shape), atol=1e-5)


def test_a_cache_of_other_views_is_refused(data: Path, meshes: list[Path], views: Path) -> None:
    for asked in ((meshes, replace(RECIPE, seed=6)), ([data / "meshes" / "test" / "two.npz"], RECIPE)):
        with pytest.raises(InputError, match="views of other meshes or of another preset"):
            traced_views.open_cache(views, *asked)


def test_a_mesh_too_thin_for_any_view_is_refused() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 0.01, 0]], np.float32)
    needle = Triangles(corners, np.array([[0, 1, 2]], np.int32), np.tile(np.array([0, 0, 1], np.float32), (1, 3, 1)))
    with pytest.raises(InputError, match="the needle covers less than 6% of the picture"):
        traced_views.trace_random_view("the needle", Tracer(needle), 32, np.random.default_rng(0))


def test_withheld_meshes_are_not_trained_on(tmp_path: Path) -> None:
    for name in ("some", "statue_maria"):
        (tmp_path / "meshes" / "train").mkdir(parents=True, exist_ok=True)
        (tmp_path / "meshes" / "train" / f"{name}.npz").touch()
    assert [mesh.stem for mesh in traced_views.training_meshes(tmp_path)] == ["some"]
    assert len(traced_views.WITHHELD) == 20
