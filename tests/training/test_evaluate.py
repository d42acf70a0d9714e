"""Scores: zero for the truth, known values for known errors, and the shipped model held to its card."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from polcap.training import evaluate
from polcap.training.camera import Errors
from polcap.training.dataset import Light, Simulator

MODEL = Path(__file__).parents[2] / "calib" / "models" / "polcap.onnx"


@pytest.fixture(scope="module")
def case(simulator: Simulator) -> evaluate.Case:
    torch.manual_seed(0)
    view = simulator.look(np.array([2]), 64, flip=False)
    device = torch.device("cpu")
    photo = simulator.shoot(view, Light.stated(1, device), Errors.stated(1, device))
    return evaluate.case(photo, evaluate._view(simulator, 2))


def test_truth_scores_zero_and_all_within(case: evaluate.Case) -> None:
    score = evaluate.score(case.truth, case)
    for name in ("diffuse", "specular", "roughness", "depth", "rendering", "normal_mean"):
        assert score[name] == pytest.approx(0, abs=0.1 if name == "normal_mean" else 1e-5), name  # arccos near 1
    assert score["normal_within_11.25"] == 1


def test_known_errors_score_what_they_are(case: evaluate.Case) -> None:
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    wrong = replace(
        case.truth,
        normal=case.truth.normal @ turn.T,
        roughness=case.truth.roughness + 0.1,
        depth_prior=2 * case.depth + 5,
    )
    score = evaluate.score(wrong, case)
    zenith = np.sqrt(np.maximum(1 - case.truth.normal[case.truth.mask][:, 2] ** 2, 0))
    expected = np.degrees(2 * np.arcsin(zenith * np.sin(np.radians(7.5)))).mean()
    assert score["normal_mean"] == pytest.approx(expected, rel=1e-3)
    assert score["roughness"] == pytest.approx(0.1, rel=1e-4)
    inside = case.depth[case.truth.mask]
    assert score["depth"] == pytest.approx(inside.std() / np.ptp(inside), rel=1e-4)
    assert score["rendering"] > 0


def test_deciles_pair_predicted_with_actual() -> None:
    predicted = np.linspace(1, 20, 1000)
    rows = evaluate.deciles([(predicted, 2 * predicted)])
    assert len(rows) == 10 and all(r["actual"] == pytest.approx(2 * r["predicted"]) for r in rows)


@pytest.mark.skipif(not os.environ.get("POLCAP_DATA"), reason="POLCAP_DATA is not set")
@pytest.mark.skipif(not MODEL.exists(), reason="no model is shipped")
def test_shipped_model_holds_what_its_card_says(tmp_path: Path) -> None:
    data = Path(os.environ["POLCAP_DATA"])
    table = evaluate.main(evaluate.Params(MODEL, data=data, out=tmp_path, count=12, size=160))
    ours = table["network"]
    assert ours["normal_mean"] < 14 and ours["normal_mean"] < table["analytic"]["normal_mean"] + 1.5  # 10.6 on 36
    assert ours["diffuse"] < table["analytic"]["diffuse"]
    for baseline in ("frontal, mean maps", "silhouette, mean maps"):
        for row in ("normal_mean", "diffuse", "depth", "rendering"):
            assert ours[row] < table[baseline][row], (baseline, row)
    assert (tmp_path / "evaluation.md").read_text().count("|") > 50
