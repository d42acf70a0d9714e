"""Scores: zero for the truth, known values for known errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from polcap.image_values import Quality
from polcap.training import map_errors
from polcap.training.evaluation_protocol import Case, Protocol
from polcap.training.map_errors import Judge


@pytest.fixture(scope="module")
def case(test_data: Path) -> Case:
    return Protocol(test_data, 64).case(2)


def test_truth_scores_zero_and_all_within(case: Case) -> None:
    figures = Judge(case).score(case.truth)
    for name in ("diffuse", "specular", "roughness", "depth", "depth_fitted", "rendering", "normal_mean"):
        assert figures[name] == pytest.approx(0, abs=1e-5), name
    assert figures["normal_within_11.25"] == figures["normal_within_30_core"] == 1


def test_known_errors_are_measured(case: Case) -> None:
    c, s = np.cos(np.radians(15)), np.sin(np.radians(15))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    truth, depth = case.truth, 2 * case.depth + 5
    wrong = replace(truth, normal=truth.normal @ turn.T, roughness=truth.roughness + 0.1, depth_prior=depth)
    figures = Judge(case).score(wrong)
    zenith = np.sqrt(np.maximum(1 - case.truth.normal[case.truth.mask][:, 2] ** 2, 0))
    expected = np.degrees(2 * np.arcsin(zenith * np.sin(np.radians(7.5)))).mean()
    assert figures["normal_mean"] == pytest.approx(expected, rel=1e-3)
    assert figures["roughness"] == pytest.approx(0.1, rel=1e-4)
    share = case.truth.mask.mean()  # outside the object the error is 0
    assert figures["roughness_picture"] == pytest.approx(0.1 * np.sqrt(share), rel=1e-4)
    assert figures["roughness_l1_picture"] == pytest.approx(0.1 * share, rel=1e-4)
    inside = case.depth[case.truth.mask]
    assert figures["depth"] == pytest.approx(inside.std() / np.ptp(inside), rel=1e-4)
    assert figures["depth_fitted"] == pytest.approx(0, abs=1e-5)
    assert figures["rendering"] > 0


@pytest.mark.parametrize("size", [64, 32])  # of the grid: every pixel, every second
def test_true_normals_integrate_to_nearly_the_true_depth(
    case: Case, size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_errors, "_INTEGRATED", size)
    inside = case.depth[case.truth.mask]
    found = Judge(case).integrated(replace(case.truth, depth_prior=None))["depth_integrated"]
    assert found < 0.5 * inside.std() / np.ptp(inside)


def test_clipped_highlights_have_their_own_error(case: Case) -> None:
    quality = np.zeros_like(case.cues.quality)
    y, x = np.nonzero(case.truth.mask)
    quality[y[:20], x[:20]] = int(Quality.CLIPPED)
    diffuse = case.truth.diffuse.copy()
    diffuse[y[:20], x[:20]] += 0.3
    shiny = replace(case, cues=replace(case.cues, quality=quality))
    figures = Judge(shiny).score(replace(case.truth, diffuse=diffuse))
    assert figures["diffuse_clipped"] == pytest.approx(0.3, rel=1e-4)
    assert figures["diffuse"] == pytest.approx(0.3 * np.sqrt(20 / len(y)), rel=1e-4)
    none = replace(case, cues=replace(case.cues, quality=0 * quality))
    assert "diffuse_clipped" not in Judge(none).score(case.truth)


def test_rendering_error_ignores_clipped_light_only(case: Case) -> None:
    """Half the albedo of a matte picture halves its renderings, so the error is half of their level."""
    matte = replace(case.truth, specular=0 * case.truth.specular)
    judge = Judge(replace(case, truth=matte))
    figures = judge.score(replace(matte, diffuse=matte.diffuse / 2))
    assert figures["rendering"] == pytest.approx(float(np.sqrt(np.mean((judge.rendered / 2) ** 2))), rel=0.03)
