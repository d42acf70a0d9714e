"""Mutated text, TOML, JSON, serial replies and headers, parsed by polcap in this process.

python -m tests.campaigns.fuzz_parsers [--runs 100000] [--seed 0] [--rows FILE]

A parser may return a value or raise one of its declared errors, within a second of processor time. Prints a table;
exit code 1 after a failure.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polcap import config, report
from polcap.calibration_values import (
    Calibration,
    Falloff,
    FlashEnergy,
    LensGeometry,
    Levels,
    Linearity,
    NoiseLine,
    Polarizer,
)
from polcap.capture_values import Exif
from polcap.chart_values import ColorCalibration, PatchColors
from polcap.errors import PolcapError
from polcap.formats import atomic, calibrations, color_profile, npy_folder, text_file
from polcap.formats.capture import capture_toml
from polcap.formats.maps import maps_folder as maps
from polcap.formats.raw import exif, file_checks, file_kind
from polcap.image_values import View
from polcap.rig import exposure_bracket, serial_port
from polcap.rig.device_log import Log
from polcap.rig.motor_elliptec_ell14 import ElliptecMotor, ElliptecSettings
from polcap.rig.motor_grbl import GrblMotor, GrblSettings
from polcap.rig.motor_line_protocol import LineMotor, LineSettings
from polcap.stage_values import StokesImage
from tests.campaigns.mutations import Target, campaign
from tests.experiments import Rows, arguments
from tests.formats import headers
from tests.rig import virtual

_BATCH = 500  # executions that make a row


class Replies(serial_port.Port):
    """A serial port with prepared answers."""

    def __init__(self, data: bytes) -> None:
        self.url, self.log, self._question = "fuzz://", Log(None), ""
        self._lines = [line for line in data.split(b"\n") if line.strip()]  # as Port, which skips empty lines

    def send(self, text: str, discard: bool = True) -> None: ...

    def read_line(self, limit_s: float | None = None) -> str:
        if not self._lines:
            virtual.CLOCK.sleep(max(serial_port.ANSWER_S if limit_s is None else limit_s, 0.001))
            raise serial_port.NoAnswer("fuzz:// answered with nothing")
        line = self._lines.pop(0).strip()
        if not all(32 <= byte < 127 or byte == 9 for byte in line):
            raise serial_port.NoAnswer("fuzz:// answered with no text")
        return line.decode("ascii")


def _motor(motor_class: Any, settings: Any) -> Callable[[bytes, Path], object]:
    def run(data: bytes, folder: Path) -> object:
        with virtual.time():
            motor = motor_class(Replies(data), settings)
            motor.home()
            return motor.position()

    return run


def _file(name: str, read: Callable[[Path], object]) -> Callable[[bytes, Path], object]:
    """A parser that reads the bytes from a file."""

    def run(data: bytes, folder: Path) -> object:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(data)
        return read(folder / name)

    return run


def _text(parse: Callable[[str], object]) -> Callable[[bytes, Path], object]:
    return lambda data, folder: parse(data.decode("utf-8", "surrogateescape"))


def _manifest(kind: type) -> Callable[[bytes, Path], object]:
    def run(data: bytes, folder: Path) -> object:
        for name, array in _ARRAYS.items():
            if not (folder / f"{name}.npy").exists():
                npy_folder.save(folder / f"{name}.npy", array)
        return npy_folder.decode(text_file.parse_json(data.decode("utf-8")), kind, folder)

    return run


def _calibration_file(file: Path) -> object:
    os.environ["POLCAP_CALIB"] = str(file.parent)
    return calibrations.choose(_EXIF, None, 60.0)


def _header(data: bytes, folder: Path) -> object:
    structure = file_kind.structure(data)
    file_checks.check_structure("fuzz", structure, data)
    (folder / "fuzz.dng").write_bytes(data)
    with (folder / "fuzz.dng").open("rb") as file:
        return file_kind.kind(file, ".dng"), structure.truncated, structure.dng


def _name(text: str) -> object:
    name = atomic.safe_name(text)
    assert name and len(name.encode()) <= 100 and name.isprintable() and not set(name) & set("/\\:"), name
    return name


_VALUES = {  # by the name that each has in its manifest
    "stokes": StokesImage(
        np.ones((3, 4, 4, 3), np.float32), np.ones((6, 4, 4, 3), np.float32), np.zeros((4, 4), np.uint8),
        np.ones((4, 4), bool), View(900.0, (1.0, 2.0), 2.0, (0.0, 0.0), True), None,
    ),
    "color": ColorCalibration(np.eye(3), "chart", metres_per_px=0.001, patches=PatchColors(np.ones(24))),
}  # fmt: skip
_ARRAYS: npy_folder.Arrays = {}
_MANIFEST = {name: json.dumps(npy_folder.encode(value, name, _ARRAYS)).encode() for name, value in _VALUES.items()}
_MAPS = {
    "crop": [0, 0, 64, 48], "size": [32, 24], "scale": 2, "estimator": "network 7", "depth": {"unit": "m"},
    "camera": {"focal_px": 900.0, "center_px": [15.5, 11.5], "focal_known": True},
}  # fmt: skip
_REPORT = {
    "polcap": "0.9.0", "verdict": "pass", "versions": {"polcap": "0.9.0"},
    "figures": {"maps": {"normal_error_deg_median": 5.0, "estimator": "network 9"}},
    "capture": {"name": "vase", "camera": "Acme Z1", "notes": [], "shots": [
        {"angle_deg": 0.0, "frames": [{"file": "pol000/a.dng", "digest": "0f"}]}
    ]},
    "settings": {"hdr": {"clip": 0.98}}, "keys": {"merge": "0f"}, "model": None,
    "gates": [{"name": "noise", "state": "pass", "value": 0.01, "limit": 0.04, "says": "little"}],
}  # fmt: skip
_TIFFS = (
    headers.dng(np.zeros((16, 16))),
    headers.tiff(headers.camera(), {headers.EXIF_IFD: headers.settings()}, magic=b"MM\0*", order=">"),
    headers.raf(headers.tiff(headers.camera(), {headers.EXIF_IFD: headers.settings()})),
    headers.cr3(headers.camera(), headers.settings()),
    headers.mrw(headers.tiff(headers.camera(), {headers.EXIF_IFD: headers.settings()})),
)
_GRBL = (
    b"Grbl 1.1h ['$' for help]\n$100=8.889\n$110=2000\n$120=50\n$130=400\n$22=1\nok\n"
    b"Grbl 1.1h ['$' for help]\nok\n<Idle|MPos:0.000,0,0|FS:0,0>\nok\n<Idle|MPos:1.000,0,0|FS:0,0>\nok\n"
)
_EXIF = Exif(make="Acme", model="Z1", lens="60", width=640, height=480)
_THREE = (0.1, 0.1, 0.1)
_CALIBRATION = calibrations.text(
    Calibration(
        "2024-05-01T12:00:00", "Acme Z1", "60", "ring",
        (
            NoiseLine(
                100.0, (1e-5,) * 3, (1e-7,) * 3, (1e-7,) * 3, (1e-9,) * 3, (5e4,) * 3, (3.0,) * 3, _THREE, "bracket"
            ),
        ),
        Levels((512.0,) * 4, _THREE, (512.0,) * 4, 16383.0, 16380.0),
        Linearity(0.002, 1.0, 0.001, 0.01, 0.9, 8),
        Falloff((_THREE,) * 3, (_THREE,) * 3, (0.8,) * 3, 8.0, 60.0),
        LensGeometry(
            1066.7, 0.4, (319.5, 239.5), 0.3, -0.05, 1e-3, 0.01, 2e-3, (640, 480), 0.2, 3.0, 6, "checkerboard", 60.0
        ),
        Polarizer(1.5, 0.05, 1, True, (500.0,) * 3, (5.0,) * 3, 24),
        FlashEnergy(0.01, 0.002, 1e-4, 1e-4, 20),
    )
).encode()  # fmt: skip
_TOML = (
    b"[hdr]\nclip = 0.98\n[gates]\nmax_ghost = 0.02\n",
    b"[selfcal]\nunknown_angles = true\nmax_unknown_sigma_deg = 4.0\n[stokes]\nundistort = false\n",
)
_CAPTURE = b'name = "vase"\nfocal_length_mm = 60.0\n[[frame]]\nfile = "a.dng"\nangle = 45\nrole = "shot"\n'
_PROFILE = b'matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\nsource = "chart"\ncost = nan\n'
_ELLIPTEC = b"0GS00\n0IN0E1140041520211501016800023000\n0PO00000000\n0PO00000100\n"
_LINE = b"polcap-rotator 1 bench 60\nok 0.00\nok 12.50\nok 12.50\n"
_JPEG = headers.jpeg(b"") + b"\xff\xda\0\x02abc\xff\0\xff\xd9"
_OF_FILES = (ValueError, OSError, PolcapError)
PARSERS = {
    "settings (TOML)": Target(_TOML, _file("settings.toml", config.load), share=0.3),
    "settings (--set)": Target(
        (b"hdr.clip=0.98", b"gates.max_ghost=0.1"), _text(lambda text: config.load(None, [text])), share=0.06
    ),
    "capture.toml": Target(
        (_CAPTURE,), _file(capture_toml.NAME, lambda file: capture_toml.load(file.parent)), share=0.4
    ),
    "color profile": Target((_PROFILE,), _file("profile.toml", color_profile.read), share=0.4),
    "calibration (TOML)": Target((_CALIBRATION,), _file("calib/bench.toml", _calibration_file), share=0.4),
    "maps.json": Target(
        (json.dumps(_MAPS).encode(),),
        _file("maps.json", lambda file: msgspec.convert(text_file.read_json(file), maps._Description)),
        _OF_FILES,
        share=0.6,
    ),
    "report.json": Target(
        (json.dumps(_REPORT).encode(),), _file("report.json", lambda file: report.read(file.parent)), share=0.6
    ),
    "manifest, Stokes": Target((_MANIFEST["stokes"],), _manifest(StokesImage), _OF_FILES),
    "manifest, color": Target((_MANIFEST["color"],), _manifest(ColorCalibration), _OF_FILES),
    "TIFF structure": Target(_TIFFS, _header),
    "EXIF": Target(  # the limit of the child that parses tags in a run
        _TIFFS, lambda data, folder: exif.sized(exif.tags(data), 640, 480), limit_s=30.0, share=0.06
    ),
    "JPEG markers": Target((_JPEG,), lambda data, folder: file_checks.check_jpeg("fuzz", data)),
    "bracket": Target((b"1/200,1/50,0.5", b"f/11,iso100", b"flash1/16"), _text(exposure_bracket.parse_bracket)),
    "names": Target((b"My vase, 2nd try", "Büste №3".encode()), _text(_name)),
    "Elliptec replies": Target((_ELLIPTEC,), _motor(ElliptecMotor, ElliptecSettings(timeout=0.05))),
    "GRBL replies": Target((_GRBL,), _motor(GrblMotor, GrblSettings(timeout=0.05))),
    "line protocol": Target((_LINE,), _motor(LineMotor, LineSettings(timeout=0.05))),
}


if __name__ == "__main__":
    stated = arguments(__doc__, runs=100_000, seed=0, rows=Rows())
    sys.exit(1 if campaign(PARSERS, stated.runs, stated.seed, stated.rows, _BATCH, time.process_time) else 0)
