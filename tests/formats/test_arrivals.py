"""A folder that is being filled: told once it rests, and not before."""

import threading
import time
from pathlib import Path

import pytest

from polcap.formats import arrivals


def test_tells_when_a_folder_rests_after_a_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = tmp_path / "polcap"
    made.mkdir()
    monkeypatch.chdir(tmp_path)
    moments = arrivals.settled(Path(), made, still_s=0.6)  # the same folder by two names
    next(moments)  # as it is

    def arrive() -> None:
        (made / "map.exr").write_bytes(b"not looked at")
        (tmp_path / ".hidden").write_bytes(b"nor this")
        time.sleep(0.8)
        for _ in range(4):  # a file that grows, more slowly than anybody looks
            with (tmp_path / "a.dng").open("ab") as file:
                file.write(bytes(100))
            written.append(time.monotonic())
            time.sleep(0.3)

    written: list[float] = []
    thread = threading.Thread(target=arrive)
    thread.start()
    next(moments)
    told = time.monotonic()
    thread.join()
    assert len(written) == 4 and told - written[-1] >= 0.6


def test_tells_when_a_file_goes(tmp_path: Path) -> None:
    (tmp_path / "a.dng").write_bytes(b"a")
    moments = arrivals.settled(tmp_path, tmp_path / "polcap", still_s=0.0)
    next(moments)
    threading.Timer(0.3, (tmp_path / "a.dng").unlink).start()
    next(moments)
    assert not (tmp_path / "a.dng").exists()
