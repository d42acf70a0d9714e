"""What photographs tell is read once: again where one has changed, may yet change, or another program asks."""

import os
from pathlib import Path

import pytest

from polcap.formats.raw import probe
from polcap.formats.raw.probe import Probe
from polcap.formats.raw.probed import Probed
from polcap.images import Exif

OLD_NS = 1_600_000_000_000_000_000


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that were read, in order."""
    names: list[str] = []

    def read(path: str | Path) -> Probe:
        names.append(Path(path).name)
        data = Path(path).read_bytes()
        return Probe("raw", data.hex(), Exif(make="Z", exposure_time=0.02, width=6), lossy=True)

    monkeypatch.setattr(probe, "read", read)
    return names


def _photograph(file: Path, text: str = "a", age: int = 0) -> Path:
    file.write_text(text)
    os.utime(file, ns=(OLD_NS + age, OLD_NS + age))
    return file


def test_a_photograph_is_read_once_by_this_run_and_the_next(tmp_path: Path, asked: list[str]) -> None:
    file, memory = _photograph(tmp_path / "a.dng"), tmp_path / "work" / "photographs.json"
    first = Probed(memory, "1")
    found = first(file)
    assert first(file) == found
    first.remember()
    written = memory.stat().st_mtime_ns
    again = Probed(memory, "1")
    assert again(file) == found and asked == ["a.dng"]
    again.remember()
    assert memory.stat().st_mtime_ns == written  # nothing new, nothing written


def test_what_changed_is_read_again_and_nothing_else(tmp_path: Path, asked: list[str]) -> None:
    files = [_photograph(tmp_path / name) for name in ("a.dng", "b.dng")]
    look = Probed()
    for file in files:
        look(file)
    _photograph(files[1], "b", 1)  # as large as before
    assert look(files[0]).digest == b"a".hex() and look(files[1]).digest == b"b".hex()
    assert asked == ["a.dng", "b.dng", "b.dng"]


def test_what_may_change_yet_is_not_remembered(tmp_path: Path, asked: list[str]) -> None:
    file = tmp_path / "a.dng"
    file.write_text("a")
    ahead = file.stat().st_mtime_ns + 3_600_000_000_000  # of a clock that is wrong, or of just now
    os.utime(file, ns=(ahead, ahead))
    look = Probed()
    look(file)
    look(file)
    assert asked == ["a.dng", "a.dng"]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"program": "1", "files": {}, "digest": "d"}', "[" * 10000])
def test_a_damaged_memory_is_none(tmp_path: Path, asked: list[str], text: str) -> None:
    file, memory = _photograph(tmp_path / "a.dng"), tmp_path / "photographs.json"
    memory.write_text(text)
    Probed(memory, "1")(file)
    assert asked == ["a.dng"]


def test_an_edited_memory_and_that_of_another_program_are_none(tmp_path: Path, asked: list[str]) -> None:
    file, memory = _photograph(tmp_path / "a.dng"), tmp_path / "photographs.json"
    look = Probed(memory, "1")
    look(file)
    look.remember()
    Probed(memory, "2")(file)
    memory.write_text(memory.read_text().replace("0.02", "0.04"))
    Probed(memory, "1")(file)
    assert asked == ["a.dng"] * 3


def test_a_missing_photograph_is_told_as_ever(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="cannot be read"):
        Probed()(tmp_path / "gone.dng")
