"""Data set files: values as dataset.json states them, samples that follow from the seed, continued runs."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("embreex")

from polcap.errors import InputError
from polcap.formats.maps import png
from polcap.training import dataset_files

SAMPLE, RECIPE = "000001", dataset_files.DatasetRecipe(seed=4, size=96, noise=0.0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corpus") / "set"
    assert dataset_files.main(folder, 2, RECIPE) == 2
    return folder


def numbers(folder: Path, name: str) -> np.ndarray:
    return png.read(folder / f"{name}.png") / 65535


def decode(code: np.ndarray) -> np.ndarray:
    """Radiance of values 0…1, by the formula in dataset.json."""
    return 0.01 * np.expm1(code * np.log(1 + 16.0 / 0.01))


def test_photographs_are_those_of_one_stokes_vector(made: Path) -> None:
    inside = png.read(made / SAMPLE / "mask.png") > 0
    i0, i45, i90, i135 = (decode(numbers(made / SAMPLE, f"I{a:03d}"))[inside] for a in (0, 45, 90, 135))
    # off axis the axes of 45° and 135° are no longer perpendicular
    np.testing.assert_allclose(i45 + i135, i0 + i90, rtol=0.01, atol=1e-4)
    axis = (i0 - i90).sum(-1) + 1j * (i45 - i135).sum(-1)
    stokes = numbers(made / SAMPLE, "stokes")[inside] * 2 - 1
    s0 = (i0 + i90).sum(-1)
    strong = np.abs(axis) > 0.03 * np.maximum(s0, 0.01)
    assert strong.sum() > 100
    np.testing.assert_allclose(stokes[:, 0], 0, atol=1e-4)
    assert np.abs((stokes[:, 1] + 1j * stokes[:, 2] - axis / np.abs(axis))[strong]).max() < 0.02
    normal = numbers(made / SAMPLE, "normal")[inside] * 2 - 1
    azimuth = np.angle(normal[:, 0] + 1j * normal[:, 1])
    off = np.abs(np.angle(axis * np.exp(-2j * azimuth)))[strong] / 2
    assert np.degrees(np.median(off)) < 6  # diffuse light is polarized along the normal; views are off axis


def test_hdr_encoding_keeps_a_thousandth_over_four_decades() -> None:
    radiance = np.geomspace(1e-3, 16, 500)
    stored = png.sixteen_bits(dataset_files.encode(radiance)) / 65535
    np.testing.assert_allclose(decode(stored), radiance, rtol=1e-3)


def test_a_stopped_run_continues_with_the_same_bytes(made: Path) -> None:
    before = {file.name: file.read_bytes() for file in (made / SAMPLE).iterdir()}
    assert len(before) == 13
    shutil.rmtree(made / SAMPLE)
    assert dataset_files.main(made, 2, RECIPE) == 1
    assert {file.name: file.read_bytes() for file in (made / SAMPLE).iterdir()} == before


def test_samples_of_two_settings_are_not_mixed(made: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="was started with the settings"):
        dataset_files.main(made, 2, dataset_files.DatasetRecipe(seed=5, size=96, noise=0.0))
    (tmp_path / "holiday.jpg").write_text("mine")
    with pytest.raises(InputError, match="is not empty"):
        dataset_files.main(tmp_path, 1, RECIPE)
    assert json.loads((made / "dataset.json").read_text())["recipe"]["seed"] == 4
