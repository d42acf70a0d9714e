"""`polcap capture` as a user's shell runs it."""

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import msgspec
import pytest

from polcap.capture_values import Role
from polcap.formats.capture import capture_toml
from polcap.formats.capture import reader as captures
from polcap.rig import camera_gphoto2
from tests.conftest import ROOT, Command
from tests.rig import virtual
from tests.rig.devices import Elliptec
from tests.rig.pool import Key, virtual_gphoto2

SIMULATED = ("--rotator", "simulated?settle=0", "--camera", "simulated?width=96&height=72&samples=1", "--no-check")


def test_a_simulated_capture_is_shot_and_read(polcap: Command, tmp_path: Path) -> None:
    folder = tmp_path / "c"
    done = polcap("capture", folder, *SIMULATED, "--ambient", "--repeat", "45", "--cross")
    assert done.returncode == 0 and done.stdout == f"{folder}\n", done.stderr
    assert "pol045/frame_2" in done.stderr and "left" in done.stderr
    understood = captures.read(folder)
    assert [shot.name for shot in understood.shots] == ["0°", "45°", "90°", "45°"]
    assert {len(shot.ambient) for shot in understood.shots} == {1}
    assert understood.crossed is not None and len(understood.crossed.frames) == 3
    log = (folder / "rig.log").read_text()
    assert "rotator > go 45.000" in log and "camera > 1/200s f/11 iso100, lit" in log and "dark" in log
    again = polcap("capture", folder, *SIMULATED)
    assert again.returncode == 2 and "--resume" in again.stderr and again.stderr.count("\n") == 1
    resumed = json.loads(polcap("capture", folder, "--resume", "--json").stdout)
    assert resumed["taken"] == 0 and resumed["frames"] == 18 and len(resumed["angles"]) == 3


@pytest.mark.parametrize("verdict", ["keep", "reshoot"])
def test_the_verdict_ends_a_capture(
    polcap: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdict: str
) -> None:
    monkeypatch.setattr("polcap.pipeline.check.inspect", lambda found, *_: found.shots[2].name)
    monkeypatch.setattr("polcap.pipeline.check.table", lambda judged: f"{verdict} {judged}")
    monkeypatch.setattr("polcap.pipeline.check.to_json", lambda judged: {"verdict": verdict})
    done = polcap("capture", tmp_path / "c", *SIMULATED[:4], "--json")
    assert done.returncode == (0 if verdict == "keep" else 3)
    assert json.loads(done.stdout)["check"] == {"verdict": verdict} and f"{verdict} 90°" in done.stderr


def test_dry_run_prints_the_times_and_makes_nothing(polcap: Command, tmp_path: Path) -> None:
    options = ("--rotator", "elliptec:/dev/ttyUSB0", "--camera", "gphoto2", "--bracket", "1/200,1/50,1/13")
    done = polcap("capture", tmp_path / "c", *options, "--dry-run")
    assert done.returncode == 0 and "about a minute" in done.stdout and "turn to 45° and settle" in done.stdout
    plan = json.loads(polcap("capture", tmp_path / "c", *options, "--dry-run", "--json").stdout)
    assert plan["frames"] == 9 and plan["seconds"] == pytest.approx(sum(part["seconds"] for part in plan["parts"]))
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "--rotator is missing"),
        (("--rotator", "crank", "--camera", "simulated"), "crank"),
        (("--rotator", "simulated", "--camera", "webcam"), "--camera webcam"),
        ((*SIMULATED, "--angles", "0,90"), "fewer than 3"),
        ((*SIMULATED, "--bracket", "fast"), "--bracket: 'fast'"),
    ],
)
def test_wrong_flag_is_one_line_and_exit_2(
    polcap: Command, tmp_path: Path, options: tuple[str, ...], words: str
) -> None:
    for dry in ((), ("--dry-run",)):
        done = polcap("capture", tmp_path / "c", *options, *dry)
        assert done.returncode == 2 and words in done.stderr and done.stderr.count("\n") == 1, done.stderr


