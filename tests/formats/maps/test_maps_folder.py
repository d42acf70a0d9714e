"""The folder maps/ holds every promised file and describes each."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from polcap.chart_values import ColorCalibration
from polcap.errors import DecodeError, StorageError
from polcap.formats.maps import exr, png, result_maps
from polcap.formats.maps import maps_folder as maps
from polcap.mesh_values import ReliefMesh
from polcap.stage_values import Cues, StokesImage, SurfaceMaps
from polcap.stages import cues, surface
from tests import surfaces

FILES = {
    "normal.exr", "normal.png", "depth.exr", "depth.png", "diffuse.exr", "diffuse.png", "specular.exr",
    "specular.png", "roughness.exr", "roughness.png", "mask.png", "confidence.exr", "diffuse_error.exr",
    "roughness_error.exr", "stokes.exr", "stokes_covariance.exr", "cues.exr", "photograph.png", "maps.json",
}  # fmt: skip

Result = tuple[SurfaceMaps, ReliefMesh, StokesImage, Cues]


def write(folder: Path, of: SurfaceMaps, mesh: ReliefMesh, stokes: StokesImage, cue: Cues) -> None:
    results: Any = SimpleNamespace(maps=of, mesh=mesh, stokes=stokes, cues=cue, keys={})
    maps.write(folder, results)


@pytest.fixture(scope="module")
def result() -> Result:
    of = surfaces.maps(roughness=0.4, specular=0.05)
    of = replace(of, diffuse_error=0.1 * of.roughness, roughness_error=0.2 * of.roughness)
    rng = np.random.default_rng(4)
    stokes = rng.normal(0, 0.1, (3, *of.mask.shape, 3)).astype(np.float32)
    stokes[0] = np.abs(stokes[0]) + 0.5
    covariance, quality = np.full((6, *of.mask.shape, 3), 1e-6, np.float32), np.zeros(of.mask.shape, np.uint8)
    image = StokesImage(stokes, covariance, quality, mask=of.mask, view=of.view, residual=None)
    return of, surfaces.mesh(of), image, cues.compute(image, ColorCalibration(np.eye(3), "none"))


@pytest.fixture(scope="module")
def folder(result: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("result") / "maps"
    write(folder, *result)
    return folder


def described(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "maps.json").read_text("utf-8")))


@pytest.mark.parametrize("threads", ["1", "3"])
def test_a_file_that_cannot_be_written_leaves_all_as_they_were(
    result: Result, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: str
) -> None:
    """The error is raised, and no file of the new result exists."""
    monkeypatch.setenv("OMP_NUM_THREADS", threads)
    write(tmp_path / "maps", *result)
    before = {file.name: file.stat().st_mtime_ns for file in (tmp_path / "maps").iterdir()}
    assert all((tmp_path / "maps" / name).read_bytes() == (folder / name).read_bytes() for name in FILES)
    keep = exr.write

    def refuse(path: Path, *values: Any, **more: Any) -> None:
        if path.name == "cues.exr":
            raise StorageError(f"cannot write {path}: the disk is full")
        keep(path, *values, **more)

    monkeypatch.setattr(exr, "write", refuse)
    with pytest.raises(StorageError, match=r"cues\.exr: the disk is full"):
        write(tmp_path / "maps", *result)
    assert {file.name: file.stat().st_mtime_ns for file in (tmp_path / "maps").iterdir()} == before


def test_detail_of_raw_pixels_comes_back_and_maps_json_states_its_size(result: Result, tmp_path: Path) -> None:
    of, mesh, image, seen = result
    size = (2 * surfaces.HEIGHT, 2 * surfaces.WIDTH)
    detailed = replace(of, detail=np.random.default_rng(2).normal(0, 0.5, size).astype(np.float16))
    write(tmp_path / "maps", detailed, mesh, image, seen)
    stated = described(tmp_path / "maps")
    assert stated["sizes"] == {"detail.png": [size[1], size[0]]} and "detail.png" in stated["maps"]
    read = maps.read(tmp_path / "maps").detail
    assert detailed.detail is not None and read is not None
    assert np.abs(read.astype(float) - detailed.detail).max() < 0.011  # half a level of 1/50, and the half floats
    png.write(tmp_path / "maps" / "detail.png", np.zeros((4, 4), np.uint8))
    with pytest.raises(DecodeError, match=r"detail\.png is not 320 × 240"):
        maps.read(tmp_path / "maps")


def test_every_promised_file_is_there_and_described(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == FILES
    assert set(described(folder)["maps"]) == FILES - {"maps.json"}


def test_crop_is_in_visible_raw_pixels_and_depth_in_a_stated_unit(folder: Path, result: Result, tmp_path: Path) -> None:
    stated = described(folder)
    assert stated["crop"] == [600, 400, 600 + 2 * surfaces.WIDTH, 400 + 2 * surfaces.HEIGHT]
    assert stated["size"] == [surfaces.WIDTH, surfaces.HEIGHT] and stated["scale"] == 2
    assert stated["camera"]["focal_px"] == 400 and stated["depth"]["unit"] == "m"
    write(tmp_path, result[0], replace(result[1], metric=False), *result[2:])
    assert described(tmp_path)["depth"]["unit"] == "relative"


def test_pictures_hold_the_values_that_maps_json_describes(folder: Path, result: Result) -> None:
    of, mesh, *_ = result
    inside = of.mask
    normal = png.read(folder / "normal.png")
    assert normal.dtype == np.uint16
    assert np.allclose(normal[inside] / 65535 * 2 - 1, of.normal[inside], atol=2e-5)
    near, far = (described(folder)["depth"][end] for end in ("near", "far"))
    depth = png.read(folder / "depth.png")[inside] / 65535 * (far - near) + near
    assert np.allclose(depth, mesh.depth[inside], atol=(far - near) * 1e-5)
    assert np.allclose(png.read(folder / "roughness.png")[inside] / 65535, 0.4, atol=1e-5)
    assert png.read(folder / "diffuse.png")[inside].max(axis=0).tolist() == [203, 188, 89]  # sRGB of .6 .5 .1
    assert np.array_equal(png.read(folder / "mask.png") == 255, inside)


def test_normals_point_right_up_and_towards_the_camera(folder: Path) -> None:
    """The ball's right edge is red, its top green, its middle blue: +Y, as OpenGL and glTF."""
    normal, inside = png.read(folder / "normal.png"), png.read(folder / "mask.png") > 0
    rows, columns = np.nonzero(inside)
    middle = int(np.median(rows)), int(np.median(columns))
    right, top = normal[middle[0], columns.max()], normal[rows.min(), middle[1]]
    assert right[0] > 60000 and top[1] > 60000 and normal[middle][2] > 64000


