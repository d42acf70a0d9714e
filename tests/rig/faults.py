"""One capture with one planted fault, then `--resume`.

A trial raises AssertionError if a promise is broken: the run ends in time, no frame is lost, no angle is wrong, and the
resumed capture equals an undisturbed one.
"""

import os
import pickle
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

from polcap.errors import HardwareError, StorageError
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
LIMIT_S = 120.0  # of the rig's clock, for every run: retries of 20 s
_PROCESS_S = 300.0  # for a process to start, and for a killed one to end, on a very busy machine
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
    ending: str  # of the disturbed run
    accepted: int  # frames before the resume
    retaken: int  # frames that the resume took
    seconds: float  # of the disturbed run, by the rig's clock; 0 for a killed process


def trial(fault: str, seed: int, pool: dict[Key, bytes], folder: Path) -> Outcome:
    """Shoot with `fault` at a random moment, resume with sound devices, and check the capture."""
    random_ = random.Random(f"{fault} {seed}")
    delivered: list[tuple[Key, str]] = []
    if fault in ("kill", "kill-anywhere", "ctrl-c-anywhere"):
        kind: type[Device] = Elliptec
        ending, seconds = _killed(fault, random_, pool, folder), 0.0
    else:
        kinds = [kind for kind in KINDS if fault not in ROTATOR_FAULTS or fault in (*kind.FAULTS, "late")]
        kind = random_.choice(kinds)
        with virtual.time() as clock:
            start = clock.monotonic()
            ending, delivered = _disturbed(fault, kind, random_, pool, folder)
            seconds = clock.monotonic() - start
    assert seconds < LIMIT_S, f"{fault} {seed} took {seconds:.1f} s"
    accepted = _accepted(folder)
    on_disk = {digest(file.read_bytes()) for file in folder.rglob("*.*") if file.is_file()}
    lost = {key for key, data in delivered if data not in on_disk}
    assert not lost or fault == "disk-full", f"lost {lost}"

    with virtual.time(), kind() as device:
        camera = PoolCamera(pool, lambda: device.angle_deg)
        _shoot(device, camera, folder, resume=True)
    assert len(camera.delivered) == _FRAMES - len(accepted), "an accepted frame was taken again"
    _check(folder, pool)
    assert all(_accepted(folder)[name] == data for name, data in accepted.items()), "an accepted frame was replaced"
    if fault in ("corrupt", "stale"):
        assert ending == "finished" and _content(folder).rejected, "a bad frame was accepted"
    return Outcome(fault, seed, kind.__name__, ending, len(accepted), len(camera.delivered), seconds)


def undisturbed(kind: type[Device], pool: dict[Key, bytes], folder: Path) -> None:
    with virtual.time(), kind() as device:
        _shoot(device, PoolCamera(pool, lambda: device.angle_deg), folder)
    _check(folder, pool)


def _order(device: Device) -> CaptureOrder:
    return msgspec.structs.replace(pools.ORDER, rotator=f"{type(device).__name__.lower()}:{device.port}?{QUICK}")


def _shoot(device: Device, camera: PoolCamera, folder: Path, resume: bool = False) -> None:
    with mock.patch("polcap.rig.device_urls.open_camera", lambda name, log: camera):
        sequence.shoot(folder, _order(device), resume=resume)


def _disturbed(
    fault: str, kind: type[Device], random_: random.Random, pool: dict[Key, bytes], folder: Path
) -> tuple[str, list[tuple[Key, str]]]:
    """A run in this process: its ending, and the frames that the camera delivered."""
    planted: dict[str, Any] = {}
    if fault in ROTATOR_FAULTS:
        most = 12 if fault in (*SPOKEN, "late") else 4
        least = 2 if fault == "wrong-position" else 1  # a wrong zero shows in no position that is read back
        planted = {"fault": fault, "at": random_.randint(least, most), "times": random_.choice((1, ALWAYS))}
    with kind(**planted) as device:
        own = fault if fault in pools.CAMERA_FAULTS else ""
        camera = PoolCamera(pool, lambda: device.angle_deg, own, random_.randint(1, _FRAMES))
        try:
            _shoot(device, camera, folder)
            ending = "finished"
        except (HardwareError, StorageError) as error:
            assert "\n" not in str(error)
            ending = f"exit {error.exit_code}"
        except KeyboardInterrupt:
            ending = "exit 130"
        assert camera.closed
        assert not device.moving or fault in ("busy", "unplug"), "the motor still turns"
    return ending, camera.delivered


