"""Mutated RAW files, pictures and models, read by polcap's readers.

python -m tests.campaigns.fuzz_files [--files 400] [--seed 0] [--rows FILE]

Seeds are made here (DNG, TIFF, PNG, JPEG, EXR, a model) and, where POLCAP_DATA is set, its smaller RAW files. Values
must be finite and of a bounded size. Prints a table, the growth of this process and the children's peak memory; exit
code 1 after a failure.
"""

import os
import resource
import struct
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from onnx import TensorProto, helper

from polcap.errors import InputError
from polcap.formats import onnx as models
from polcap.formats import sandbox
from polcap.formats.maps import exr, png
from polcap.formats.raw import file_checks, photo, probe
from polcap.formats.raw import libraw as raw
from tests.campaigns.mutations import Target, campaign
from tests.experiments import Rows, arguments
from tests.formats import headers

_BATCH = 25  # files that make a row
_MOST_BYTES = 3e6  # of a RAW file that is a seed
_SLOW, _SLOW_SHARE = 1e6, 0.1  # bytes of a RAW beyond which fewer files are tried, and their share
_LIMIT_S = 200.0  # of one call: the decoder's own limit is 180


def targets(folder: Path) -> dict[str, Target]:
    """Seeds and readers by kind of file."""
    random = np.random.default_rng(7)
    picture = random.integers(0, 65535, (40, 60, 3), np.uint16)
    cv2.imwrite(str(folder / "a.png"), picture)
    cv2.imwrite(str(folder / "a.tif"), picture)
    cv2.imwrite(str(folder / "a.jpg"), (picture >> 8).astype(np.uint8))
    exr.write(folder / "a.exr", {name: random.random((40, 60), np.float32) for name in "RGB"}, half=True)
    stored = {suffix: (folder / f"a.{suffix}").read_bytes() for suffix in ("png", "tif", "jpg", "exr")}
    mosaic = random.integers(500, 16000, (60, 84))

    def target(data: bytes, read: Callable[[Path], object], share: float = 1.0, mend: Any = bytes) -> Target:
        def run(damaged: bytes, place: Path) -> None:
            (place / "fuzz.dng").write_bytes(damaged)
            read(place / "fuzz.dng")

        return Target((data,), run, (InputError,), _LIMIT_S, share, mend)

    found = {
        "DNG": target(headers.dng(mosaic, black=[[500, 500], [500, 500]]), _photograph),
        "linear DNG": target(headers.dng(picture >> 2, photometric=34892), _photograph),
        "PNG": target(stored["png"], _photograph, mend=summed),
        "TIFF": target(stored["tif"], _photograph),
        "JPEG": target(stored["jpg"], _photograph),
        "EXR": target(stored["exr"], _photograph),
        "map": target(stored["exr"], exr.read),
        "mask": target(stored["png"], png.read, mend=summed),
    }
    data = Path(os.environ.get("POLCAP_DATA") or "/nonexistent")
    for file in sorted((data / "real").glob("raw_*/*")):
        size = file.stat().st_size
        if file.suffix.lower() in (".dng", ".crw", ".kdc", ".cr2", ".nef") and size < _MOST_BYTES:
            share = _SLOW_SHARE if size > _SLOW else 1.0
            found[f"{file.suffix[1:].upper()} of a camera"] = target(file.read_bytes(), _photograph, share)
    return {**found, "ONNX": target(model(), _model, share=3.0)}


def summed(data: bytes) -> bytes:
    """A PNG with correct checksums, as far as its chunks can be followed; a decoder refuses others at once."""
    out, at = bytearray(data), 8
    while at + 12 <= len(out):
        (length,) = struct.unpack_from(">I", out, at)
        end = at + 8 + length
        if end + 4 > len(out):
            break
        struct.pack_into(">I", out, end, zlib.crc32(out[at + 4 : end]))
        at = end + 4
    return bytes(out)


def model() -> bytes:
    """A small model with a loop in it and the metadata that polcap asks for."""
    shape = [1, 2, "h", "w"]
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Add", ["x", "x"], ["y"])],
        "body",
        [
            helper.make_tensor_value_info("i", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("x", TensorProto.FLOAT, shape),
        ],
        [
            helper.make_tensor_value_info("on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("y", TensorProto.FLOAT, shape),
        ],
    )
    graph = helper.make_graph(
        [helper.make_node("Loop", ["times", "", "input"], ["normal"], body=body)],
        "doubles",
        [helper.make_tensor_value_info("input", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("normal", TensorProto.FLOAT, shape)],
        [helper.make_tensor("times", TensorProto.INT64, [], [3])],
    )
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    metadata = {
        "channels": "a,b",
        "encoding": models.ENCODING,
        "native_size": "64",
        "size_multiple": "8",
        "licence": "MIT",
    }
    helper.set_model_props(made, metadata)
    return bytes(made.SerializeToString())


def _photograph(path: Path) -> None:
    found = probe.read(path)
    if found.kind in ("raw", "photo"):
        image = raw.read(path, found.digest) if found.kind == "raw" else photo.read(path, digest=found.digest)
        assert np.isfinite(image.value).all() and image.value[..., 0].size <= file_checks.MOST_PIXELS
        assert np.isfinite(image.black).all() and np.isfinite(image.white)


def _model(path: Path) -> None:
    network = models.load(path, "cpu", 1)
    answer = models.run(network, np.zeros((1, len(network.channels), 64, 64), np.float32))
    assert all(np.isfinite(value).all() for value in answer.values())


if __name__ == "__main__":
    stated = arguments(__doc__, files=400, seed=0, rows=Rows())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with tempfile.TemporaryDirectory() as place:
        kinds = targets(Path(place))
    failures = campaign(kinds, stated.files, stated.seed, stated.rows, _BATCH, time.perf_counter)
    sandbox.end_idle()  # the memory of children is known once they have ended
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    print(f"This process grew by {grown:.0f} MB, a child had {children:.0f} MB.")
    sys.exit(1 if failures else 0)
