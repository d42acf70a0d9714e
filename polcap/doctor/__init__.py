"""`polcap doctor`: checks software, models, devices and disk of this machine; each is ok, a warning or a fault.

Only a fault keeps `polcap process` from working.
"""

import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from polcap import __version__
from polcap.capture_values import Exif
from polcap.errors import PolcapError
from polcap.formats import dng_writer, onnx
from polcap.formats.raw import libraw
from polcap.pipeline import models

_ENOUGH_GB, _LEAST_GB = 10.0, 1.0  # free disk: a capture of 24 MP with its result takes about 2
_EDGE_PX = 64  # of the RAW that is written and decoded as a trial


class Finding(msgspec.Struct, frozen=True):
    """Result of one check of `polcap doctor`: state, message and remedy."""

    name: str
    state: Literal["ok", "warning", "fault"]
    message: str = msgspec.field(name="says")  # the key in the JSON output
    remedy: str = ""


@dataclass(frozen=True)
class Rig:
    """Functions that look for devices (serial ports, cameras); each may raise a PolcapError."""

    ports: Callable[[], list[tuple[str, str]]]  # device and description of every serial port
    may_write: Callable[[list[str]], bool]  # whether polcap may write to these ports
    probe: Callable[[str], str | None]  # name of the rotator at a port; writes to it
    cameras: Callable[[], list[tuple[str, str]]]  # model and port


def examine(rig: Rig, folder: Path) -> tuple[Finding, ...]:
    """Check everything on this machine; the disk is that of `folder`."""
    import cv2

    versions = f"{__version__}, Python {sys.version.split()[0]}, numpy {np.__version__}, OpenCV {cv2.__version__}"
    model = models.newest("polcap")
    return (
        Finding("polcap", "ok", versions),
        _decoder(),
        _model(model),
        *(_providers(model) if model else ()),
        _disk(folder),
        *_ports(rig),
        *_cameras(rig),
    )


def table(found: Iterable[Finding]) -> str:
    """The findings of `polcap doctor` as a text table."""
    rows = []
    for one in found:
        rows.append(f"{one.state:9}{one.name:16}{one.message}")
        if one.remedy:
            rows.append(f"{'':25}→ {one.remedy}")
    return "\n".join(rows)


def to_json(found: Iterable[Finding]) -> dict[str, object]:
    """The findings of `polcap doctor` as data for JSON."""
    works = all(one.state != "fault" for one in found)
    return {"polcap": __version__, "process_works": works, "findings": msgspec.to_builtins(found)}


def _decoder() -> Finding:
    """Check LibRaw: its version, and whether it decodes a RAW file written for this test."""
    counts = np.arange(_EDGE_PX**2, dtype=np.uint16).reshape(_EDGE_PX, _EDGE_PX)
    exif, cfa = Exif(make="Polcap", model="Doctor"), np.array([[0, 1], [1, 2]], np.uint8)
    colors = {"color_matrix": np.eye(3), "as_shot_neutral": np.ones(3)}
    message = ""
    try:
        name = libraw.version()
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "trial.dng"
            dng_writer.write(file, counts, cfa=cfa, black=0, white=16383, exif=exif, **colors)
            if not np.array_equal(libraw.read(file).value, counts):
                message = f"{name} decodes a RAW wrongly"
    except (PolcapError, OSError) as error:
        message = str(error)
    if message:
        return Finding("LibRaw", "fault", message, "pip install --force-reinstall rawpy")
    return Finding("LibRaw", "ok", f"{name}, decodes a RAW in a process of its own")


def _model(file: Path | None) -> Finding:
    """Check that the network opens, and the smaller ones with it."""
    if file is None:
        remedy = "name one with --model; without one the analytic estimator is used"
        return Finding("model", "warning", "this polcap has no network", remedy)
    try:
        network = models.open_network(file)
        others = [one for one in (network.fine, models.load_mask_network()) if one is not None]
    except PolcapError as error:
        return Finding("model", "fault", str(error), "install polcap again, or use --estimator analytic")
    release = network.metadata.get("version", network.digest[:8])
    facts = f"{file.name}, version {release}, {file.stat().st_size / 1e6:.1f} MB, loads, and {len(others)} smaller ones"
    return Finding("model", "ok", facts)


def _providers(model: Path) -> Iterator[Finding]:
    """Check each execution provider of onnxruntime by running the shipped model on it."""
    try:
        found = onnx.providers(model)
    except ImportError as error:
        yield Finding("onnxruntime", "fault", str(error), "pip install onnxruntime")
        return
    for provider, failure in found.items():
        name = f"on {provider.removesuffix('ExecutionProvider')}"
        if not failure:
            yield Finding(name, "ok", f"onnxruntime {version('onnxruntime')} runs the model")
        elif provider == onnx.CPU:
            yield Finding(name, "fault", failure, "pip install --force-reinstall onnxruntime")
        else:
            yield Finding(name, "warning", failure, "install matching driver, CUDA and cuDNN, or use --device cpu")


def _disk(folder: Path) -> Finding:
    """Check whether the disk of a folder has room for captures and results."""
    free = shutil.disk_usage(folder).free / 1e9
    message = f"{free:.1f} GB free at {folder}"
    if free >= _ENOUGH_GB:
        return Finding("disk", "ok", message)
    remedy = "a capture of 24 MP with its result takes 2 GB: free some space, or use --out"
    return Finding("disk", "fault" if free < _LEAST_GB else "warning", message, remedy)


def _ports(rig: Rig) -> Iterator[Finding]:
    """Find serial ports and, if allowed, the rotators on them."""
    try:
        ports = rig.ports()
    except PolcapError as error:
        yield Finding("serial ports", "warning", str(error))
        return
    if not ports:
        remedy = "plug the rotator in; under Linux its cable appears as /dev/ttyUSB0 or /dev/ttyACM0"
        yield Finding("serial ports", "warning", "none", remedy)
        return
    allowed = rig.may_write([device for device, _ in ports])
    for device, description in ports:
        if not allowed:
            yield Finding(device, "ok", f"{description}: not asked", "`polcap doctor --ports` asks, and writes to it")
            continue
        try:
            answer = rig.probe(device)
        except PolcapError as error:
            remedy = "close other programs that use the port; under Linux join the group `dialout`"
            yield Finding(device, "warning", str(error), remedy)
            continue
        if answer:
            yield Finding(device, "ok", f"{description}: {answer}")
        else:
            yield Finding(device, "warning", f"{description}: no known rotator answers", "switch it on")


def _cameras(rig: Rig) -> Iterator[Finding]:
    """Find the cameras on cables."""
    try:
        cameras = rig.cameras()
    except PolcapError as error:
        message, _, remedy = str(error).partition("; ")  # its text is "fact; remedy"
        yield Finding("cameras", "warning", message, remedy)
        return
    if not cameras:
        remedy = "plug it in, switch it on, set it to PTP; or tether with another program and --camera folder:PATH"
        yield Finding("cameras", "warning", "none", remedy)
    for name, port in cameras:
        yield Finding("camera", "ok", f"{name} at {port}")
