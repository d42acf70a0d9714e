"""Text, TOML, JSON, serial replies and headers, mutated, through polcap's parsers in this process.

python tests/campaigns/fuzz_parsers.py [--runs 100000] [--seed 0] [--rows FILE]

A parser may give a value or one of its declared errors, within a second of processor time. Prints a table per parser;
anything else is printed with its input and ends with exit code 1. With --rows a campaign goes on where it was stopped.
"""

import argparse
import io
import json
import os
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from polcap import config, report
from polcap.errors import PolcapError
from polcap.formats import atomic, calibrations, npy_folder, text_file
from polcap.formats.capture import capture_toml
from polcap.formats.maps import maps_folder as maps
from polcap.formats.raw import exif, file_checks, file_kind
from polcap.images import (
    Calibration,
    ColorCalibration,
    Exif,
    Falloff,
    FlashEnergy,
    LensGeometry,
    Levels,
    Linearity,
    NoiseLine,
    PatchColors,
    Polarizer,
    StokesImage,
    View,
)
from polcap.rig import exposure_bracket, motor_elliptec_ell14, motor_grbl, motor_line_protocol, serial_port
from polcap.rig.device_log import Log
from tests.campaigns.mutations import mutated
from tests.campaigns.rows import Rows
from tests.formats import headers

BATCH = 500  # executions that make a row


class Clock:
    """Time that passes where somebody waits, and nowhere else."""

    def __init__(self) -> None:
        self._now = 0.0

    def monotonic(self) -> float:
        return self._now

    def sleep(self, seconds: float) -> None:
        self._now += max(seconds, 0.001)


CLOCK = Clock()
for driver in (motor_elliptec_ell14, motor_grbl, motor_line_protocol, serial_port):
    driver.time = CLOCK  # type: ignore[attr-defined]


class Replies(serial_port.Port):
    """A serial port whose answers are written beforehand."""

    def __init__(self, data: bytes) -> None:
        self.url, self.log = "fuzz://", Log(None)
        self._lines = [line for line in data.split(b"\n") if line.strip()]  # as Port, which skips empty ones

    def send(self, text: str, discard: bool = True) -> None: ...

    def read_line(self, limit_s: float | None = None) -> str:
        if not self._lines:
            CLOCK.sleep(serial_port.ANSWER_S if limit_s is None else limit_s)
            raise serial_port.NoAnswer("fuzz:// answered with nothing")
        line = self._lines.pop(0).strip()
        if not all(32 <= byte < 127 or byte == 9 for byte in line):
            raise serial_port.NoAnswer("fuzz:// answered with no text")
        return line.decode("ascii")

    def unknown_answer(self, line: str) -> serial_port.NoAnswer:
        return serial_port.NoAnswer(f"fuzz:// answered {line:.40}")


@dataclass(frozen=True)
class Parser:
    seeds: tuple[bytes, ...]
    run: Callable[[bytes, Path], object]
    declared: tuple[type[Exception], ...] = (PolcapError,)
    limit_s: float = 1.0
    share: float = 1.0  # of the executions: less where one takes long


def _written(data: bytes, folder: Path, name: str) -> Path:
    file = folder / name
    file.write_bytes(data)
    return file


def _settings(data: bytes, folder: Path) -> object:
    return config.load(_written(data, folder, "settings.toml"))


def _assignment(data: bytes, folder: Path) -> object:
    return config.load(None, [data.decode("utf-8", "surrogateescape")])


def _capture(data: bytes, folder: Path) -> object:
    _written(data, folder, capture_toml.NAME)
    return capture_toml.load(folder)


def _profile(data: bytes, folder: Path) -> object:
    return calibrations.read_profile(_written(data, folder, "profile.toml"))


def _calibration_file(data: bytes, folder: Path) -> object:
    place = folder / "calib"
    place.mkdir(exist_ok=True)
    _written(data, place, "bench.toml")
    os.environ["POLCAP_CALIB"] = str(place)
    return calibrations.choose(_EXIF, None, 60.0)


def _maps(data: bytes, folder: Path) -> object:
    return msgspec.convert(text_file.read_json(_written(data, folder, "maps.json")), maps._Description)


def _tree(data: bytes, folder: Path) -> object:
    return npy_folder.decode(text_file.parse_json(data.decode("utf-8")), StokesImage, folder)


def _calibration(data: bytes, folder: Path) -> object:
    return npy_folder.decode(text_file.parse_json(data.decode("utf-8")), ColorCalibration, folder)


def _report(data: bytes, folder: Path) -> object:
    _written(data, folder, "report.json")
    return report.read(folder)


def _header(data: bytes, folder: Path) -> object:
    structure = file_kind.structure(data)
    file_checks.check_structure("fuzz", structure, data)
    return file_kind.kind(io.BytesIO(data), ".dng"), structure.truncated, structure.dng


def _tags(data: bytes, folder: Path) -> object:
    return exif.sized(exif.tags(data), 640, 480)


def _jpeg(data: bytes, folder: Path) -> object:
    file_checks.check_jpeg("fuzz", data)
    return None


def _bracket(data: bytes, folder: Path) -> object:
    return exposure_bracket.parse_bracket(data.decode("utf-8", "surrogateescape"))


def _name(data: bytes, folder: Path) -> object:
    name = atomic.safe_name(data.decode("utf-8", "surrogateescape"))
    assert name and len(name.encode()) <= 100 and name.isprintable() and not set(name) & set("/\\:"), name
    return name


def _elliptec(data: bytes, folder: Path) -> object:
    motor = motor_elliptec_ell14.ElliptecMotor(Replies(data), motor_elliptec_ell14.ElliptecSettings(timeout=0.05))
    motor.home()
    return motor.position()


