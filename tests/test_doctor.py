"""`polcap doctor` finds defects; only those that stop `polcap process` are faults."""

import json
import shutil
from pathlib import Path
from typing import NoReturn

import pytest

from polcap import doctor
from polcap.doctor import Finding, Rig
from polcap.errors import DecodeError, HardwareError, ModelError, SettingError
from polcap.formats import onnx
from polcap.formats.raw import libraw as raw
from tests.conftest import Command


def raising(error: Exception) -> NoReturn:
    raise error


NO_RIG = Rig(ports=list, may_write=lambda ports: True, probe=lambda url: None, cameras=list)


def named(found: tuple[Finding, ...]) -> dict[str, Finding]:
    return {one.name: one for one in found}


def test_this_machine_can_process(tmp_path: Path) -> None:
    found = named(doctor.examine(NO_RIG, tmp_path))
    assert {found[name].state for name in ("polcap", "LibRaw", "model", "on CPU")} == {"ok"}
    assert doctor.to_json(tuple(found.values()))["process_works"] is True
    assert not any(tmp_path.iterdir())


def test_ports_and_cameras_are_listed_with_their_answers(tmp_path: Path) -> None:
    answers = {"/dev/ttyUSB0": "Elliptec ELL14", "/dev/ttyUSB1": None}

    def probe(url: str) -> str | None:
        if url == "/dev/ttyACM0":
            raise HardwareError("port /dev/ttyACM0: permission denied")
        return answers[url]

    def ports() -> list[tuple[str, str]]:
        return [(device, "FT230X") for device in (*answers, "/dev/ttyACM0")]

    found = named(
        doctor.examine(Rig(ports, lambda ports: True, probe, lambda: [("Nikon Z6", "usb:001,004")]), tmp_path)
    )
    assert found["/dev/ttyUSB0"] == Finding("/dev/ttyUSB0", "ok", "FT230X: Elliptec ELL14")
    assert found["/dev/ttyUSB1"].state == found["/dev/ttyACM0"].state == "warning"
    assert "dialout" in found["/dev/ttyACM0"].remedy
    assert found["camera"].message == "Nikon Z6 at usb:001,004"


def test_no_port_is_written_to_without_leave(tmp_path: Path) -> None:
    rig = Rig(lambda: [("/dev/ttyS0", "a CNC mill")], lambda ports: False, lambda url: pytest.fail("written"), list)
    found = named(doctor.examine(rig, tmp_path))["/dev/ttyS0"]
    assert found == Finding(
        "/dev/ttyS0", "ok", "a CNC mill: not asked", "`polcap doctor --ports` asks, and writes to it"
    )


def test_a_missing_rig_is_no_fault(tmp_path: Path) -> None:
    def cameras() -> list[tuple[str, str]]:
        raise SettingError("gphoto2 is not installed; pip install 'polcap[rig]'")

    found = named(doctor.examine(Rig(list, lambda ports: True, lambda url: None, cameras), tmp_path))
    assert found["serial ports"].state == found["cameras"].state == "warning"
    assert found["cameras"].remedy == "pip install 'polcap[rig]'"


def test_broken_decoder_model_and_provider_are_faults(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(raw, "version", lambda: raising(DecodeError("the decoder crashed")))
    monkeypatch.setattr(onnx, "load", lambda *_, **options: raising(ModelError("model.onnx is cut short")))
    monkeypatch.setattr(onnx, "providers", lambda file: {onnx.CUDA: "does not start", onnx.CPU: "illegal instruction"})
    found = named(doctor.examine(NO_RIG, tmp_path))
    assert {name for name, one in found.items() if one.state == "fault"} == {"LibRaw", "model", "on CPU"}
    assert found["on CUDA"].state == "warning"
    assert all(one.remedy for one in found.values() if one.state != "ok")


def test_full_disk_is_a_fault_and_a_nearly_full_one_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Usage:
        free = 5e8

    monkeypatch.setattr(shutil, "disk_usage", lambda folder: Usage)
    assert named(doctor.examine(NO_RIG, tmp_path))["disk"].state == "fault"
    Usage.free = 5e9
    assert named(doctor.examine(NO_RIG, tmp_path))["disk"].state == "warning"


def test_command_prints_one_document_and_ends_with_2_on_a_fault(
    polcap: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    from polcap.rig import camera_gphoto2, serial_port

    monkeypatch.setattr(serial_port, "serial_ports", list)
    monkeypatch.setattr(camera_gphoto2, "connected_cameras", list)
    done = polcap("doctor", "--json")
    about = json.loads(done.stdout)
    assert done.returncode == 0 and about["process_works"]
    monkeypatch.setattr(raw, "version", lambda: raising(DecodeError("the decoder crashed")))
    done = polcap("doctor")
    assert done.returncode == 2
    assert "fault    LibRaw" in done.stdout
