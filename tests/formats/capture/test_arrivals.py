"""A folder that is being filled is reported when its files stop changing, not before."""

from functools import partial
from pathlib import Path

import pytest

from polcap.formats.capture import arrivals
from tests.clocks import SleepClock


@pytest.fixture(autouse=True)
def clock(monkeypatch: pytest.MonkeyPatch) -> SleepClock:
    clock = SleepClock()
    monkeypatch.setattr(arrivals, "time", clock)
    return clock


def test_a_folder_is_reported_when_its_changes_have_ended(
    tmp_path: Path, clock: SleepClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tmp_path / "polcap"
    made.mkdir()
    monkeypatch.chdir(tmp_path)
    moments = arrivals.settled(Path(), made, still_s=0.6)  # the same folder by two names
    next(moments)  # as it is

    (made / "map.exr").write_bytes(b"not looked at")
    (tmp_path / ".hidden").write_bytes(b"nor this")
    written: list[float] = []

    def arrive() -> None:
        if clock.now > 1.0 and len(written) < 4:  # a file that grows
            with (tmp_path / "a.dng").open("ab") as file:
                file.write(bytes(100))
            written.append(clock.now)

    clock.meanwhile = arrive
    next(moments)
    assert len(written) == 4 and clock.now - written[-1] >= 0.6


def test_a_removed_file_is_reported(tmp_path: Path, clock: SleepClock) -> None:
    (tmp_path / "a.dng").write_bytes(b"a")
    moments = arrivals.settled(tmp_path, tmp_path / "polcap", still_s=0.0)
    next(moments)
    clock.meanwhile = partial((tmp_path / "a.dng").unlink, missing_ok=True)
    next(moments)
    assert not (tmp_path / "a.dng").exists()


def test_an_edit_is_reported_at_once_unless_photographs_arrive(tmp_path: Path, clock: SleepClock) -> None:
    folder, settings = tmp_path / "capture", tmp_path / "settings.toml"
    folder.mkdir()
    moments = arrivals.settled(folder, folder / "polcap", still_s=2.0, edited=[settings])
    next(moments)
    settings.write_text("[asset]")
    next(moments)
    assert clock.now < 1.0
    begun = clock.now

    def both() -> None:
        if clock.now < begun + 1.5:
            with (folder / "a.dng").open("ab") as file:
                file.write(bytes(100))
            settings.write_text(f"# {clock.now:.1f}")

    clock.meanwhile = both
    next(moments)
    assert clock.now >= begun + 3.3
