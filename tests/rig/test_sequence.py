"""The sequence of a capture: order of the frames, retakes, and resuming."""

import json
import re
import shutil
import signal
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from polcap.capture_values import Role
from polcap.errors import CaptureError, HardwareError, SettingError, StorageError
from polcap.formats.capture import reader as captures
from polcap.formats.raw import file_bytes
from polcap.rig import capture_record, sequence
from polcap.rig.camera import CameraFile
from polcap.rig.exposure_bracket import Exposure
from polcap.rig.resume import complete_order
from polcap.rig.shooting_plan import CaptureOrder
from tests.rig import pool as pools
from tests.rig.pool import BRACKET, Key, PoolCamera
from tests.rig.test_retake_criteria import blur

ORDER = msgspec.structs.replace(pools.ORDER, rotator="simulated")


class Turner:
    """A rotator that moves at once, to an angle that is wrong by `error_deg`."""

    model, speed_deg_s, settle_s, by_hand, closed = "turner", 100.0, 0.0, False, False

    def __init__(self, error_deg: float = 0.0) -> None:
        self.error_deg = error_deg
        self.moves: list[float] = []

    def home(self) -> None: ...

    def move(self, angle_deg: float) -> float:
        self.moves.append(angle_deg)
        return (angle_deg + self.error_deg) % 360

    def close(self) -> None:
        self.closed = True


