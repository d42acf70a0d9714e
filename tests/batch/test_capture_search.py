"""A batch finds the folders that `process` takes, whatever other programs put there."""

import os
from pathlib import Path

import pytest

from polcap import batch
from polcap.errors import CaptureError
from polcap.formats.capture import reader
from tests.formats.capture.capture_folders import flat, folders, pictures, shoot


def found(root: Path) -> list[str]:
    return [unit.name for unit in batch.find(root)]


def thumbnails(folder: Path) -> None:
    """Of a Synology drive: a folder per photograph, named as it."""
    pictures(folder / "@eaDir" / "IMG_0000.dng", ["THUMB.png"])


def rejected(folder: Path) -> None:
    for number in (1, 2):
        shoot(folder / "rejected" / f"IMG_{number}.dng")


def pipe(folder: Path) -> None:
    if not hasattr(os, "mkfifo"):
        pytest.skip("no named pipes here")
    os.mkfifo(folder / "IMG_0001.sync")


ADDED = {
    "nothing": lambda folder: None,
    "thumbnails": thumbnails,
    "catalog": lambda folder: (folder / "CaptureOne" / "Cache").mkdir(parents=True),
    "empty folder": lambda folder: (folder / "selects").mkdir(),
    "developed pictures": lambda folder: pictures(folder / "jpg", [f"IMG_{k}.png" for k in range(6)]),
    "rejected photographs": rejected,
    "recycle bin": lambda folder: shoot(folder / "#recycle" / "IMG_7.dng"),
    "pipe": pipe,
    "link to nowhere": lambda folder: (folder / "exports").symlink_to(folder.parent / "none"),
    "unknown sidecar": lambda folder: (folder / "IMG_0000.xyz").write_bytes(bytes(range(256))),
}


@pytest.mark.parametrize("added", ADDED)
def test_a_batch_takes_the_folder_that_process_takes(tmp_path: Path, added: str) -> None:
    ADDED[added](flat(tmp_path / "vase"))
    assert len(reader.read(tmp_path / "vase").shots) == 3
    assert found(tmp_path) == ["vase"]


def test_two_captures_of_which_one_holds_the_other_are_both_taken(tmp_path: Path) -> None:
    flat(tmp_path / "vase")
    flat(tmp_path / "vase" / "again")
    assert found(tmp_path) == ["vase", "vase/again"]


def test_pictures_above_captures_document_the_session(tmp_path: Path) -> None:
    pictures(tmp_path, ["setup1.png", "setup2.png", "setup3.png"])
    folders(tmp_path / "vase")
    flat(tmp_path / "cup")
    assert found(tmp_path) == ["cup", "vase"]


def test_a_damaged_photograph_does_not_hide_its_folder(tmp_path: Path) -> None:
    (tmp_path / "vase").mkdir()
    (tmp_path / "vase" / "IMG_0001.dng").write_bytes(b"")
    assert found(tmp_path) == ["vase"]  # and `process` names the file


def test_links_to_captures_are_followed_once(tmp_path: Path) -> None:
    flat(tmp_path / "store" / "vase")
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "mine").symlink_to(tmp_path / "store" / "vase")
    (tmp_path / "root" / "loop").symlink_to(tmp_path / "root")
    assert found(tmp_path / "root") == ["mine"]
    (tmp_path / "store" / "again").symlink_to(tmp_path / "store" / "vase")
    assert found(tmp_path / "store") == ["vase"]


def test_a_folder_of_other_programs_alone_is_no_capture(tmp_path: Path) -> None:
    shoot(tmp_path / "$RECYCLE.BIN" / "IMG_7.dng")
    with pytest.raises(CaptureError, match="holds no capture"):
        batch.find(tmp_path)