def test_a_missing_port_is_exit_4(polcap: Command, tmp_path: Path) -> None:
    done = polcap("capture", tmp_path / "c", "--rotator", "elliptec:/dev/ttyNONE", *SIMULATED[2:4])
    assert done.returncode == 4 and done.stderr.count("\n") == 1 and "/dev/ttyNONE" in done.stderr


def test_a_motor_on_a_port_and_a_camera_on_a_cable_make_a_capture(
    polcap: Command, tmp_path: Path, pool: dict[Key, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A simulated Elliptec and libgphoto2's virtual camera; the test supplies the camera's view."""
    virtual_gphoto2(monkeypatch, tmp_path)
    size = max(map(len, pool.values()))  # the virtual camera believes that its files keep their size

    def seen(angle: float, step: int) -> bytes:
        return pool["shot", angle, step].ljust(size, b"\0")

    def prepare(self: object, angle_deg: float | None, role: Role, step: int) -> None:
        assert angle_deg is not None and abs(device.angle_deg - angle_deg) < 0.05
        (tmp_path / "x.jpg").write_bytes(seen(angle_deg, step))

    (tmp_path / "x.jpg").write_bytes(bytes(size))
    monkeypatch.setattr(camera_gphoto2.Gphoto2Camera, "prepare", prepare)
    folder = tmp_path / "capture"
    with virtual.time(), Elliptec() as device:
        options = ("--camera", "gphoto2", "--bracket", "1/200,1/50,1/13", "--no-check")
        done = polcap("capture", folder, "--rotator", f"elliptec:{device.port}?settle=0", *options)
        assert done.returncode == 0, done.stderr
        assert not device.moving and "0ma" in " ".join(device.heard)
    understood = captures.read(folder)
    assert understood.notes[0].startswith("rotator Elliptec ELL14")
    for shot, asked in zip(understood.shots, (0.0, 45.0, 90.0), strict=True):
        for step, frame in enumerate(shot.frames):
            assert Path(frame.path).suffix == ".dng"
            assert Path(frame.path).read_bytes() == seen(asked, step)
    stated = [entry["angle"] for entry in tomllib.loads((folder / "capture.toml").read_text())["frame"]]
    assert 0 < abs(stated[3] - 45) < 0.05  # as read back
    log = (folder / "rig.log").read_text()
    assert "rotator > 0ma" in log and "camera > shutterspeed = 0.0050s" in log


def keys_of(table: type[msgspec.Struct]) -> Iterator[str]:
    """Keys of a TOML table and of the tables in it."""
    for field in msgspec.structs.fields(table):
        inner = [one for one in (field.type, *get_args(field.type)) if msgspec.inspect.is_struct_type(one)]
        yield from keys_of(inner[0]) if inner else [field.name]


def test_the_template_and_the_card_for_shooting_by_hand_are_understood(tmp_path: Path) -> None:
    template = ROOT / "examples" / "capture.toml"
    (tmp_path / "capture.toml").write_bytes(template.read_bytes())
    (tmp_path / "angles.txt").write_text("as read off the ring")
    stated = capture_toml.load(tmp_path)
    roles = [entry.role for entry in stated.frame]
    assert {"shot", "repeat", "ambient", "chart"} == set(roles)
    assert {entry.angle for entry in stated.frame if entry.role == "shot"} == {0.0, 45.0, 90.0}
    keys = {line.lstrip("# ").partition(" ")[0] for line in template.read_text().splitlines() if " = " in line}
    missing = set(keys_of(capture_toml.CaptureFile)) - keys
    assert not missing, f"add a line for {', '.join(missing)} to examples/capture.toml"
    card = (ROOT / "examples" / "shooting-card.html").read_text()
    assert all(folder in card for folder in ("pol000", "pol045", "pol090"))
