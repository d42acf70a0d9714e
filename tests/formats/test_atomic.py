"""Atomic writing: a partial file never has its final name."""

import errno
import os
from pathlib import Path

import pytest

from polcap.errors import StorageError
from polcap.formats import atomic, own_files


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_file_appears_whole_under_its_final_name(tmp_path: Path) -> None:
    final = tmp_path / "new" / "a.bin"
    with atomic.path(final) as temporary:
        temporary.write_bytes(b"abc")
        assert not final.exists()
        assert temporary.suffix == ".bin"
    assert final.read_bytes() == b"abc"
    assert names(final.parent) == ["a.bin"]


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    final = tmp_path / "a.bin"
    final.write_bytes(b"old")
    with pytest.raises(RuntimeError), atomic.path(final) as temporary:
        temporary.write_bytes(b"half")
        raise RuntimeError("killed")
    assert final.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]


@pytest.mark.parametrize(("code", "words"), [(errno.ENOSPC, "full"), (errno.EROFS, "read-only")])
def test_refusals_of_the_disk_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, words: str
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(StorageError, match=words) as caught:
        atomic.write(tmp_path / "a.bin", "abc")
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == []


def test_a_name_too_long_and_a_file_in_place_of_a_folder_are_named(tmp_path: Path) -> None:
    """Rather than the error of the cleaning, which fails too."""
    (tmp_path / "file").write_bytes(b"")
    for name, words in (("a" * 250, "the name is too long"), ("file/a.bin", "there is a file where a folder is")):
        with pytest.raises(StorageError, match=words):
            atomic.write(tmp_path / name, "abc")


def test_files_of_an_old_folder_are_replaced_and_removed(tmp_path: Path) -> None:
    own_files.claim(tmp_path, ["stage"])
    with own_files.opened(tmp_path):
        for text in ("one", "two"):
            with atomic.folder_of_files(tmp_path / "stage", "index") as temporary:
                (temporary / text).write_text(text)
                (temporary / "index").write_text(text)
            (tmp_path / "stage" / "foreign").write_text("stays")
    assert names(tmp_path / "stage") == ["foreign", "index", "two"]
    assert names(tmp_path) == [own_files.RECORD, "stage"]


def test_failed_folder_leaves_the_old_one(tmp_path: Path) -> None:
    final = tmp_path / "stage"
    with atomic.folder_of_files(final, "one") as temporary:
        (temporary / "one").write_text("1")
    with pytest.raises(StorageError), atomic.folder_of_files(final, "one") as temporary:
        (temporary / "two").write_text("2")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert names(final) == ["one"]
    assert names(tmp_path) == ["stage"]


def test_a_new_folder_never_replaces_files(tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "foreign").write_text("stays")
    (tmp_path / "empty").mkdir()
    with atomic.new_folder(tmp_path / "empty") as temporary:
        (temporary / "one").write_text("1")
    with pytest.raises(StorageError, match="full"), atomic.new_folder(tmp_path / "full") as temporary:
        (temporary / "one").write_text("1")
    assert names(tmp_path / "empty") == ["one"] and names(tmp_path / "full") == ["foreign"]


def test_no_link_is_written_through_or_replaced(tmp_path: Path) -> None:
    (tmp_path / "photograph").write_bytes(b"RAW")
    (tmp_path / "report.json").symlink_to(tmp_path / "photograph")
    with pytest.raises(StorageError, match="is a link"):
        atomic.write(tmp_path / "report.json", "new")
    assert (tmp_path / "report.json").is_symlink() and (tmp_path / "photograph").read_bytes() == b"RAW"


def test_bytes_reach_the_disk_before_their_name_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    named: list[tuple[str, list[str]]] = []  # synced file, and the names at that time

    def note(handle: int) -> None:
        named.append((Path(f"/proc/self/fd/{handle}").readlink().name, names(tmp_path)))

    if not Path("/proc/self/fd").exists():
        pytest.skip("this system does not name the file of a handle")
    monkeypatch.setattr(os, "fsync", note)
    with atomic.path(tmp_path / "a.bin") as temporary:
        temporary.write_bytes(b"abc")
    assert [name for name, _ in named] == [temporary.name] and "a.bin" not in named[0][1]
    named.clear()
    with atomic.new_folder(tmp_path / "stage") as folder:
        (folder / "one").write_text("1")
        (folder / "two").write_text("2")
    assert sorted(name for name, _ in named) == sorted(["one", "two", folder.name])
    assert not any("stage" in present for _, present in named)
    named.clear()
    with atomic.path(tmp_path / "b.bin", synced=False) as temporary:
        temporary.write_bytes(b"abc")
    assert not named


@pytest.mark.parametrize(
    ("text", "name"),
    [  # Windows opens the console, whatever the suffix
        ("vase 3", "vase 3"), ("C:\\shots\\vase", "C__shots_vase"), ("a/b", "a_b"), ("con", "_con"),
        ("Nul.old", "_Nul.old"), ("console", "console"), ("..", "capture"), ("jar. ", "jar"), ("ä" * 300, "ä" * 30),
    ],
)  # fmt: skip
def test_name_means_a_file_and_nothing_else(text: str, name: str) -> None:
    assert atomic.safe_name(text) == name