def _grbl(data: bytes, folder: Path) -> object:
    board = motor_grbl.GrblMotor(Replies(data), motor_grbl.GrblSettings(timeout=0.05))
    board.home()
    return board.position()


def _line(data: bytes, folder: Path) -> object:
    board = motor_line_protocol.LineMotor(Replies(data), motor_line_protocol.LineSettings(timeout=0.05))
    board.home()
    return board.position()


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
    "polcap": "0.9.0", "verdict": "pass",
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
PARSERS = {
    "settings (TOML)": Parser(
        (
            b"[hdr]\nclip = 0.98\n[gates]\nmax_ghost = 0.02\n",
            b"[selfcal]\nunknown_angles = true\nmax_unknown_sigma_deg = 4.0\n[stokes]\nundistort = false\n",
        ),
        _settings,
        share=0.3,
    ),
    "settings (--set)": Parser((b"hdr.clip=0.98", b"gates.max_ghost=0.1"), _assignment, share=0.06),
    "capture.toml": Parser(
        (b'name = "vase"\nfocal_length_mm = 60.0\n[[frame]]\nfile = "a.dng"\nangle = 45\nrole = "shot"\n',),
        _capture,
        share=0.4,
    ),
    "color profile": Parser(
        (b'matrix = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\nsource = "chart"\ncost = nan\n',),
        _profile,
        share=0.4,
    ),
    "calibration (TOML)": Parser((_CALIBRATION,), _calibration_file, share=0.4),
    "maps.json": Parser((json.dumps(_MAPS).encode(),), _maps, (ValueError, OSError), share=0.6),
    "report.json": Parser((json.dumps(_REPORT).encode(),), _report, share=0.6),
    "manifest, Stokes": Parser((_MANIFEST["stokes"],), _tree, (ValueError, PolcapError)),
    "manifest, color": Parser((_MANIFEST["color"],), _calibration, (ValueError, PolcapError)),
    "TIFF structure": Parser(_TIFFS, _header),
    "EXIF": Parser(_TIFFS, _tags, limit_s=30.0, share=0.06),  # the limit of the child that it runs in
    "JPEG markers": Parser((headers.jpeg(b"") + b"\xff\xda\0\x02abc\xff\0\xff\xd9",), _jpeg),
    "bracket": Parser((b"1/200,1/50,0.5", b"f/11,iso100", b"flash1/16"), _bracket),
    "names": Parser((b"My vase, 2nd try", "Büste №3".encode()), _name),
    "Elliptec replies": Parser((b"0GS00\n0IN0E1140041520211501016800023000\n0PO00000000\n0PO00000100\n",), _elliptec),
    "GRBL replies": Parser((_GRBL,), _grbl),
    "line protocol": Parser((b"polcap-rotator 1 bench 60\nok 0.00\nok 12.50\nok 12.50\n",), _line),
}


def campaign(runs: int, seed: int, rows: Rows, say: Callable[[str], None] = print) -> int:
    """Failures of `runs` executions, by the parsers' shares."""
    done = rows.done("seed", "parser", "batch")
    each = runs / sum(parser.share for parser in PARSERS.values())
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as place:
        folder = Path(place)
        for name, array in _ARRAYS.items():
            npy_folder.save(folder / f"{name}.npy", array)
        for name, parser in PARSERS.items():
            for batch in range(ceil(parser.share * each / BATCH)):
                if (seed, name, batch) not in done:
                    row = _batch(parser, Random(f"{seed} {name} {batch}"), folder, say)
                    rows.add({"seed": seed, "parser": name, "batch": batch, **row})
    return summary(rows, say)


def _batch(parser: Parser, random: Random, folder: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """The outcomes of so many executions, and the processor time of all and of the slowest, s."""
    seen = Counter({"value": 0, "error": 0, "failure": 0})
    slowest, begun = 0.0, time.process_time()
    for _ in range(BATCH):
        data = mutated(random.choice(parser.seeds), random, most=4)
        start = time.process_time()
        try:
            parser.run(data, folder)
            seen["value"] += 1
        except parser.declared:
            seen["error"] += 1
        except Exception:
            seen["failure"] += 1
            say(f"{data[:400]!r}\n{traceback.format_exc()}")
        took = time.process_time() - start
        slowest = max(slowest, took)
        if took > parser.limit_s:
            seen["failure"] += 1
            say(f"{took:.1f} s on {data[:400]!r}")
    return {**seen, "slowest": round(slowest, 4), "processor": round(time.process_time() - begun, 3)}


def summary(rows: Rows, say: Callable[[str], None]) -> int:
    """The table of all executions so far; their failures."""
    say("| parser | executions | values | declared errors | slowest, ms | failures |\n|" + " --- |" * 6)
    for name in PARSERS:
        of_it = [row for row in rows.all if row["parser"] == name]
        value, error, failure = (sum(row[column] for row in of_it) for column in ("value", "error", "failure"))
        slowest = 1e3 * max(row["slowest"] for row in of_it)
        say(f"| {name} | {BATCH * len(of_it)} | {value} | {error} | {slowest:.0f} | {failure} |")
    spent, failures = (sum(row[column] for row in rows.all) for column in ("processor", "failure"))
    say(f"{BATCH * len(rows.all)} executions in {spent:.0f} s of processor time, {failures} failures")
    return int(failures)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--runs", type=int, default=100_000)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--rows", type=Path)
    given = arguments.parse_args()
    sys.exit(1 if campaign(given.runs, given.seed, Rows(given.rows)) else 0)
