"""Which files of a result stand: those made of the same by the same program, and touched by nobody since."""

import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap.formats.written import Written


def make(written: Written, file: Path, made_from: Any, text: str) -> None:
    written.make(file, made_from, partial(file.write_text, text))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "maps").mkdir()
    written = Written(tmp_path, "1")
    make(written, tmp_path / "maps" / "a.txt", ["key", np.arange(3)], "first")
    written.remember()
    return tmp_path / "maps" / "a.txt"


def test_a_file_of_the_same_stands(file: Path, tmp_path: Path) -> None:
    written = Written(tmp_path, "1")
    assert written.untouched()
    make(written, file, ["key", np.arange(3)], "again")
    assert file.read_text() == "first"
    written.remember()
    make(Written(tmp_path, "1"), file, ["key", np.arange(3)], "again")
    assert file.read_text() == "first"


@pytest.mark.parametrize(
    ("program", "made_from", "anew"),
    [
        ("2", ["key", np.arange(3)], False),
        ("1", ["other", np.arange(3)], False),
        ("1", ["key", np.arange(3) + 1], False),
        ("1", ["key", np.arange(3.0)], False),
        ("1", ["key", np.arange(3)], True),
    ],
)
def test_a_file_of_another_does_not(file: Path, tmp_path: Path, program: str, made_from: list[Any], anew: bool) -> None:
    make(Written(tmp_path, program, anew), file, made_from, "again")
    assert file.read_text() == "again"


def test_an_edited_or_lost_file_is_made_again(file: Path, tmp_path: Path) -> None:
    about = file.stat()
    file.write_text("fIrst")
    os.utime(file, ns=(about.st_atime_ns, about.st_mtime_ns + 1))
    assert not Written(tmp_path, "1").untouched()
    make(Written(tmp_path, "1"), file, ["key", np.arange(3)], "first")
    assert file.read_text() == "first"
    file.unlink()
    make(Written(tmp_path, "1"), file, ["key", np.arange(3)], "first")
    assert file.read_text() == "first"


def test_a_file_is_left_until_it_is_touched(file: Path, tmp_path: Path) -> None:
    assert Written(tmp_path, "2").left(file) and not Written(tmp_path, anew=True).left(file)
    file.write_text("longer than it was")
    assert not Written(tmp_path, "2").left(file)


def test_a_damaged_memory_makes_all_again(file: Path, tmp_path: Path) -> None:
    (tmp_path / "work" / "written.json").write_text('{"files": 3}')
    assert not Written(tmp_path, "1").untouched()
    make(Written(tmp_path, "1"), file, ["key", np.arange(3)], "again")
    assert file.read_text() == "again"


def test_files_stand_together_where_all_are_as_they_were_left(file: Path, tmp_path: Path) -> None:
    other = tmp_path / "maps" / "b.txt"
    other.write_text("beside")
    written = Written(tmp_path, "1")
    make(written, file, ["key", np.arange(3)], "again")
    written.note(other, "source")
    written.remember()
    assert not Written(tmp_path, "1").stand([other, file], "another source")
    assert not Written(tmp_path, "2").stand([other, file], "source")
    assert not Written(tmp_path, "1", anew=True).stand([other, file], "source")
    taken = Written(tmp_path, "1")
    assert taken.stand([other, file], "source")
    taken.remember()  # what each was made from goes on
    assert Written(tmp_path, "1").stand([other, file], "source")
    make(Written(tmp_path, "1"), file, ["key", np.arange(3)], "again")
    assert file.read_text() == "first"
    file.unlink()
    assert not Written(tmp_path, "1").stand([other, file], "source")
