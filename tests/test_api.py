"""The public surface: what it names, what it costs, and that it does what the command line does."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import polcap
from polcap.api import Result
from polcap.errors import PolcapError, SettingError
from polcap.formats.maps import result_maps as maps
from polcap.image_values import MaskedImage
from polcap.pipeline import models
from polcap.pipeline import run as pipeline
from polcap.results import ResultsUntilMask


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
    models.load_networks.cache_clear()  # an earlier test of this process may have opened the networks
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


def test_results_and_values_have_a_short_repr(tmp_path: Path, example: Path) -> None:
    read = repr(polcap.read_capture(example))
    assert read.startswith("Capture('capture', folders, frames 0°: 3, 45°: 3, 90°: 3; ") and read.endswith(" px)")
    made = Result(tmp_path / "polcap", {"verdict": "pass", "gates": [{}] * 99})
    assert repr(made) == f"Result({str(tmp_path / 'polcap')!r}, verdict pass)"
    mask = np.ones((400, 300), bool)
    picture = MaskedImage(np.ones((400, 300, 3)), np.ones((400, 300, 3)), mask.astype(np.uint8))
    assert (
        repr(picture)
        == "MaskedImage(value=float64 (400, 300, 3), variance=float64 (400, 300, 3), quality=uint8 (400, 300))"
    )


def test_check_export_and_reopen_take_strings(tiny: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(tiny / "C", tmp_path / "C"))  # its result is in polcap/
    found = polcap.check(str(copy))
    assert found.capture == "C" and found.keep == all(line.state != "fail" for line in found.lines)
    files = polcap.export(str(copy), "godot", extras="cavity", texture_size=64, catalog={"title": "Vase"})
    assert {"C.glb", "C_orm.png", "C_cavity.png"} <= {file.name for file in files}
    assert pipeline.reopen(str(copy), ResultsUntilMask)[0].object_.mask.any()


def test_the_python_of_the_reference_pages_runs(
    tiny: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("CAPTURE", "capture"):
        shutil.copytree(tiny / "C", tmp_path / name)
    monkeypatch.chdir(tmp_path)
    about = json.loads((tiny / "C" / "polcap" / "report.json").read_text(encoding="utf-8"))
    monkeypatch.setattr(polcap, "process", lambda folder: Result(Path(folder) / "polcap", about), raising=False)
    programs = 0
    for page in (Path(__file__).parents[1] / "docs" / "reference").glob("*.md"):
        for block in re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
            if block.startswith(("import ", "from ")):  # others are definitions
                exec(compile(block, str(page), "exec"), {})
                programs += 1
    assert programs >= 3 and capsys.readouterr().out.count("\n") >= 3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"preset": "maya", "color": "ACEScg"}, "^color ACEScg converts"),
        ({"formats": ("obj",), "geometry": "draco"}, "^images and geometry change the GLB"),
        ({"iiif": "http://museum.example", "texture_size": 64}, "leave out texture_size"),
        ({"preset": "unreal", "formats": "usd"}, "^preset unreal brings its formats; write usd by a second export"),
        ({"preset": "unrael"}, "^preset unrael: there is no such preset; did you mean unreal"),
        ({"formats": ("usdx",)}, r"^formats usdx: there is no such format; did you mean usd\?"),
        ({"extras": ["curvatur"]}, "^extras curvatur: there is no such texture; did you mean curvature"),
        ({"catalog": {"titel": "x"}}, "^catalog titel: there is no such fact; did you mean title"),
        ({"catalog": {"object_number": 7}}, "^catalog object_number = 7: it is no text"),
        ({"images": "gif"}, "^images gif: there is no such picture format"),
        ({"bits": 12}, "^bits 12: there is no such depth"),
        ({"texture_size": -3}, "^texture_size -3: it is a whole number of at least 16"),
        ({"triangles": 2.5}, "^triangles 2.5: it is a whole number"),
        ({"lod": "2"}, "^lod '2': it is a whole number of at least 0"),
        ({"formats": "fbx"}, "^formats fbx: there is no such format"),
    ],
)
def test_errors_name_the_argument_and_not_the_flag(tiny: Path, options: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingError, match=words) as caught:
        polcap.export(tiny / "C", **options)
    assert "--texture" not in str(caught.value) and "--color" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"threads": -1}, "^threads -1: give a number of threads, or 0 for all"),
        ({"angles_deg": "0,45,90"}, r"^angles_deg = '0,45,90': it holds no numbers; give degrees"),
        ({"angles_deg": ("0", "45", "90")}, "it holds no numbers"),
    ],
)
def test_process_refuses_what_the_command_refuses(
    example: Path, tmp_path: Path, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(PolcapError, match=words):
        polcap.process(example, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_fuse_refuses_what_the_command_refuses(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="no such folder; give the folder that holds view01"):
        polcap.fuse(tmp_path / "none")
    with pytest.raises(SettingError, match=r"config = .*SessionConfig"):
        polcap.fuse(tmp_path, config=polcap.Config())  # type: ignore[arg-type]
