"""polcap replaces and removes only files that it has recorded."""

import os
import shutil
from pathlib import Path

import pytest

from polcap.errors import StorageError
from polcap.formats import atomic, own_files


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    own_files.claim(tmp_path / "result", ["maps"])
    return tmp_path / "result"


def recorded(folder: Path) -> list[str]:
    """Names in the record, one for each content of a file."""
    return [line.partition("\t")[0] for line in (folder / own_files.RECORD).read_text().splitlines()[1:]]


def test_a_folder_with_parts_of_a_result_but_no_record_is_refused(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    with pytest.raises(StorageError, match=r"holds maps, but no polcap-files\.txt"):
        own_files.claim(tmp_path, ["maps", "work"])
    own_files.claim(tmp_path, ["work"])  # a folder with other files may hold a result
    own_files.claim(tmp_path, ["maps"])  # it is polcap's now


def test_only_recorded_files_are_replaced(folder: Path) -> None:
    (folder / "foreign.txt").write_text("stays")
    with own_files.opened(folder):
        for text in ("one", "two"):
            atomic.write(folder / "maps" / "own.txt", text)
        with pytest.raises(StorageError, match="polcap did not write"):
            atomic.write(folder / "foreign.txt", "lost")
        (folder / "maps" / "taken.png").mkdir()
        with pytest.raises(StorageError, match="polcap did not write the folder that is there; move it away"):
            atomic.write(folder / "maps" / "taken.png", "lost")
    assert (folder / "foreign.txt").read_text() == "stays"
    assert (folder / "maps" / "own.txt").read_text() == "two"
    assert recorded(folder) == ["maps/own.txt"] * 2  # its two contents


def test_an_edited_file_is_neither_replaced_nor_removed(folder: Path) -> None:
    file = folder / "maps" / "own.png"
    with own_files.opened(folder) as own:
        for content in (b"one", b"two", b"one"):
            atomic.write(file, content)
        file.write_bytes(b"two")  # as a run leaves it that is killed between the record and the new name
        atomic.write(file, b"three")
        file.write_bytes(b"painted")
        with pytest.raises(StorageError, match=r"own\.png: it was edited after polcap wrote it; move it away"):
            atomic.write(file, b"lost")
        with (
            pytest.raises(StorageError, match="edited"),
            atomic.folder_of_files(folder / "maps", "maps.json") as made,
        ):
            for name in ("maps.json", "own.png"):
                (made / name).write_bytes(b"lost")
        own.remove(file)
    assert file.read_bytes() == b"painted"


def test_a_copied_or_touched_folder_is_not_edited(folder: Path, tmp_path: Path) -> None:
    with own_files.opened(folder):
        atomic.write(folder / "own.png", b"one")
    (folder / "own.png").touch()
    with own_files.opened(copied := shutil.copytree(folder, tmp_path / "copy", copy_function=shutil.copy)):
        atomic.write(copied / "own.png", b"two")
    assert (copied / "own.png").read_bytes() == b"two"


def test_files_that_another_process_wrote_meanwhile_are_not_edited(folder: Path) -> None:
    with own_files.opened(folder):
        atomic.write(folder / "own.png", b"one")
        (folder / "own.png").write_bytes(b"of the other process")
        own_files.OwnFiles(folder).record({folder / "own.png": folder / "own.png"})
        atomic.write(folder / "own.png", b"two")


def test_a_foreign_file_with_the_record_s_name_stays(tmp_path: Path) -> None:
    (tmp_path / own_files.RECORD).write_text("maps/mine.txt\n")
    with pytest.raises(StorageError, match=r"polcap-files\.txt is no record of polcap; move it away"):
        own_files.claim(tmp_path, ["maps"])
    assert not own_files.is_claimed(tmp_path)
    assert (tmp_path / own_files.RECORD).read_text() == "maps/mine.txt\n"


@pytest.mark.parametrize("text", ["", "# polcap wrote"])
def test_a_record_that_a_kill_or_a_full_disk_cut_is_begun_again(tmp_path: Path, text: str) -> None:
    (tmp_path / own_files.RECORD).write_text(text)
    own_files.claim(tmp_path, ("maps",))
    assert own_files.is_claimed(tmp_path)
    (foreign := tmp_path / "foreign" / "maps").mkdir(parents=True)
    (foreign.parent / own_files.RECORD).touch()
    with pytest.raises(StorageError, match="polcap did not write it"):
        own_files.claim(foreign.parent, ("maps",))


def test_a_line_that_a_full_disk_cut_spoils_no_other(folder: Path) -> None:
    with (folder / own_files.RECORD).open("a") as record:
        record.write("maps/nor")
    own_files.OwnFiles(folder).record({folder / "maps" / "own.txt": folder / own_files.RECORD})
    assert recorded(folder) == ["maps/nor", "maps/own.txt"]


@pytest.mark.parametrize("name", ["maps", "maps/own.txt", own_files.RECORD])
def test_links_inside_the_folder_are_refused(folder: Path, tmp_path: Path, name: str) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "own.txt").write_text("stays")
    link = folder / name
    link.unlink(missing_ok=True)  # the record
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(elsewhere if name == "maps" else elsewhere / "own.txt")
    with pytest.raises(StorageError, match="is a link"):
        own_files.claim(folder, [])
        with own_files.opened(folder):
            atomic.write(folder / "maps" / "own.txt", "lost")
    assert os.listdir(elsewhere) == ["own.txt"] and (elsewhere / "own.txt").read_text() == "stays"


def test_a_file_is_recorded_before_it_gets_its_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt), own_files.opened(folder):
        atomic.write(folder / "own.txt", "text")
    assert recorded(folder) == ["own.txt"]


def test_another_process_may_record_files_meanwhile(folder: Path) -> None:
    with own_files.opened(folder) as own:
        (folder / "own.txt").write_text("of the other process")
        with (folder / own_files.RECORD).open("a") as record:
            record.write("own.txt\n")
        assert own.owns(folder / "own.txt")


def test_a_recorded_file_is_not_removed_through_a_link(folder: Path, tmp_path: Path) -> None:
    with own_files.opened(folder) as own:
        atomic.write(folder / "maps" / "own.txt", "text")
        (folder / "maps").rename(tmp_path / "moved")
        (folder / "maps").symlink_to(tmp_path / "moved")
        own.remove(folder / "maps" / "own.txt")
        assert own.below(folder / "maps") == []
    assert (tmp_path / "moved" / "own.txt").exists()
