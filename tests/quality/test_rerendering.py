"""Maps that do not explain the photographs are found, whatever error their model states."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from polcap.config import Config
from polcap.formats import onnx
from polcap.image_values import Floats, Quality
from polcap.pipeline import models
from polcap.quality import object_turn, polarization, rerendering
from polcap.quality.gate_values import Gate
from polcap.stage_values import Network
from polcap.stages import infer
from tests import golden
from tests.quality.test_gates import Seen, changed, found, judged


@pytest.fixture(scope="module")
def good() -> Seen:
    return found()


def of_normals(good: Seen, normal: Floats) -> Seen:
    normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    return changed(good, maps=replace(good.results.maps, normal=normal.astype(np.float32)))


def judge(of: Seen) -> Gate:
    return polarization.explained_by_maps(of, Config().gates)


def test_the_true_maps_of_a_ball_pass(good: Seen) -> None:
    gate = judge(good)
    assert gate.state == "pass" and isinstance(gate.value, float) and gate.value > 0.7 and gate.cost_deg == 0


def test_all_gates_share_one_rerendering(good: Seen, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerendering, "measure", measure := Mock(wraps=rerendering.measure))
    judged(replace(good))
    measure.assert_called_once()


@pytest.mark.parametrize(
    "wrong",
    [
        lambda n: np.stack([n[..., 0] - n[..., 1], n[..., 0] + n[..., 1], 1.414 * n[..., 2]], -1),  # turned by 45°
        lambda n: n[..., [1, 2, 0]],  # exchanged
        lambda n: n * [0.2, 0.2, 1],  # flat
    ],
)
def test_wrong_normals_fail_and_cost_degrees(good: Seen, wrong: Callable[[Floats], Floats]) -> None:
    of = of_normals(good, wrong(good.results.maps.normal))
    assert judge(of).state == "fail" and "--model" in judge(of).remedy
    gate = judged(of)["normal error"]
    assert gate.state == "fail" and "re-rendering" in gate.message


def test_maps_with_large_expected_errors_need_not_explain_the_photographs(good: Seen) -> None:
    maps = of_normals(good, good.results.maps.normal * [0.2, 0.2, 1]).results.maps
    unsure = replace(maps, confidence=np.full_like(maps.confidence, 16.0))
    assert judge(changed(good, maps=unsure)).state == "not measured"


def test_clipped_light_is_left_out(good: Seen) -> None:
    quality = np.full_like(good.results.cues.quality, Quality.CLIPPED)
    assert judge(changed(good, cues=replace(good.results.cues, quality=quality))).state == "not measured"


def test_maps_that_do_not_explain_the_photographs_do_not_measure_motion(
    good: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []
    measure = object_turn.measure

    def noted(*values: Any) -> object_turn.ObjectTurn:
        given.append(values[3])
        return measure(*values)

    monkeypatch.setattr(object_turn, "measure", noted)
    for of in (good, of_normals(good, good.results.maps.normal * [0.2, 0.2, 1])):
        judged(of)
    assert given == [good.results.maps, None]


def exchanged(network: Network, channels: Floats) -> dict[str, Floats]:
    """The shipped network with its normals' axes exchanged."""
    predicted = dict(onnx.run(network, channels))
    if "sigma" in predicted:  # not the network of the relief
        predicted["normal"] = predicted["normal"][:, [1, 2, 0]]
    return predicted


def test_a_wrong_network_is_found_though_it_expects_small_errors() -> None:
    seen = golden.stored_cues(golden.read(golden.INPUTS))
    network = models.load_network("network", None, "cpu", 1)
    angle = np.radians([0.0, 45, 90])
    estimate = partial(infer.estimate, seen, network, settings=infer.InferSettings(symmetries=1))
    right, wrong = (
        (maps, rerendering.rerender(rerendering.reduce(maps, seen, angle, 256), 1.5))
        for maps in (estimate(onnx.run), estimate(exchanged))
    )
    assert np.median(wrong[0].confidence[seen.mask]) < 15
    limits = Config().gates
    assert rerendering.explains(right[1], limits) and not rerendering.explains(wrong[1], limits)
