"""One capture with one fault planted: what became of it, and what `--resume` made of the rest.

A trial raises AssertionError where a promise is broken: an exit within its time, no frame lost, no wrong angle, a
finished capture equal to an undisturbed one.
"""

import contextlib
import os
import random
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import msgspec

from polcap.errors import HardwareError, PolcapError, StorageError
from polcap.formats.raw.file_bytes import digest
from polcap.rig import capture_record, sequence, serial_port
from polcap.rig.shooting_plan import CaptureOrder
from tests.conftest import ROOT
from tests.rig import pool as pools
from tests.rig import virtual
from tests.rig.devices import Elliptec, Grbl, Line
from tests.rig.far_end import ALWAYS, SPOKEN, Device
from tests.rig.pool import Key, PoolCamera

QUICK = "settle=0.01&timeout=20"
LIMIT_S = 120.0  # of the rig's clock, in which every run has to end: retries of 20 s
_KILLED_S = 300.0  # in which a killed process has ended, on a very busy machine
_START_S = 300.0  # in which a process of its own has begun
ROTATOR_FAULTS = (
    "no-answer", "garbage", "half-line", "busy", "mechanical-timeout", "wrong-position", "unplug", "late",
)  # fmt: skip
CLASSES = (*ROTATOR_FAULTS, *pools.CAMERA_FAULTS, "ctrl-c-anywhere", "kill-anywhere")
KINDS: tuple[type[Device], ...] = (Elliptec, Line, Grbl)
_FRAMES = 15  # of pools.ORDER


class Outcome(NamedTuple):
    fault: str
    seed: int
    rotator: str
    first: str  # how the disturbed run ended
    kept: int  # good frames before the resume
    taken: int  # frames that the resume took
    seconds: float  # of the disturbed run, by the rig's clock; 0 for a killed process


def trial(fault: str, seed: int, pool: dict[Key, bytes], folder: Path) -> Outcome:
    """Shoot with `fault` at a random moment, resume with sound devices, and judge."""
    chance = random.Random(f"{fault} {seed}")
    delivered: list[tuple[Key, str]] = []
    if fault in ("kill", "kill-anywhere", "ctrl-c-anywhere"):
        kind: type[Device] = Elliptec
        first, seconds = _killed(fault, chance, pool, folder), 0.0
    else:
        kind = chance.choice([kind for kind in KINDS if fault not in ROTATOR_FAULTS or fault in (*kind.FAULTS, "late")])
        with virtual.time() as clock:
            start = clock.monotonic()
            first, delivered = _disturbed(fault, kind, chance, pool, folder)
            seconds = clock.monotonic() - start
    assert seconds < LIMIT_S, f"{fault} {seed} took {seconds:.1f} s"
    kept = _kept(folder)
    lost = {key for key, data in delivered if data not in _on_disk(folder)}
    assert not lost or fault == "disk-full", f"lost {lost}"

    with virtual.time(), kind() as device:
        camera = PoolCamera(pool, lambda: device.angle_deg)
        _shoot(device, camera, folder, resume=True)
    assert len(camera.delivered) == _FRAMES - len(kept), "took what was there"
    _judge(folder, pool)
    assert all(_kept(folder)[name] == data for name, data in kept.items()), "a good frame was replaced"
    if fault in ("corrupt", "stale"):
        assert first == "finished" and _content(folder).rejected, "a bad frame went unnoticed"
    return Outcome(fault, seed, kind.__name__, first, len(kept), len(camera.delivered), seconds)


def undisturbed(kind: type[Device], pool: dict[Key, bytes], folder: Path) -> None:
    with virtual.time(), kind() as device:
        _shoot(device, PoolCamera(pool, lambda: device.angle_deg), folder)
    _judge(folder, pool)


def _order(device: Device) -> CaptureOrder:
    return msgspec.structs.replace(pools.ORDER, rotator=f"{type(device).__name__.lower()}:{device.port}?{QUICK}")


def _shoot(device: Device, camera: PoolCamera, folder: Path, resume: bool = False) -> None:
    with mock.patch("polcap.rig.device_urls.open_camera", lambda name, log: camera):
        sequence.shoot(folder, _order(device), resume=resume)