class Rig:
    """The two devices, and the sequence on them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, pool: dict[Key, bytes], folder: Path) -> None:
        self.pool, self.folder = pool, folder
        self.camera, self.turner = PoolCamera(pool), Turner()
        self.messages: list[str] = []
        monkeypatch.setattr("polcap.rig.device_urls.open_camera", lambda name, log: self.camera)
        monkeypatch.setattr("polcap.rig.device_urls.open_rotator", lambda url, log: self.turner)

    def shoot(self, order: CaptureOrder = ORDER, resume: bool = False, **options: int) -> dict[str, Any]:
        return sequence.shoot(self.folder, order, resume=resume, report=self.messages.append, **options)

    def stop_at(self, frame: int = 9) -> None:
        """Begin the capture; the camera fails at a frame."""
        self.camera = PoolCamera(self.pool, fault="disconnect", at=frame)
        with pytest.raises(HardwareError, match="--resume continues"):
            self.shoot()

    def again(self, error_deg: float = 0.0) -> dict[str, Any]:
        self.camera, self.turner = PoolCamera(self.pool), Turner(error_deg)
        return self.shoot(resume=True)

    @property
    def taken(self) -> list[Key]:
        return [key for key, _ in self.camera.delivered]


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch, pool: dict[Key, bytes], tmp_path: Path) -> Rig:
    return Rig(monkeypatch, pool, tmp_path / "capture")


def test_every_angle_is_visited_once_and_the_capture_reads_as_ordered(rig: Rig) -> None:
    rig.turner.error_deg = -0.01
    done = rig.shoot()
    assert rig.turner.moves == [0.0, 45.0, 90.0] and rig.turner.closed and rig.camera.closed
    understood = captures.read(rig.folder)
    assert [shot.name for shot in understood.shots] == ["-0.01°", "44.99°", "89.99°", "44.99°"]
    assert [(len(shot.frames), len(shot.ambient)) for shot in understood.shots] == [(3, 1)] * 4
    assert done["frames"] == 15 and done["rejected"] == []
    assert done["angles"][1] == {"asked_deg": 45.0, "read_deg": 44.99, "stated_deg": 44.99}
    assert (rig.folder / "preview.png").exists()
    stated = tomllib.loads((rig.folder / "capture.toml").read_text())
    assert stated["rotator"] == {"model": "turner", "log": "rig.log"}


def test_a_bad_frame_is_moved_to_rejected_and_taken_again_before_a_person_turns_the_ring(rig: Rig) -> None:
    rig.camera, rig.turner.by_hand = PoolCamera(rig.pool, fault="corrupt", at=4), True  # the last at 0°
    done = rig.shoot()
    assert rig.turner.moves == [0.0, 45.0, 90.0] and len(rig.taken) == 16 and done["frames"] == 15
    (bad,) = done["rejected"]
    assert bad["slot"] == "ambient/pol000" and (rig.folder / bad["file"]).stat().st_size > 0


def test_a_person_is_asked_for_everything_that_no_device_can_do(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    class Plain(PoolCamera):
        switches_flash = polarizes_flash = False

        def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
            if angle_deg is None:
                self._key = ("shot", 135.0, 1) if role == "chart" else ("ambient", 0.0, 2)
            else:
                super().prepare(angle_deg, role, step)

    rig.camera = Plain(rig.pool)
    order = msgspec.structs.replace(ORDER, chart=True)
    with pytest.raises(SettingError, match="a person at a terminal is needed"):
        rig.shoot(order)
    assert rig.taken == [] and [path.name for path in rig.folder.iterdir() if not path.name.startswith(".")] == []
    asked: list[str] = []
    monkeypatch.setattr("polcap.rig.person.ask", lambda question, log: asked.append(question.partition(",")[0]))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    rig.shoot(order)
    flash = ["switch the flash off", "switch the flash on again"]
    assert asked == ["put the chart in the place of the object", "remove the chart", *flash]
    understood = captures.read(rig.folder)
    assert len(understood.chart_frames) == 1 and {len(shot.ambient) for shot in understood.shots} == {1}


class Faulty(PoolCamera):
    """Returns another photograph for one slot, always or `times` times, and may report another exposure."""

    def __init__(
        self, pool: dict[Key, bytes], slot: Key, other: bytes, times: int = 99, exposure: Exposure | None = None
    ) -> None:
        super().__init__(pool)
        self.slot, self.other, self.times, self.exposure = slot, other, times, exposure

    def shoot(self, exposure: Exposure, flash: bool) -> CameraFile:
        shot = super().shoot(exposure, flash)
        if self._key != self.slot or self.times == 0:
            return shot
        self.times -= 1
        return CameraFile(self.other, shot.name, self.exposure or exposure)


def test_a_frame_that_stays_bad_ends_the_run_with_its_reason(rig: Rig) -> None:
    rig.camera = Faulty(rig.pool, ("shot", 45.0, 2), rig.pool["shot", 135.0, 1])  # underexposed
    words = r"pol045/frame_3: rejected 1 time; last reason: .*exposure time.*; the frames so far are saved"
    with pytest.raises(CaptureError, match=words):
        rig.shoot(tries=0)
    assert rig.turner.closed
    rig.again()
    assert ("shot", 45.0, 2) in rig.taken


def test_an_early_frame_is_judged_by_its_later_neighbors(rig: Rig, tmp_path: Path) -> None:
    (tmp_path / "sharp.dng").write_bytes(rig.pool["shot", 0.0, 1])
    blur(tmp_path / "sharp.dng", tmp_path / "blurred.dng", 2.0)
    rig.camera = Faulty(rig.pool, ("shot", 0.0, 1), (tmp_path / "blurred.dng").read_bytes(), times=1)
    done = rig.shoot(msgspec.structs.replace(ORDER, repeat_deg=(), ambient=False))
    (bad,) = done["rejected"]
    assert bad["slot"] == "pol000/frame_2" and "less sharp" in bad["reason"]
    assert rig.taken.count(("shot", 0.0, 1)) == 2 and rig.turner.moves.count(0.0) == 2


def test_dials_that_set_two_frames_to_one_exposure_end_the_run(rig: Rig) -> None:
    rig.camera = Faulty(rig.pool, ("shot", 0.0, 2), rig.pool["shot", 0.0, 1], exposure=BRACKET[1])
    with pytest.raises(SettingError, match="give exposures that differ more"):
        rig.shoot()


def test_resume_takes_only_missing_frames(rig: Rig) -> None:
    rig.stop_at(9)
    assert len(tomllib.loads((rig.folder / "capture.toml").read_text())["frame"]) == 8
    rig.again()
    assert len(rig.taken) == 7
    rig.again()
    assert rig.taken == [] and rig.turner.moves == []


@pytest.mark.parametrize("frame", [2, 7, 12])
def test_an_interrupted_capture_names_resume(rig: Rig, frame: int) -> None:
    """Within the first bracket, within another, and after three complete angles of four."""
    rig.stop_at(frame)
    words = rf"polcap capture {re.escape(str(rig.folder))} --resume. takes the \d+ missing frames"
    try:
        notes = "; ".join(captures.read(rig.folder).notes)
    except CaptureError as error:
        notes = str(error)
    assert re.search(words, notes), notes
    rig.again()
    assert "--resume" not in "; ".join(captures.read(rig.folder).notes)


def test_resume_keeps_what_a_person_added_to_capture_toml(rig: Rig) -> None:
    rig.shoot()
    file = rig.folder / "capture.toml"
    file.write_text(f'name = "vase"\n{file.read_text()}\n[catalog]\ncreator = "A. Person"\n')
    (rig.folder / "pol045" / "frame_2.dng").unlink()
    rig.shoot(resume=True)
    stated = tomllib.loads(file.read_text())
    assert stated["name"] == "vase" and stated["catalog"] == {"creator": "A. Person"} and len(stated["frame"]) == 15


def test_resume_rejects_changed_and_unchecked_files_and_takes_them_again(rig: Rig) -> None:
    rig.stop_at()
    (rig.folder / "pol000/frame_2.dng").write_bytes(b"overwritten")
    (rig.folder / "pol000/frame_3.dng").unlink()
    unchecked = b"saved, not checked"
    (rig.folder / "pol090").mkdir(exist_ok=True)
    (rig.folder / "pol090/frame_3.dng").write_bytes(unchecked)
    record = json.loads((rig.folder / "rig.json").read_text())
    record["unchecked"] = {"pol090/frame_3.dng": file_bytes.digest(unchecked)}
    (rig.folder / "rig.json").write_text(json.dumps(record))
    (rig.folder / "pol090/.frame_1.7-0123abcd.part.dng").write_bytes(b"half")
    rig.again()
    assert {("shot", 0.0, 1), ("shot", 0.0, 2), ("shot", 90.0, 2)} <= set(rig.taken)
    assert (rig.folder / "rejected/pol000_frame_2.try1.dng").read_bytes() == b"overwritten"
    assert (rig.folder / "rejected/pol090_frame_3.try1.dng").read_bytes() == unchecked
    assert any("frame_3.dng: the file is missing" in line for line in rig.messages)
    assert not list(rig.folder.rglob(".*.part*"))


def test_files_of_others_beside_the_frames_stay(rig: Rig) -> None:
    rig.stop_at()
    sidecar, foreign = rig.folder / "pol000/frame_1.xmp", rig.folder / "pol090/frame_3.dng"
    foreign.parent.mkdir(exist_ok=True)
    for file in (sidecar, foreign):
        file.write_bytes(b"of the photographer")
    with pytest.raises(StorageError, match=r"frame_3.dng: polcap did not write the file that is there; move it away"):
        rig.again()
    assert sidecar.read_bytes() == foreign.read_bytes() == b"of the photographer"
    foreign.unlink()
    rig.again()
    assert sidecar.exists() and len(json.loads((rig.folder / "rig.json").read_text())["frames"]) == 15


def test_a_bracket_has_one_angle_even_if_the_ring_returns_to_another(rig: Rig) -> None:
    rig.stop_at(7)  # in the middle of 45°
    rig.again(error_deg=0.25)
    content = capture_record.load(rig.folder)
    assert content is not None
    for angle in (45.0, 90.0):
        read = {good.read_deg for good in content.frames.values() if good.angle_deg == angle and good.role == "shot"}
        assert read == {angle + 0.25}
    assert all("came back" in bad.reason for bad in content.rejected) and len(content.rejected) > 0


def test_resume_takes_the_options_of_the_begun_capture(rig: Rig) -> None:
    rig.stop_at()
    assert complete_order(rig.folder, {"angles_deg": None, "camera": None}, resume=True) == ORDER
    changes = {"angles_deg": (0.0, 60.0, 120.0), "bracket": BRACKET[:2], "chart": True, "rotator": "simulated?offset=3"}
    for name, value in changes.items():
        option = name.removesuffix("_deg")
        with pytest.raises(CaptureError, match=f"begun with another --{option}; leave it out"):
            complete_order(rig.folder, {name: value}, resume=True)
    with pytest.raises(SettingError, match="--rotator is missing"):
        complete_order(rig.folder, {"camera": "simulated"}, resume=False)
    with pytest.raises(SettingError, match="nothing to resume"):
        complete_order(rig.folder / "other", {}, resume=True)
    with pytest.raises(CaptureError, match="continue with --resume"):
        rig.shoot()


def test_the_port_may_be_another_after_the_cable_was_plugged_in_again(rig: Rig) -> None:
    old, new = (f"elliptec:/dev/ttyUSB{n}?settle=1" for n in (0, 1))
    rig.camera = PoolCamera(rig.pool, fault="disconnect", at=4)
    with pytest.raises(HardwareError):
        rig.shoot(msgspec.structs.replace(ORDER, rotator=old))
    order = complete_order(rig.folder, {"rotator": new}, resume=True)
    assert order.rotator == new
    rig.shoot(order, resume=True)


def test_a_folder_with_other_files_or_of_another_run_is_refused(rig: Rig) -> None:
    rig.folder.mkdir()
    with sequence._locked(rig.folder), pytest.raises(StorageError, match="another polcap"):
        rig.shoot()
    (rig.folder / "holiday.jpg").write_text("mine")
    with pytest.raises(CaptureError, match=r"is not empty \(holiday.jpg\)"):
        rig.shoot()
    assert [file.name for file in rig.folder.iterdir() if file.name != ".lock"] == ["holiday.jpg"]


def test_a_small_disk_is_an_error_before_the_first_frame(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=10**6))
    with pytest.raises(StorageError, match="1 MB are free, and the frames need about 2 MB"):
        rig.shoot()
    assert rig.taken == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_the_motor_and_saves_the_frames(rig: Rig, number: int) -> None:
    class Ended(PoolCamera):
        def prepare(self, angle_deg: float | None, role: Role, step: int) -> None:
            super().prepare(angle_deg, role, step)
            if len(self.delivered) == 4:
                signal.raise_signal(number)

    rig.camera = Ended(rig.pool)
    with pytest.raises(KeyboardInterrupt):
        rig.shoot()
    assert rig.turner.closed and rig.camera.closed
    assert len(tomllib.loads((rig.folder / "capture.toml").read_text())["frame"]) == 4