def _killed(fault: str, random_: random.Random, pool: dict[Key, bytes], folder: Path) -> str:
    """The ending of a run in a process that a signal ends."""
    file = folder.with_suffix(".pool")
    file.write_bytes(pickle.dumps(pool))
    with Elliptec(speed_deg_s=150.0, real=True) as device:
        at = [str(random_.randint(1, _FRAMES))] if fault == "kill" else []
        command = [sys.executable, "-m", "tests.rig.faults", str(folder), device.port, str(file), *at]
        child = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE)
        end = time.monotonic() + _PROCESS_S
        while not (folder / capture_record.LOG).exists() and child.poll() is None and time.monotonic() < end:
            time.sleep(0.005)
        if not at:
            time.sleep(random_.uniform(0.0, 2.5))
            child.send_signal(signal.SIGKILL if fault == "kill-anywhere" else signal.SIGINT)
        try:
            text = child.communicate(timeout=_PROCESS_S)[1].decode()
        finally:
            child.kill()
            file.unlink()
    assert "Traceback" not in text or "KeyboardInterrupt" in text, text
    return "finished" if child.returncode == 0 else f"signal {abs(child.returncode)}"


def _accepted(folder: Path) -> dict[str, str]:
    """Files of the accepted frames and their digests; capture.toml names no other."""
    if not (folder / "capture.toml").exists():
        return {}
    frames = {frame.file: digest((folder / frame.file).read_bytes()) for frame in _content(folder).frames.values()}
    for entry in _toml_frames(folder):
        assert entry["file"] in frames  # rig.json is written first
    for frame in _content(folder).frames.values():
        assert frames[frame.file] == frame.facts.digest
    return frames


def _content(folder: Path) -> capture_record.RigFile:
    content = capture_record.load(folder)
    assert content is not None
    return content


def _toml_frames(folder: Path) -> list[dict[str, Any]]:
    return tomllib.loads((folder / "capture.toml").read_text())["frame"]


def _check(folder: Path, pool: dict[Key, bytes]) -> None:
    """The capture has every frame of `ORDER`, each as the camera saw it at that angle."""
    frames = _content(folder).frames.values()
    stated = {entry["file"]: entry for entry in _toml_frames(folder)}
    assert len(frames) == len(stated) == _FRAMES
    for frame in frames:
        assert frame.angle_deg is not None and frame.read_deg is not None
        assert abs(frame.read_deg - frame.angle_deg) < 0.06
        assert abs(stated[frame.file]["angle"] - frame.angle_deg) < 0.06
        assert digest((folder / frame.file).read_bytes()) == digest(pool[frame.role, frame.angle_deg, frame.step])


if __name__ == "__main__":  # the process to kill: FOLDER PORT POOL [frame at which it kills itself]
    place, port, stored, *moment = sys.argv[1:]
    frames = pickle.loads(Path(stored).read_bytes())
    killed = PoolCamera(frames, fault="kill" if moment else "", at=int([*moment, "1"][0]))
    serial_port.ANSWER_S = 20.0  # the device is a thread of another process; a busy machine may delay it
    with mock.patch("polcap.rig.device_urls.open_camera", lambda name, log: killed):
        sequence.shoot(Path(place), msgspec.structs.replace(pools.ORDER, rotator=f"elliptec:{port}?{QUICK}"))
