"""`polcap doctor FILE` reports whether a photograph can be used, and why not."""

from pathlib import Path

import numpy as np
import pytest

from polcap.capture_values import Exif
from polcap.doctor import Finding
from polcap.doctor.photograph import examine_file
from polcap.formats.maps import png
from polcap.formats.raw import libraw as raw
from tests.conftest import Command
from tests.raw_files import write_raw


def findings(file: Path) -> dict[str, Finding]:
    return {one.name: one for one in examine_file(file)}


def test_a_sound_raw_is_ok_throughout(example: Path) -> None:
    found = findings(sorted(example.rglob("*.DNG"))[0])
    assert {one.state for one in found.values()} == {"ok"}
    assert found["pattern"].message.startswith("Bayer")


def test_a_cut_file_and_a_text_are_faults(example: Path, tmp_path: Path) -> None:
    whole = sorted(example.rglob("*.DNG"))[0].read_bytes()
    (tmp_path / "cut.dng").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "notes.txt").write_text("f/11")
    for name in ("cut.dng", "notes.txt", "."):
        assert any(one.state == "fault" and one.remedy for one in findings(tmp_path / name).values())


def test_an_over_exposed_frame_and_a_monochrome_one_are_warnings(tmp_path: Path) -> None:
    write_raw(tmp_path / "white.dng", np.full((64, 64), 4095, np.uint16), Exif(make="Polcap", model="Test"), 0, 4095)
    assert findings(tmp_path / "white.dng")["levels"].state == "warning"
    png.write(tmp_path / "grey.png", np.tile(np.arange(64, dtype=np.uint16) * 900, (64, 1))[..., None].repeat(3, 2))
    assert "monochrome" in findings(tmp_path / "grey.png")["pattern"].message


@pytest.mark.parametrize(("white", "state"), [(3840, "ok"), (2000, "warning")])
def test_counts_may_exceed_the_stated_white_level_a_little(tmp_path: Path, white: int, state: str) -> None:
    counts = np.full((64, 64), 900, np.uint16)
    counts[:8] = 4095
    write_raw(tmp_path / "bright.dng", counts, Exif(make="Polcap", model="Test"), 0, white)
    levels = findings(tmp_path / "bright.dng")["levels"]
    assert levels.state == state and ("does not fit the counts" in levels.remedy) == (state == "warning")


@pytest.mark.parametrize(("shape", "name"), [((6, 6), "6×6"), (None, "Foveon"), ((4, 4), "4×4")])
def test_other_mosaics_are_named_with_a_way_out(shape: tuple[int, int] | None, name: str) -> None:
    assert name in raw.unsupported(shape) and "16-bit TIFF" in raw.unsupported(shape)


def test_command_prints_one_line_a_finding(example: Path, polcap: Command) -> None:
    done = polcap("doctor", sorted(example.rglob("*.DNG"))[0])
    assert done.returncode == 0
    assert "Bayer" in done.stdout
