"""The evaluation from end to end: all columns, resumed runs, the command, and errors of the shipped model."""

import json
import os
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

from polcap.cli import app
from polcap.errors import InputError, StorageError
from polcap.training import evaluate, evaluation_page, train
from tests.training.test_main_network import TINY

MODEL = Path(__file__).parents[2] / "calib" / "models" / "polcap.onnx"
shipped = pytest.mark.skipif(not MODEL.exists(), reason="no model is shipped")


@pytest.fixture(scope="module")
def networks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("networks")
    for name in ("ours", "rgb"):
        (folder / name).mkdir()
        train.NetworkTraining(TINY, torch.device("cpu"), 1e-3).save(folder / name / "last.pt")
    return folder


@shipped
def test_the_command_evaluates_all_columns(test_data: Path, networks: Path, tmp_path: Path) -> None:
    options = ["--count", "2", "--size", "96", "--ablations", str(networks), "--out", str(tmp_path)]
    done = CliRunner().invoke(app, ["evaluate", str(MODEL), str(test_data), *options])
    assert done.exit_code == 0, done.output
    result = json.loads((tmp_path / "evaluation.json").read_text())
    names = ["ours", "ours, noise-free", "analytic", "frontal", "silhouette", "mean of each map"]
    assert list(result["table"]) == names
    assert list(result["ablations"]) == ["ours", "rgb"]
    for figures in (*result["table"].values(), *result["ablations"].values()):
        assert {"normal_mean", "diffuse", "roughness", "specular", "rendering"} <= figures.keys()
    assert result["of_mean_maps"].keys() == {"diffuse", "specular", "roughness"} and len(result["calibration"]) == 10
    page = (tmp_path / "evaluation.md").read_text()
    assert "| 12.00 | 42.23 | 47.69 |" in page and "as published" in page and "| 24.14 |" in page
    assert (tmp_path / "panel.png").stat().st_size > 10_000
    assert "2/2" in done.stderr and "min left" in done.stderr


@shipped
def test_a_stopped_run_continues(test_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Several processes give the same result as one."""
    params = evaluate.EvaluationOptions(MODEL, test_data, tmp_path, count=2, size=64)
    whole = evaluate.main(params)
    journal = tmp_path / "pictures.jsonl"
    head, first, second = journal.read_text().splitlines()
    changed = json.loads(first)
    changed["scores"]["ours"]["normal_mean"] += 10
    journal.write_text("\n".join([head, json.dumps(changed), second[:50]]))
    assert evaluate.main(params)["ours"]["normal_mean"] == pytest.approx(whole["ours"]["normal_mean"] + 5)
    journal.write_text("\n".join(["another run", json.dumps(changed)]))
    monkeypatch.setattr(evaluate, "_MIN_SHARE", 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert evaluate.main(params) == whole


def test_published_figures_have_rows() -> None:
    for table in (evaluation_page.PUBLISHED, evaluation_page.PUBLISHED_ABLATIONS):
        assert all(figures.keys() <= evaluation_page.ROWS.keys() for figures in table.values())


@shipped
@pytest.mark.parametrize("name", ["evaluation.md", "pictures.jsonl"])
def test_a_file_of_others_in_the_place_of_a_result_stays(test_data: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(StorageError, match=f"holds {name}.*choose another --out"):
        evaluate.main(evaluate.EvaluationOptions(MODEL, test_data, tmp_path, count=1, size=64))
    assert (tmp_path / name).read_bytes() == b"mine"


@shipped
def test_a_folder_without_networks_is_refused(test_data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no NAME/last\.pt"):
        evaluate.main(evaluate.EvaluationOptions(MODEL, test_data, tmp_path, ablations=tmp_path, count=1, size=64))


@shipped
@pytest.mark.skipif(not os.environ.get("POLCAP_DATA"), reason="POLCAP_DATA is not set")
def test_shipped_model_beats_the_baselines_without_a_network(tmp_path: Path) -> None:
    data = Path(os.environ["POLCAP_DATA"])
    table = evaluate.main(evaluate.EvaluationOptions(MODEL, data, tmp_path, count=6, size=128))
    ours = table["ours"]
    assert ours["normal_mean"] < table["analytic"]["normal_mean"] + 1.5
    for baseline in ("frontal", "silhouette", "mean of each map"):
        for row in ("normal_mean", "diffuse", "depth", "rendering"):
            assert ours[row] < table[baseline][row], (baseline, row)
