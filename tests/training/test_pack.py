"""A pack trains in pieces on what it holds; its checkpoint comes in parts and goes together again."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from polcap.errors import InputError
from polcap.training import pack, train
from tests.training.conftest import write_blob, write_textures
from tests.training.test_train import PRESET

pytestmark = pytest.mark.filterwarnings(
    "ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning", "ignore::UserWarning"
)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    folder = tmp_path / "source"
    write_blob(folder / "meshes" / "train" / "one.npz", 0)
    write_blob(folder / "meshes" / "test" / "two.npz", 1)
    write_textures(folder / "materials" / "train" / "set", 2)
    wide: np.ndarray = np.full((1024, 2048, 3), 90, np.uint8)
    cv2.imwrite(str(folder / "materials" / "train" / "set" / "albedo.jpg"), wide)
    return folder


def test_a_pack_trains_in_pieces(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each piece makes one step here; between the first two only the parts of the checkpoint are kept."""
    small = replace(PRESET, sizes=(64,), early=(1.0,), late=(1.0,), pixels=2 * 64**2)
    monkeypatch.setitem(train.PRESETS, "cpu", small)
    plan = pack.Plan("cpu", piece=0.0, views=2, procedural=0, samples=4)
    size = pack.make(source, tmp_path / "pack", plan)
    assert size < pack.LARGEST
    texture = cv2.imread(str(tmp_path / "pack" / "data" / "materials" / "train" / "set" / "albedo.jpg"))
    assert texture.shape == (256, 512, 3)
    out = tmp_path / "out"
    says = [pack.go_on(tmp_path / "pack", out)]
    assert says[0].startswith("a piece is done") and not (out / "model.onnx").exists()
    step = train.load_average(out / "last.pt")[1]["step"]
    (out / "last.pt").unlink()
    says.append(pack.go_on(tmp_path / "pack", out))
    assert says[1].startswith("done") and (out / "model.onnx").exists()
    assert (step, train.load_average(out / "last.pt")[1]["step"]) == (1, 2)


def test_run_py_finds_the_pack_s_own_source(source: Path, tmp_path: Path) -> None:
    pack.make(source, tmp_path / "pack", pack.Plan(preset="none"))
    command = [sys.executable, str(tmp_path / "pack" / "run.py"), str(tmp_path / "out")]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env={"PYTHONPATH": ""})
    assert "preset 'none' is not one of cpu, gpu" in ended.stderr
    assert str(tmp_path / "pack" / "polcap" / "training" / "train.py") in ended.stderr


def test_parts_are_small_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    whole = np.random.default_rng(0).bytes(100_000)
    (tmp_path / "last.pt").write_bytes(whole)
    assert pack.split(tmp_path / "last.pt", tmp_path / "parts", size=30_000) == 4
    pack.join(tmp_path / "parts", tmp_path / "again.pt")
    assert (tmp_path / "again.pt").read_bytes() == whole
    (tmp_path / "parts" / "002").write_bytes(b"")
    with pytest.raises(InputError, match="002 is missing or damaged"):
        pack.join(tmp_path / "parts", tmp_path / "third.pt")


def test_a_pack_that_is_too_large_is_not_left(source: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pack, "LARGEST", 1000)
    with pytest.raises(InputError, match="give fewer wheels"):
        pack.make(source, tmp_path / "pack", pack.Plan())
    assert not (tmp_path / "pack").exists()
