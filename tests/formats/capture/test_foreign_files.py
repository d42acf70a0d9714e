"""Files of other programs among photographs change nothing; a photograph that is missing or damaged is an error."""

import os
import unicodedata
from pathlib import Path
from typing import Literal

import pytest

from polcap.calibrate import calibration_photographs
from polcap.capture_values import Capture
from polcap.errors import InputError
from polcap.formats.capture import foreign_files, reader
from tests.formats.capture.capture_folders import each, flat, folders, names, pictures, shoot, state

Form = Literal["NFC", "NFD"]
BINARY = b"\0\1\2\377"
SILENT = {
    **dict.fromkeys(["IMG_0.acr", "IMG_0.vrd", "IMG_0.DR4", "IMG_0.dng.dop", "ZbThumbnail.info", "Thumbs.db"], BINARY),
    "._IMG_0.dng": BINARY,
    "desktop.ini": "\ufeff[.ShellClassInfo]".encode("utf-16-le"),
    "Icon\r": b"",
    "IMG_0.xmp": b"",
    "IMG_0.dng_original": BINARY,
    "IMG_5.dng.part": BINARY,
}
NOTED = {
    "IMG_0.xyz": BINARY,
    "IMG_0.jpg": b"",  # of a pair
    "IMG_0.tif": BINARY,
    "overview.jpg": b"\xff\xd8\xff cut",
    "drive.state": BINARY,
    "empty": b"",
}


def digests(capture: Capture) -> list[str]:
    return [frame.digest for shot in capture.shots for frame in shot.frames]


@pytest.mark.parametrize("layout", ["flat", "folders"])
@pytest.mark.parametrize("name", [*SILENT, *NOTED])
def test_files_of_other_programs_are_left_out(tmp_path: Path, name: str, layout: str) -> None:
    root = flat(tmp_path) if layout == "flat" else folders(tmp_path)
    place = root if layout == "flat" else root / "pol000"
    if layout == "flat":
        (root / "IMG_9998.dng").rename(root / "IMG_0.dng")
    before = reader.read(root)
    (place / name).write_bytes({**SILENT, **NOTED}[name])
    after = reader.read(root)
    assert digests(after) == digests(before)
    assert any(name in note for note in after.notes) is (name in NOTED)


@pytest.mark.parametrize(
    "name", ["@eaDir", "#recycle", "CaptureOne", "NKSC_PARAM", "Vase.lrdata", "System Volume Information"]
)
def test_folders_of_other_programs_are_not_even_named(tmp_path: Path, name: str) -> None:
    root = folders(tmp_path)
    shoot(root / name / "pol135" / "IMG_0.dng")
    assert not any(name in note for note in reader.read(root).notes)


@pytest.mark.parametrize("damaged", ["pol000/IMG_5.dng", "pol000/IMG_5.NEF", "pol000/IMG_5.cr3", "c.tif"])
def test_a_damaged_photograph_is_an_error(tmp_path: Path, damaged: str) -> None:
    pictures(tmp_path, ["a.png", "b.png"]) if damaged == "c.tif" else folders(tmp_path)
    (tmp_path / damaged).write_bytes(BINARY)
    with pytest.raises(InputError, match=damaged):
        reader.read(tmp_path)


def test_a_link_to_nowhere_is_named(tmp_path: Path) -> None:
    frame = folders(tmp_path) / "pol045" / "IMG_1.dng"
    frame.unlink()
    frame.symlink_to("../../card/IMG_1.dng")
    with pytest.raises(InputError, match=r"IMG_1\.dng: is a link to \.\./\.\./card/IMG_1\.dng, which is missing"):
        reader.read(tmp_path)
    (tmp_path / "pol135").symlink_to(tmp_path / "none")
    with pytest.raises(InputError, match="pol135: is a link to a missing folder"):
        reader.read(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_named_as_a_photograph_is_one_line(tmp_path: Path) -> None:
    os.mkfifo(folders(tmp_path) / "pol045" / "IMG_7.dng")
    with pytest.raises(InputError, match=r"IMG_7\.dng.*no regular file"):
        reader.read(tmp_path)


@pytest.mark.parametrize(("on_disk", "stated"), [("NFD", "NFC"), ("NFC", "NFD")])
def test_names_in_another_unicode_form_are_found(tmp_path: Path, on_disk: Form, stated: Form) -> None:
    (tmp_path / unicodedata.normalize(on_disk, "drehwinkel ä.txt")).touch()
    angles = {f"Größe/Öl {angle}.dng": angle for angle in (0, 45, 90)}
    for name in angles:
        shoot(tmp_path / unicodedata.normalize(on_disk, name))
    log = unicodedata.normalize(stated, '{ log = "drehwinkel ä.txt" }')
    state(tmp_path, {unicodedata.normalize(stated, name): angle for name, angle in angles.items()}, rotator=log)
    assert len(reader.read(tmp_path).shots) == 3


def test_angle_folders_in_two_unicode_forms_belong_together(tmp_path: Path) -> None:
    forms: dict[int, Form] = {0: "NFC", 45: "NFD", 90: "NFC"}
    each(tmp_path, [unicodedata.normalize(form, f"Öffnung {angle}") for angle, form in forms.items()])
    assert len(reader.read(tmp_path).shots) == 3


def test_links_to_photographs_are_taken_in_every_layout(tmp_path: Path) -> None:
    store = folders(tmp_path / "store")
    angles: dict[str, int] = {}
    for file in store.glob("*/*"):
        name = f"{file.parent.name}_{file.name}"
        for link in (tmp_path / "folders" / file.relative_to(store), tmp_path / "toml" / name):
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(file)
        angles[name] = int(file.parent.name.removeprefix("pol"))
    state(tmp_path / "toml", dict(sorted(angles.items())))
    understood = [reader.read(tmp_path / layout) for layout in ("folders", "toml")]
    assert digests(understood[0]) == digests(understood[1])
    assert names(understood[0].shots[0]) == ["IMG_1.dng", "IMG_0.dng"]


def test_calibration_leaves_out_the_same_files(tmp_path: Path) -> None:
    shoot(tmp_path / "IMG_0.dng")
    for name, content in {**SILENT, **NOTED}.items():
        (tmp_path / name).write_bytes(content)
    assert [one.path.name for one in calibration_photographs.photographs_in(tmp_path)] == ["IMG_0.dng"]


def test_a_watched_folder_does_not_change_by_thumbnails(tmp_path: Path) -> None:
    flat(tmp_path)
    before = set(foreign_files.files_below(tmp_path, tmp_path / "polcap"))
    pictures(tmp_path / "@eaDir" / "IMG_0000.dng", ["THUMB.png"])
    pictures(tmp_path / "polcap", ["normal.png"])
    (tmp_path / "Thumbs.db").write_bytes(BINARY)
    assert set(foreign_files.files_below(tmp_path, tmp_path / "polcap")) == before