def test_stokes_and_cues_are_readable_by_name(folder: Path, result: Result) -> None:
    _, _, stokes, of = result
    read = exr.read(folder / "stokes.exr")
    assert sorted(read) == sorted(f"S{s}.{c}" for s in range(3) for c in "RGB")
    assert np.allclose(read["S2.B"], stokes.stokes[2, ..., 2], atol=3e-4)  # half
    read = exr.read(folder / "cues.exr")
    assert np.allclose(read["dolp"], of.dolp, atol=1e-3)
    double = np.radians(2 * read["aolp"])
    assert np.allclose(np.cos(double), of.normalized_stokes[0], atol=5e-3)
    assert np.allclose(np.sin(double), of.normalized_stokes[1], atol=5e-3)
    assert read["aolp"].min() >= 0 and read["aolp"].max() <= 180


def test_the_covariance_of_the_stokes_parameters_comes_back(folder: Path, result: Result, tmp_path: Path) -> None:
    of, mesh, image, cue = result
    root = np.random.default_rng(8).normal(0, 0.02, (3, 3, *of.mask.shape, 3))
    true = np.einsum("ikhwc,jkhwc->ijhwc", root, root)
    packed = np.stack([true[i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]).astype(np.float32)
    write(tmp_path / "maps", of, mesh, replace(image, covariance=packed), cue)
    found = result_maps.read_stokes_covariance(tmp_path)
    scale = np.sqrt(np.einsum("iihwc->ihwc", true))
    assert (np.abs(found - true) <= 0.06 * scale[:, None] * scale[None]).all()
    assert np.array_equal(found, np.swapaxes(found, 0, 1))


def test_stored_maps_come_back_with_expected_errors_or_without(folder: Path, result: Result, tmp_path: Path) -> None:
    of, mesh, *_ = result
    stored = maps.read(folder)
    assert stored.metric and stored.view == of.view and stored.estimator == "truth"
    assert np.array_equal(stored.mask, of.mask)
    assert np.array_equal(stored.normal[of.mask], of.normal[of.mask])
    assert np.array_equal(stored.depth, mesh.depth, equal_nan=True)
    assert np.allclose(stored.diffuse[of.mask], of.diffuse[of.mask], rtol=1e-3)
    assert stored.diffuse_error is not None and stored.roughness_error is not None
    assert np.allclose(stored.diffuse_error[of.mask], 0.04, rtol=1e-3)
    assert np.allclose(stored.roughness_error[of.mask], 0.08, rtol=1e-3)
    write(tmp_path / "maps", replace(of, diffuse_error=None, roughness_error=None), *result[1:])
    without = maps.read(tmp_path / "maps")
    assert without.diffuse_error is None and without.roughness_error is None


def test_values_outside_the_range_of_half_floats_are_rounded_or_clipped(folder: Path, result: Result) -> None:
    of, mesh, *_ = result
    values = np.exp(np.random.default_rng(5).normal(-8, 6, of.diffuse.shape)).astype(np.float32)
    write(folder.parent / "other", replace(of, diffuse=values), mesh, *result[2:])
    half = np.clip(values, 0, np.finfo(np.float16).max).astype(np.float16)
    assert np.array_equal(maps.read(folder.parent / "other").diffuse, half * of.mask[..., None])


def test_the_mesh_of_the_stored_maps_is_that_of_the_stage(folder: Path, result: Result) -> None:
    of, settings = result[0], surface.SurfaceSettings()
    mesh = surface.integrate(of, 0.7, settings)
    write(folder.parent / "integrated", of, mesh, *result[2:])
    read = maps.read(folder.parent / "integrated")
    again = surface.triangulate(read.depth, read, read.metric, settings)
    for name, value in vars(mesh).items():
        assert np.array_equal(value, getattr(again, name), equal_nan=isinstance(value, np.ndarray)), name


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("maps.json", None, "cannot be read"),
        ("maps.json", b"{}", "process again"),
        ("mask.png", None, r"mask\.png is missing; make the result again"),
        ("mask.png", png.encode(np.zeros((3, 3), np.uint8)), r"mask\.png is not 160 × 120"),
        ("normal.exr", None, r"normal\.exr is missing; make the result again"),
    ],
)
def test_a_missing_or_damaged_file_is_one_line(
    folder: Path, tmp_path: Path, name: str, content: bytes | None, words: str
) -> None:
    shutil.copytree(folder, tmp_path / "maps")
    (tmp_path / "maps" / name).unlink()
    if content is not None:
        (tmp_path / "maps" / name).write_bytes(content)
    with pytest.raises(DecodeError, match=words):
        maps.read(tmp_path / "maps")


