"""The ablation study trains and evaluates all variants by one command, and continues after a stop."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from polcap.errors import InputError
from polcap.training import ablation_study, train, validation
from polcap.training.variants import VARIANTS
from tests.training.conftest import EXPORT_WARNINGS, write_blob
from tests.training.test_main_network import TINY

pytestmark = EXPORT_WARNINGS


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    preset = train.TrainingPreset(TINY, 2, 1, 0, 64, (32,), (1.0,), (1.0,), 4 * 32**2)
    monkeypatch.setitem(train.PRESETS, "cpu", preset)
    monkeypatch.setattr(validation, "_RECIPE", replace(validation._RECIPE, views=2))
    monkeypatch.setattr(validation, "_COUNT", 8)
    two = {name: VARIANTS[name] for name in ("ours", "plain skips")}
    monkeypatch.setattr(ablation_study, "VARIANTS", two)


@pytest.mark.usefixtures("tiny")
def test_one_command_makes_the_table_and_continues(test_data: Path, tmp_path: Path) -> None:
    for name in ("meshes", "materials"):
        (tmp_path / "data" / name).mkdir(parents=True)
        (tmp_path / "data" / name / "test").symlink_to(test_data / name / "test")
    write_blob(tmp_path / "data" / "meshes" / "train" / "one.npz", 1)
    options = train.TrainingOptions(data=tmp_path / "data", out=tmp_path / "out", samples=8, threads=1)
    lines: list[str] = []
    page = ablation_study.main(options, lines.append, count=1, size=64)
    assert lines[0].startswith("2 networks of 8 pictures each")
    assert sum("tracing" in line for line in lines[1:]) == 2  # views and held-out pictures, once for all
    table = json.loads((tmp_path / "out" / "evaluation.json").read_text())["ablations"]
    assert set(table) == {"ours", "plain skips"} and "paper (c), no polarization" in page.read_text()
    with pytest.raises(InputError, match="continue from it with --resume"):
        ablation_study.main(options, count=1, size=64)
    (tmp_path / "out" / "plain skips" / "last.pt").unlink()
    ablation_study.main(replace(options, resume=True), lines.append, count=1, size=64)
    assert (tmp_path / "out" / "plain skips" / "model.onnx").exists()


def test_a_chosen_variant_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="leave out --variant"):
        ablation_study.main(train.TrainingOptions(data=tmp_path, out=tmp_path, variant="plain skips"))
