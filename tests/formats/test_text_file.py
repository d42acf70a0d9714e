"""Files of others are opened by one function; the message about a wrong setting names key, value and limit."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest

from polcap import batch, config, report
from polcap.batch import unit
from polcap.errors import InputError, SettingError
from polcap.formats import calibrations, chart_file, color_profile, npy_folder, text_file
from polcap.formats.capture import capture_toml
from polcap.formats.capture.capture_toml import CaptureFile
from polcap.formats.export import web_page
from polcap.formats.maps import maps_folder
from polcap.formats.text_file import fault
from polcap.fusion import fused_maps
from polcap.pipeline import manifest, result_folder, result_place, run_facts, unchanged
from polcap.rig import capture_record
from polcap.rig.device_log import Log
from polcap.synth.shooting import Shoot


@pytest.mark.parametrize(
    ("data", "kind", "words"),
    [
        ({"focal_lenght_mm": 50}, CaptureFile, "focal_lenght_mm: there is no such key; did you mean focal_length_mm?"),
        ({"rotator": {"modle": ""}}, CaptureFile, "rotator.modle: there is no such key; did you mean model?"),
        ({"rotator": {"x": 1}}, CaptureFile, "rotator.x: there is no such key; there are model, log"),
        ({"frame": [{"angel": 0}]}, CaptureFile, "frame[0].angel: there is no such key; did you mean angle?"),
        ({"frame": [{"file": "a", "role": "sht"}]}, CaptureFile, "frame[0].role = 'sht': not one of ambient, "),
        ({"frame": [{"angle": 0}]}, CaptureFile, "frame[0]: object missing required field `file`"),
        ({"focal_length_mm": 0}, CaptureFile, "focal_length_mm = 0: expected `float` > 0.0"),
        ({"step": 0.5}, Shoot, "step = 0.5: expected `float` > 1.0"),
        ({"angles_deg": [0, "x"]}, Shoot, "angles_deg[1] = 'x': expected `float`, got `str`"),
        ({"distortion": [0, "x"]}, Shoot, "distortion[1] = 'x': expected `float`, got `str`"),
        ({"catalog": {"object_number": 7}}, CaptureFile, "catalog.object_number = 7: is not text; put it in quotes"),
        ({"angles_deg": []}, Shoot, "angles_deg: expected `array` of length >= 1"),
        ({"sensor": {"isoo": 100}}, Shoot, "sensor.isoo: there is no such key"),
    ],
)
def test_fault_names_key_value_and_limit(data: dict[str, Any], kind: type[msgspec.Struct], words: str) -> None:
    with pytest.raises(msgspec.ValidationError) as caught:
        msgspec.convert(data, kind)
    assert fault(caught.value, data, kind).startswith(words)


def _checked(file: Path) -> object:
    with suppress(OSError):  # its caller computes the stage again
        return npy_folder.checksum(file)
    return None


def _unit(folder: Path) -> unit.Unit:
    return type("Named", (unit.Unit,), {"slug": "a"})("a", "a", "a", str(folder))


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {  # place of the file below a folder, and its reader
    "settings": ("a.toml", lambda folder: config.read(folder / "a.toml")),
    "color profile": ("a.toml", lambda folder: color_profile.read(folder / "a.toml")),
    "calibration": ("a.toml", lambda folder: calibrations.read(folder / "a.toml")),
    "chart": ("a.txt", lambda folder: chart_file.read(folder / "a.txt")),
    "capture.toml": ("capture.toml", capture_toml.load),
    "rig.json": ("rig.json", capture_record.load),
    "rig.log": ("rig.log", lambda folder: Log(folder / "rig.log").write("rotator", ">", "go")),
    "report.json": ("report.json", report.read),
    "maps.json": ("maps.json", maps_folder.read),
    "run.json": ("work/run.json", run_facts.read),
    "unchanged.json": ("work/unchanged.json", lambda folder: unchanged.find(folder, "digest")),
    "owner": ("work/owner", lambda folder: result_folder._owner(folder / "work" / "owner")),
    "manifest": ("manifest.json", manifest.read_manifest),
    "array": ("a.npy", lambda folder: npy_folder.load(folder / "a.npy")),
    "checksum": ("a.npy", lambda folder: _checked(folder / "a.npy")),
    "mesh of a fusion": ("mesh.npz", lambda folder: fused_maps._mesh_arrays(folder / "mesh.npz")),
    "batch.json": ("polcap-batch/batch.json", batch.reopen),
    "record of a batch": ("records/a.json", lambda folder: unit.read_record(_unit(folder))),
    "model-viewer": ("viewer.js", lambda folder: web_page.read_script(folder / "viewer.js")),
}


@pytest.mark.timeout(30)
@pytest.mark.parametrize("special", ["pipe", "/dev/tty", "/dev/zero"])
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_or_device_in_place_of_a_file_hangs_no_reader(tmp_path: Path, name: str, special: str) -> None:
    if not hasattr(os, "mkfifo"):
        pytest.skip("no named pipes here")
    place, read = READERS[name]
    file = tmp_path / place
    file.parent.mkdir(parents=True, exist_ok=True)
    os.mkfifo(file) if special == "pipe" else file.symlink_to(special)
    try:
        assert read(tmp_path) in (None, {}, "unknown", unit.UnitRecord("a"))  # as if there were none
    except InputError as error:
        assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("parse", "text", "words"),
    [
        (text_file.parse_toml, 'a = "x\\u0000y"', "a holds a NUL character"),
        (text_file.parse_toml, '"a\\u0000" = 1', "holds a NUL character"),
        (text_file.parse_toml, '[[b]]\na = ["x", "\\U00000000"]', r"b\[0\]\.a\[1\] holds a NUL character"),
        (text_file.parse_toml, "title = Vase\n", r"Invalid value \(at line 1, column 9\); put a text in quotes"),
        (text_file.parse_json, '{"a": [{"b": "x\\u0000"}]}', r"a\[0\]\.b holds a NUL character"),
        *((text_file.parse_json, text, "is not a finite number") for text in ("NaN", "[1e999]", '{"a": -Infinity}')),
    ],
)
def test_a_fault_of_a_text_is_named_where_it_is_read(parse: Callable[[str], object], text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        parse(text)


def test_a_nul_character_in_the_name_of_a_file_is_an_error_of_the_file(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="its name holds a NUL character"):
        text_file.read_bytes(tmp_path / "a\0b", 10)
    with pytest.raises(SettingError, match="holds a NUL character"):
        result_place.check(tmp_path / "a\0b", tmp_path)


@pytest.mark.parametrize("depth", [900, 5000, 200_000])
def test_deep_nesting_is_refused_or_read(depth: int) -> None:
    try:
        text_file.parse_json("[" * depth + "]" * depth)
    except ValueError as error:
        assert "nested too deeply" in str(error)