@pytest.mark.parametrize("name", ["capture/polcap/maps", "capture/polcap", "capture"])
def test_python_reads_the_maps_of_a_result_by_any_of_its_folders(
    result: Result, folder: Path, tmp_path: Path, name: str
) -> None:
    shutil.copytree(folder, tmp_path / "capture/polcap/maps")
    of, mesh, stokes, cues_ = result
    found = result_maps.read(tmp_path / name)
    stored = maps.read(folder)
    np.testing.assert_array_equal(found.normal, stored.normal)
    np.testing.assert_array_equal(found.depth, stored.depth)
    assert found.metric is mesh.metric and repr(found) == repr(stored)
    assert len(repr(found)) < 700 and f"float32 {of.normal.shape}" in repr(found)
    inside = of.mask
    s = result_maps.read_stokes(tmp_path / name)
    np.testing.assert_allclose(s[:, inside], stokes.stokes[:, inside], rtol=1e-3, atol=1e-4)
    read = result_maps.read_cues(str(tmp_path / name))
    np.testing.assert_allclose(read["dolp"][inside], cues_.dolp[inside], rtol=1e-3, atol=1e-4)
    pointing = np.stack([np.cos(2 * read["aolp"][inside]), np.sin(2 * read["aolp"][inside])])
    np.testing.assert_allclose(pointing, cues_.normalized_stokes[:, inside], atol=0.01)
    assert {name: value.shape for name, value in read.items()}["diffuse_color"] == of.normal.shape


def test_a_folder_without_maps_is_one_clear_line(tmp_path: Path) -> None:
    for read in (result_maps.read, result_maps.read_stokes, result_maps.read_stokes_covariance, result_maps.read_cues):
        with pytest.raises(DecodeError, match="give a result's folder"):
            read(tmp_path)
