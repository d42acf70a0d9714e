"""The public surface: what it names, what it costs, and that it does what the command line does."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polcap
from polcap.api import Result
from polcap.errors import SettingError
from polcap.formats.maps import result_maps as maps
from polcap.images import MaskedImage
from polcap.pipeline import models


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        ("polcap", ("numpy", "cv2", "msgspec", "onnxruntime")),
        (
            "polcap.pipeline.run, polcap.pipeline.check",
            ("OpenImageIO", "scipy", "onnxruntime", "trimesh", "rawpy", "jinja2"),
        ),
    ],
)
def test_an_import_loads_no_library_that_only_some_runs_need(modules: str, heavy: tuple[str, ...]) -> None:
    code = f"import sys, {modules}; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", polcap.__all__)
def test_every_public_name_exists_and_is_described(name: str) -> None:
    assert getattr(polcap, name).__doc__ and name in dir(polcap)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="nonsense"):
        _ = polcap.nonsense


def test_readers_are_those_of_the_house() -> None:
    assert polcap.read_maps is maps.read and polcap.read_cues is maps.read_cues


def test_python_takes_the_network_as_the_command_line_does(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def load(*arguments: object) -> None:
        asked.append(arguments)
        raise polcap.PolcapError("far enough")

    monkeypatch.setattr(models, "load_network", load)
    with pytest.raises(polcap.PolcapError, match="far enough"):
        polcap.process("nowhere")
    assert asked == [(None, None, "cpu", 0)]  # what `polcap process` without flags asks for


@pytest.mark.parametrize(("name", "value"), [("device", "gpu"), ("estimator", "nn")])
def test_an_unknown_device_or_estimator_is_refused(tmp_path: Path, name: str, value: str) -> None:
    option: dict[str, Any] = {name: value}
    with pytest.raises(SettingError, match=f"{name} '{value}': there is no such one"):
        polcap.process(tmp_path, **option)


@pytest.mark.parametrize(
    ("name", "value"), [("config", {"hdr.clip": 0.9}), ("chart", "none"), ("mask", "mask.png"), ("mask", np.ones(9))]
)
def test_values_of_another_type_are_refused_before_anything_is_written(tmp_path: Path, name: str, value: Any) -> None:
    option: dict[str, Any] = {name: value}
    with pytest.raises(SettingError, match=f"{name} = .*: cannot be used; give "):
        polcap.process(tmp_path, **option)
    assert not list(tmp_path.iterdir())


def test_results_and_values_have_a_short_repr(tmp_path: Path) -> None:
    made = Result(tmp_path / "polcap", {"verdict": "pass", "gates": [{}] * 99})
    assert repr(made) == f"Result({str(tmp_path / 'polcap')!r}, verdict pass)"
    mask = np.ones((400, 300), bool)
    picture = MaskedImage(np.ones((400, 300, 3)), np.ones((400, 300, 3)), mask.astype(np.uint8))
    assert (
        repr(picture)
        == "MaskedImage(value=float64 (400, 300, 3), variance=float64 (400, 300, 3), quality=uint8 (400, 300))"
    )
