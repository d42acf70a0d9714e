"""The public surface: what it names, what it costs, and that it does what the command line does."""

import subprocess
import sys

import pytest

import polcap
from polcap.formats.maps import maps_folder as maps
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
    assert polcap.read_maps is maps.read


def test_python_takes_the_network_as_the_command_line_does(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def load(*arguments: object) -> None:
        asked.append(arguments)
        raise polcap.PolcapError("far enough")

    monkeypatch.setattr(models, "load_network", load)
    with pytest.raises(polcap.PolcapError, match="far enough"):
        polcap.process("nowhere")
    assert asked == [(None, None)]  # what `polcap process` without flags asks for
