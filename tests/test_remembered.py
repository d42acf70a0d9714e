"""Plain data that was made of results: taken again from the same, made anew from others, and where it is damaged."""

from pathlib import Path

import pytest

from polcap.remembered import Remembered


def never() -> None:
    raise AssertionError


def test_what_was_made_from_the_same_is_taken(tmp_path: Path) -> None:
    assert Remembered(tmp_path, "1")("figure", ["key"], lambda: {"a": (1, 0.1)}) == {"a": [1, 0.1]}
    assert Remembered(tmp_path, "1")("figure", ["key"], never) == {"a": [1, 0.1]}


@pytest.mark.parametrize(
    ("program", "made_from", "anew"), [("2", ["key"], False), ("1", [], False), ("1", ["key"], True)]
)
def test_what_was_made_from_another_is_not(tmp_path: Path, program: str, made_from: list[str], anew: bool) -> None:
    Remembered(tmp_path, "1")("figure", ["key"], lambda: 1)
    remembered = Remembered(tmp_path, program, anew)
    assert remembered("figure", made_from, lambda: 2) == 2 and remembered("figure", made_from, never) == 2


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"key": "k", "value": 1, "digest": "d"}', "[" * 10000])
def test_a_damaged_file_is_made_anew(tmp_path: Path, text: str) -> None:
    Remembered(tmp_path)("figure", None, lambda: 1)
    (tmp_path / "work" / "remembered" / "figure.json").write_text(text)
    assert Remembered(tmp_path)("figure", None, lambda: 2) == 2


def test_an_edited_value_is_made_anew(tmp_path: Path) -> None:
    Remembered(tmp_path)("figure", None, lambda: 1234)
    file = tmp_path / "work" / "remembered" / "figure.json"
    file.write_text(file.read_text().replace("1234", "1235"))
    assert Remembered(tmp_path)("figure", None, lambda: 2) == 2


def test_nothing_is_remembered_without_a_folder() -> None:
    assert Remembered()("figure", None, lambda: 1) == 1 and Remembered()("figure", None, lambda: 2) == 2
