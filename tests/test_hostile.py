"""Hostile input on the command line gives one clear line and exit code 2, and no file outside the result."""

import json
import os
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from polcap.formats.maps import exr
from tests.conftest import TINY, Command, Done, shell

NESTED = "[" * 30_000


@pytest.fixture
def capture(tiny: Path, tmp_path: Path) -> Path:
    """A copy of the tiny capture, to be spoilt."""
    return Path(shutil.copytree(tiny / "C", tmp_path / "capture", ignore=shutil.ignore_patterns("polcap")))


@pytest.fixture
def copy(tiny_result: Path) -> Path:
    """A copy of its result, to be changed."""
    return tiny_result


def refused(done: Done, *words: str) -> None:
    """Exit code 2 and one line of error that holds the words."""
    lines = [line for line in done.stderr.splitlines() if line.startswith("polcap: ")]
    assert done.returncode == 2, done.stderr
    assert len(lines) == 1 and lines[0].startswith("polcap: error: "), done.stderr
    for word in words:
        assert word in lines[0], lines[0]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"focal_length_mm = {'9' * 5000}", "capture.toml"),
        (f"name = {NESTED}", "nested too deeply"),
        ("focal_length_mm = inf", "not a finite number"),
        ("white = nan", "not a finite number"),
        ('[[frame]]\nfile = "../../etc/passwd"\nangle = 0', "outside the folder"),
        ('name = "a\\nmtllib b"\n[[frame]]\nfile = "pol000"\nangle = 0', "capture.toml"),
    ],
)
def test_a_hostile_capture_toml_is_one_line(polcap: Command, capture: Path, text: str, words: str) -> None:
    (capture / "capture.toml").write_text(text, encoding="utf-8")
    refused(polcap("process", capture, "--dry-run"), words)


@pytest.fixture
def nameless(capture: Path) -> Path:
    """The capture in a folder with a name that is no text."""
    try:
        return capture.rename(capture.with_name(os.fsdecode(b"bad\xff")))
    except OSError as error:
        pytest.skip(f"this file system has no such name ({error.strerror})")


def test_a_result_folder_whose_name_is_no_text_is_refused_before_work(nameless: Path) -> None:
    refused(shell("process", nameless), "is no UTF-8 text", "--out")
    assert not (nameless / "polcap").exists()


def test_a_capture_whose_name_is_no_text_gets_its_result_elsewhere(polcap: Command, nameless: Path, copy: Path) -> None:
    done = polcap("process", nameless, "--out", copy, *TINY)
    assert done.returncode in (0, 3), done.stderr
    assert json.loads((copy / "report.json").read_text())["capture"]["folder"] == str(nameless)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
def test_a_pipe_as_capture_toml_is_not_waited_for(polcap: Command, capture: Path) -> None:
    os.mkfifo(capture / "capture.toml")
    refused(polcap("process", capture, "--dry-run"), "is no regular file")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--set", "hdr.clip=nan"), "hdr.clip = nan"),
        (("--set", "gates.max_ghost=inf"), "gates.max_ghost = inf"),
        (("--set", f"hdr.clip={'9' * 5000}"), "hdr.clip"),
        (("--set", f"hdr.clip={NESTED}"), "hdr.clip"),
        (("--set", "hdr.clip=\udcff"), "UTF-8"),
        (("--chart", "nan,0,1,0,1,1,0,1"), "finite"),
        (("--chart", "0,0,1e999,0,1,1,0,1"), "finite"),
        (("--angles", "0,nan,90"), "finite"),
        (("--memory", "inf"), "--memory"),
        (("--config", "/dev/zero"), "no regular file"),
        (("--config", "/" + "a" * 300), "too long"),
        (("--mask", "/nonexistent.png"), "No such file"),
        (("--model", "/dev/zero"), "no regular file"),
    ],
)
def test_a_hostile_argument_is_one_line(polcap: Command, capture: Path, arguments: tuple[str, str], words: str) -> None:
    refused(polcap("process", capture, "--estimator", "analytic" if arguments[0] != "--model" else "network",
                   "--dry-run", *arguments), words)  # fmt: skip


@pytest.mark.parametrize("name", ["a" * 300, "loop", "loop/capture"])
def test_a_capture_that_no_path_leads_to_is_one_line(polcap: Command, tmp_path: Path, name: str) -> None:
    (tmp_path / "loop").symlink_to("loop")
    refused(polcap("process", tmp_path / name, "--dry-run"))


