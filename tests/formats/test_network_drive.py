"""Drives without syncs of folders, locks or shared memory maps, as network drives are: work goes on, or one line."""

import errno
import mmap
import os
from pathlib import Path
from typing import NoReturn

import numpy as np
import pytest

from polcap.capture_values import Exif
from polcap.errors import StorageError
from polcap.formats import atomic, npy_folder
from polcap.formats.raw import file_kind
from polcap.pipeline import result_folder
from polcap.rig import sequence
from tests.raw_files import write_raw


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES])
def test_a_drive_that_cannot_sync_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    monkeypatch.setattr(os, "fsync", lambda handle: _refuse(code))
    atomic.sync(tmp_path)
    atomic.write(tmp_path / "a.txt", "abc")
    assert (tmp_path / "a.txt").read_text() == "abc"


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.ENOTSUP])
def test_a_drive_without_locks_is_one_line_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    fcntl = pytest.importorskip("fcntl")
    monkeypatch.setattr(fcntl, "flock", lambda *_: _refuse(code))
    with pytest.raises(StorageError, match="local disk with -o"), result_folder.locked(tmp_path):
        pass
    with pytest.raises(StorageError, match="local disk"), sequence._locked(tmp_path):
        pass


def test_a_drive_without_memory_maps_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    array = np.arange(1 << 16, dtype=np.float32)
    npy_folder.save(tmp_path / "large.npy", array)
    write_raw(tmp_path / "a.dng", np.full((16, 16), 600, np.uint16), Exif())
    monkeypatch.setattr(mmap, "mmap", lambda *_, **__: _refuse(errno.ENODEV))
    monkeypatch.setattr(file_kind, "mmap", mmap.mmap)
    read = npy_folder.load(tmp_path / "large.npy")
    assert not isinstance(read, np.memmap) and not read.flags.writeable
    np.testing.assert_array_equal(read, array)
    with (tmp_path / "a.dng").open("rb") as file:
        assert file_kind.kind(file, ".dng") == "raw"


def _refuse(code: int) -> NoReturn:
    raise OSError(code, os.strerror(code))