def _disturbed(
    fault: str, kind: type[Device], chance: random.Random, pool: dict[Key, bytes], folder: Path
) -> tuple[str, list[tuple[Key, str]]]:
    """In this process."""
    planted: dict[str, Any] = {}
    if fault in ROTATOR_FAULTS:
        most = 12 if fault in (*SPOKEN, "late") else 4
        least = 2 if fault == "wrong-position" else 1  # a zero that is off shows in no position read back
        planted = {"fault": fault, "at": chance.randint(least, most), "times": chance.choice((1, ALWAYS))}
    with kind(**planted) as device:
        own = fault if fault in pools.CAMERA_FAULTS else ""
        camera = PoolCamera(pool, lambda: device.angle_deg, own, chance.randint(1, _FRAMES))
        try:
            _shoot(device, camera, folder)
            first = "finished"
        except (HardwareError, StorageError) as error:
            assert "\n" not in str(error)
            first = f"exit {error.exit_code}"
        except PolcapError as error:
            raise AssertionError(f"{fault}: {error}") from error
        except KeyboardInterrupt:
            first = "exit 130"
        assert camera.closed
        assert not device.moving or fault in ("busy", "unplug"), "the motor turns on"
    return first, camera.delivered


def _killed(fault: str, chance: random.Random, pool: dict[Key, bytes], folder: Path) -> str:
    """In a process of its own, by a signal; how it ended."""
    file = folder.with_suffix(".pool")
    pools.saved(pool, file)
    with Elliptec(speed_deg_s=150.0, real=True) as device:
        planted = [str(chance.randint(1, _FRAMES))] if fault == "kill" else []
        command = [sys.executable, "-m", "tests.rig.faults", str(folder), device.port, str(file), *planted]
        child = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE)
        end = time.monotonic() + _START_S
        while not (folder / capture_record.LOG).exists() and child.poll() is None and time.monotonic() < end:
            time.sleep(0.005)
        if not planted:
            time.sleep(chance.uniform(0.0, 2.5))
            with contextlib.suppress(ProcessLookupError):
                child.send_signal(signal.SIGKILL if fault == "kill-anywhere" else signal.SIGINT)
        try:
            _, said = child.communicate(timeout=_KILLED_S)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"{fault}: the process does not end") from None
        finally:
            child.kill()
            file.unlink()
    told = said.decode()
    assert "Traceback" not in told or "KeyboardInterrupt" in told, told
    return "finished" if child.returncode == 0 else f"signal {abs(child.returncode)}"


def _kept(folder: Path) -> dict[str, str]:
    """Files that capture.toml names, every one whole, and their digests."""
    file = folder / "capture.toml"
    if not file.exists():
        return {}
    stated = tomllib.loads(file.read_text())
    content = _content(folder)
    kept = {}
    recorded = {good.file: good.facts.digest for good in content.frames.values()}
    for entry in stated["frame"]:
        data = digest((folder / entry["file"]).read_bytes())
        assert recorded[entry["file"]] == data
        kept[entry["file"]] = data
    for good in content.frames.values():  # of which capture.toml may lack the last
        if good.file not in kept:
            kept[good.file] = digest((folder / good.file).read_bytes())
    return kept


def _content(folder: Path) -> capture_record.RigFile:
    content = capture_record.load(folder)
    assert content is not None
    return content


def _on_disk(folder: Path) -> set[str]:
    return {digest(file.read_bytes()) for file in folder.rglob("*.*") if file.is_file()}


def _judge(folder: Path, pool: dict[Key, bytes]) -> None:
    """The capture has every frame of `ORDER`, each what the camera saw at that angle."""
    content = _content(folder)
    assert len(content.frames) == _FRAMES
    stated = {entry["file"]: entry for entry in tomllib.loads((folder / "capture.toml").read_text())["frame"]}
    assert len(stated) == _FRAMES
    for good in content.frames.values():
        assert good.angle_deg is not None and good.read_deg is not None
        assert abs(good.read_deg - good.angle_deg) < 0.06
        assert abs(stated[good.file]["angle"] - good.angle_deg) < 0.06
        assert digest((folder / good.file).read_bytes()) == digest(pool[good.role, good.angle_deg, good.step])


def main() -> None:
    """The child: FOLDER PORT POOL [frame at which to die]."""
    folder, port, file, *at = sys.argv[1:]
    camera = PoolCamera(pools.loaded(Path(file)), fault="kill" if at else "", at=int(at[0]) if at else 1)
    order = msgspec.structs.replace(pools.ORDER, rotator=f"elliptec:{port}?{QUICK}")
    serial_port.ANSWER_S = 20.0  # the device is a thread of another process, which a busy machine may let wait
    with mock.patch("polcap.rig.device_urls.open_camera", lambda name, log: camera):
        sequence.shoot(Path(folder), order)


if __name__ == "__main__":
    main()
