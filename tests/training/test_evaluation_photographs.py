"""Errors of normals from photographs of a ball; missing files are named."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from polcap.errors import InputError, StorageError
from polcap.formats import onnx
from polcap.formats.maps import png
from polcap.image_values import Floats
from polcap.optics import fresnel
from polcap.pipeline import models
from polcap.training import evaluation_photographs
from tests import fake_network
from tests.stages.infer.test_infer import network

SIZE, RADIUS = 160, 60


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs (16 bits) of a ball by a distant camera with the flash at the lens, mask and normals."""
    place = tmp_path_factory.mktemp("real")
    y, x = np.mgrid[:SIZE, :SIZE]
    nx, ny = (x - SIZE / 2) / RADIUS, (SIZE / 2 - y) / RADIUS
    mask = nx**2 + ny**2 < 0.97
    nz = np.sqrt(np.maximum(1 - nx**2 - ny**2, 1e-3))
    plus, minus = fresnel.transmission(nz, 1.5)
    s0, azimuth = 0.5 * nz * plus**2 * mask, np.arctan2(ny, nx)
    for degrees in (0, 45, 90, 135):
        passed: Floats = s0 / 2 * (1 + minus / plus * np.cos(2 * (np.radians(degrees) - azimuth)))
        _write(place / f"pol{degrees:03d}" / "ball.png", np.repeat(passed[..., None], 3, -1))
    _write(place / "mask" / "ball.png", mask.astype(float))
    _write(place / "normal" / "ball.png", (np.stack([nx, ny, nz], -1) / 2 + 0.5) * mask[..., None])
    return place


def _write(file: Path, picture: Floats) -> None:
    file.parent.mkdir(exist_ok=True)
    png.write(file, png.sixteen_bits(np.clip(picture, 0, 1)))


def test_normals_of_a_ball_are_evaluated(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(models, "open_network", lambda path: network())
    monkeypatch.setattr(onnx, "run", fake_network.run)
    lines: list[str] = []
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "real.md").write_text("mine")
    with pytest.raises(StorageError, match=r"holds real\.md"):
        evaluation_photographs.main(folder, Path("model.onnx"), tmp_path / "mine")
    table = evaluation_photographs.main(folder, Path("model.onnx"), tmp_path, lines.append)
    # the lens is not stated, 50 mm is assumed: so view rays at the ball's side are wrong by 13°
    assert table["analytic"]["mean"] < 9 and table["analytic"]["covered"] > 0.97
    assert table["analytic"]["diffuse direction"] > 0.95  # the light of this ball is diffuse
    assert table["ours"]["mean"] > 20  # this network takes the other half-turn on half of the ball
    assert [line.partition(":")[0] for line in lines] == ["1/1  ball.png"]
    page = (tmp_path / "real.md").read_text()
    assert "| ball.png, ours |" in page and "counts as 90°" in page


def test_a_folder_of_another_layout_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds 0 folders pol… and 0 normal maps"):
        evaluation_photographs.main(tmp_path, Path("model.onnx"), tmp_path)
    with pytest.raises(InputError, match="none: no such folder"):
        evaluation_photographs.main(tmp_path / "none", Path("model.onnx"), tmp_path)
    for part in ("pol000", "pol045", "pol090", "normal"):
        (tmp_path / part).symlink_to(folder / part)
    (tmp_path / "polcap").mkdir()  # a result: not the folder of an angle
    with pytest.raises(InputError, match=r"mask/ball\.png is missing"):
        evaluation_photographs.main(tmp_path, Path("model.onnx"), tmp_path)


def test_photographs_are_evaluated_without_torch() -> None:
    program = "import sys; sys.modules['torch'] = None; import polcap.training.evaluation_photographs"
    subprocess.run([sys.executable, "-c", program], check=True)