@pytest.mark.parametrize("name", ["a\\b\nmtllib evil", "é" * 120, "a" * 255, "\udcff\udcfe", "..."])
def test_a_strange_name_of_the_folder_becomes_a_plain_one(
    polcap: Command, capture: Path, tmp_path: Path, name: str
) -> None:
    folder = tmp_path / name
    folder.symlink_to(capture) if name == "..." else capture.rename(folder)
    done = (shell if "\udcff" in name else polcap)("process", folder, "--dry-run", "--json", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["capture"]["name"]
    assert found.isprintable() and not set(found) & set("/\\:\n") and 0 < len(found.encode()) <= 100


def test_a_result_never_lies_among_the_shots(polcap: Command, capture: Path) -> None:
    for place in ("pol135", "pol000/polcap", "POL_90"):
        refused(
            polcap("process", capture, "--estimator", "analytic", "--out", capture / place), "among the capture's shots"
        )
        assert not (capture / place / "work").exists()


def test_terminal_escapes_in_names_stay_out_of_the_terminal(polcap: Command, capture: Path) -> None:
    (capture / "pol000" / "note\x1b]0;owned\x07.txt").write_text("x")
    (capture / "evil\x1b[2J").mkdir()
    done = polcap("process", capture, "--dry-run", "--estimator", "analytic")
    assert done.returncode == 0 and "\x1b" not in done.stdout + done.stderr


def test_a_report_does_not_lead_an_export_elsewhere(polcap: Command, copy: Path) -> None:
    about = json.loads((copy / "report.json").read_text("utf-8"))
    about["capture"]["name"] = "../../evil"
    (copy / "report.json").write_text(json.dumps(about), "utf-8")
    before = {path for path in copy.parent.rglob("*") if copy not in path.parents}
    assert polcap("export", copy, "--gltf").returncode == 0
    assert {path for path in copy.parent.rglob("*") if copy not in path.parents} == before
    assert (copy / "asset" / "_.._evil.glb").exists()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"scale": 2', '"scale": 0'), ('"scale": 2', '"scale": NaN'), ('"scale": 2', '"scale": 1e999'),
        ('"scale": 2', '"scale": null'), ('"unit": "map pixels"', '"unit": 3'), ('"focal_px": ', '"focal_px": -'),
        ('"estimator"', '"nobody"'), ("{", NESTED),
    ],
)  # fmt: skip
def test_a_hostile_maps_json_is_one_line(polcap: Command, copy: Path, old: str, new: str) -> None:
    file = copy / "maps" / "maps.json"
    text = file.read_text("utf-8")
    assert old in text
    file.write_text(text.replace(old, new, 1), "utf-8")
    done = polcap("export", copy, "--gltf")
    if new == '"unit": 3':  # nobody reads it back
        assert done.returncode == 0
    else:
        refused(done, "maps.json")


@pytest.mark.parametrize("harm", ["cut", "empty", "nan", "other size", "gone"])
def test_a_damaged_map_is_one_line(polcap: Command, copy: Path, harm: str) -> None:
    file = copy / "maps" / "normal.exr"
    whole = file.read_bytes()
    if harm == "gone":
        file.unlink()
    elif harm in ("cut", "empty"):
        file.write_bytes(whole[: len(whole) // 3] if harm == "cut" else b"")
    else:
        found = exr.read(file)
        shape = (4, 4) if harm == "other size" else found["R"].shape
        exr.write(file, {name: np.full(shape, np.nan if harm == "nan" else 1.0) for name in "RGB"})
    refused(polcap("export", copy, "--gltf"), "normal.exr")


@pytest.mark.parametrize("text", ["", "null", "[]", "{}", NESTED, '{"figures": null}', '{"settings": {"hdr": 3}}'])
def test_a_hostile_report_is_one_line(polcap: Command, copy: Path, text: str) -> None:
    (copy / "report.json").write_text(text, "utf-8")
    refused(polcap("export", copy), "report.json")
    refused(polcap("report", copy, "--compare", copy), "report.json")


@pytest.mark.parametrize("turn", [45, "90", None])
def test_a_turn_in_a_report_that_is_no_quarter_is_one_line(polcap: Command, copy: Path, turn: object) -> None:
    about = json.loads((copy / "report.json").read_text("utf-8"))
    about["capture"]["upright_deg"] = turn
    (copy / "report.json").write_text(json.dumps(about), "utf-8")
    refused(polcap("export", copy, "--ply"), "report.json")


@pytest.mark.parametrize("name", ["run.json", "01-hdr/manifest.json", "07-cues/manifest.json"])
def test_an_edited_cache_is_one_line(polcap: Command, copy: Path, name: str) -> None:
    file = copy / "work" / name
    if not file.exists():
        pytest.skip("this stage is not cached")
    text = file.read_text("utf-8")
    file.write_text(text.replace('"focal', '"local', 1) if '"focal' in text else text[:-9], "utf-8")
    refused(polcap("report", copy), "polcap process")


@pytest.mark.parametrize("role", ["photograph", "mask"])
def test_a_picture_of_more_pixels_than_any_camera_is_refused_unread(
    polcap: Command, capture: Path, tmp_path: Path, role: str
) -> None:
    head = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 0, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))
    place = next((capture / "pol000").iterdir()) if role == "photograph" else tmp_path / "mask.png"
    place.write_bytes(bomb)
    mask = ("--mask", place) if role == "mask" else ()
    refused(polcap("process", capture, "--dry-run", "--estimator", "analytic", *mask), "30000×30000 px", "256 million")


def test_messages_are_of_bearable_length(polcap: Command, tmp_path: Path) -> None:
    done = polcap("process", tmp_path, "--set", f"hdr.clip={'9' * 100_000}")
    assert done.returncode == 2 and len(done.stderr) < 1000
