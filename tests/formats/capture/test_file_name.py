"""A capture's name becomes a file's name on any system."""

import pytest

from polcap.formats.capture import file_name


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("vase 3", "vase 3"),
        ("C:\\shots\\vase", "C__shots_vase"),
        ("a/b", "a_b"),
        ("con", "_con"),  # Windows opens the console, whatever the suffix
        ("Nul.old", "_Nul.old"),
        ("console", "console"),
        ("..", "capture"),
        ("jar. ", "jar"),
    ],
)
def test_name_means_a_file_and_nothing_else(text: str, name: str) -> None:
    assert file_name.safe(text) == name


def test_long_name_is_cut_between_characters() -> None:
    cut = file_name.safe("ä" * 300)
    assert set(cut) == {"ä"} and len(cut.encode()) <= 60
