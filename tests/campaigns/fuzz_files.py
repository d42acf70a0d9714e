"""Mutated RAW files, pictures and models, each through the door that polcap opens it by.

python tests/campaigns/fuzz_files.py [--files 300] [--models 100] [--seed 0] [--rows FILE]

Seeds are made here (DNG, TIFF, PNG, JPEG, EXR, models) and, where POLCAP_DATA is set, its smaller RAW files. Half of
the mutations leave all bytes in their places. Outcomes allowed: a value that is finite and of a bounded size, or an
InputError of one line. Prints a table: outcomes, deaths of the child, slowest call, growth of this process, the
children's peak. Anything else is printed and ends with exit code 1. With --rows a campaign goes on where it stopped.
"""

import argparse
import os
import resource
import struct
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np
import onnx
from onnx import TensorProto, helper

sys.path.insert(0, str(Path(__file__).parents[2]))

from polcap.errors import InputError
from polcap.formats import onnx as models
from polcap.formats.maps import exr, png
from polcap.formats.raw import file_checks, photo, probe, worker
from polcap.formats.raw import libraw as raw
from tests.campaigns.mutations import mutated
from tests.campaigns.rows import Rows, processor_s
from tests.formats import headers

BATCH = 25  # files that make a row
MOST_BYTES = 3e6  # of a RAW taken as a seed
SLOW, SLOW_SHARE = 1e6, 0.1  # bytes of a RAW beyond which fewer are tried, and how many
LIMIT_S = 200.0  # of one call: the worker's own is 180
Door = Callable[[Path], object]


@dataclass(frozen=True)
class Seed:
    """Sound bytes, and the door that polcap opens them by."""

    data: bytes
    door: Door
    share: float = 1.0  # of the files
    mend: Callable[[bytes], bytes] = bytes  # what is put right after a mutation, for it to get further in


def photographs(folder: Path) -> dict[str, Seed]:
    """Seeds by their kinds."""
    random = np.random.default_rng(7)
    picture = random.integers(0, 65535, (40, 60, 3), np.uint16)
    cv2.imwrite(str(folder / "a.png"), picture)
    cv2.imwrite(str(folder / "a.tif"), picture)
    cv2.imwrite(str(folder / "a.jpg"), (picture >> 8).astype(np.uint8))
    exr.write(folder / "a.exr", {name: random.random((40, 60), np.float32) for name in "RGB"}, half=True)
    mosaic = random.integers(500, 16000, (60, 84))
    seeds = {
        "DNG": Seed(headers.dng(mosaic, black=[[500, 500], [500, 500]]), _raw),
        "linear DNG": Seed(headers.dng(picture, photometric=34892), _raw),
        "PNG": Seed((folder / "a.png").read_bytes(), _photo, mend=summed),
        "TIFF": Seed((folder / "a.tif").read_bytes(), _photo),
        "JPEG": Seed((folder / "a.jpg").read_bytes(), _photo),
        "EXR": Seed((folder / "a.exr").read_bytes(), _photo),
        "map": Seed((folder / "a.exr").read_bytes(), exr.read),
        "mask": Seed((folder / "a.png").read_bytes(), png.read, mend=summed),
    }
    data = Path(os.environ.get("POLCAP_DATA") or "/nonexistent")
    for file in sorted((data / "real").glob("raw_*/*")):
        size = file.stat().st_size
        if file.suffix.lower() in (".dng", ".crw", ".kdc", ".cr2", ".nef") and size < MOST_BYTES:
            share = SLOW_SHARE if size > SLOW else 1.0
            seeds[file.suffix[1:].upper() + " of a camera"] = Seed(file.read_bytes(), _raw, share)
    return seeds


def summed(data: bytes) -> bytes:
    """A PNG with right checksums, as far as its chunks can be followed: a decoder looks past them only then."""
    out, at = bytearray(data), 8
    while at + 12 <= len(out):
        (length,) = struct.unpack_from(">I", out, at)
        end = at + 8 + length
        if end + 4 > len(out):
            break
        struct.pack_into(">I", out, end, zlib.crc32(out[at + 4 : end]))
        at = end + 4
    return bytes(out)


def model(folder: Path) -> bytes:
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
    said = {"channels": "a,b", "encoding": models.ENCODING, "native_size": "64", "size_multiple": "8", "licence": "MIT"}
    helper.set_model_props(made, said)
    onnx.save(made, folder / "m.onnx")
    return (folder / "m.onnx").read_bytes()


def _raw(path: Path) -> object:
    found = probe.read(path)
    if found.kind == "photo":
        return _photo(path)
    image = raw.read(path, found.digest)
    assert np.isfinite(image.value).all() and image.value[..., 0].size <= file_checks.MOST_PIXELS
    assert np.isfinite(image.black).all() and np.isfinite(image.white)
    return image


def _photo(path: Path) -> object:
    found = probe.read(path)
    if found.kind != "photo":
        return _raw(path) if found.kind == "raw" else found
    image = photo.read(path, digest=found.digest)
    assert np.isfinite(image.value).all() and image.value[..., 0].size <= file_checks.MOST_PIXELS
    return image


def _model(path: Path) -> object:
    network = models.load(path, "cpu", 1)
    answer = models.run(network, np.zeros((1, len(network.channels), 64, 64), np.float32))
    assert all(np.isfinite(value).all() for value in answer.values())
    return answer


def attack(seed: Seed, random: Random, folder: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """The outcomes of a batch of mutations, sent through a door; the slowest in s."""
    seen = Counter({"value": 0, "refused": 0, "died": 0, "failure": 0})
    slowest = 0.0
    file = folder / "fuzz.dng"
    for _ in range(BATCH):
        file.write_bytes(seed.mend(mutated(seed.data, random, most=3, in_place=random.random() < 0.5)))
        start = time.perf_counter()
        try:
            seed.door(file)
            seen["value"] += 1
        except InputError as error:
            seen["died" if "the decoder" in str(error) or "not decoded within" in str(error) else "refused"] += 1
            if "\n" in str(error):
                seen["failure"] += 1
                say(f"not one line: {error}")
        except Exception:
            seen["failure"] += 1
            kept = Path(tempfile.gettempdir()) / f"polcap-fuzz-{time.time_ns()}"
            kept.write_bytes(file.read_bytes())
            say(f"{kept}\n{traceback.format_exc()}")
        took = time.perf_counter() - start
        slowest = max(slowest, took)
        seen["failure"] += took > LIMIT_S
    return {**seen, "slowest": round(slowest, 2)}


def main(files: int, count: int, number: int, rows: Rows, say: Callable[[str], None] = print) -> int:
    """Failures of the campaign."""
    done = rows.done("number", "seed", "batch")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as place:
        folder = Path(place)
        seeds = photographs(folder)
        each = files / sum(seed.share for seed in seeds.values())
        wanted = {name: ceil(seed.share * each / BATCH) for name, seed in seeds.items()}
        seeds["ONNX"], wanted["ONNX"] = Seed(model(folder), _model), ceil(count / BATCH)
        for name, batches in wanted.items():
            for batch in range(batches):
                if (number, name, batch) not in done:
                    found = attack(seeds[name], Random(f"{number} {name} {batch}"), folder, say)
                    rows.add({"number": number, "seed": name, "batch": batch, **found})
    worker.end_idle()  # what the children took is known once they have ended
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    failures = summary(rows, say)
    say(
        f"Now {processor_s():.0f} s of processor time; this process grew by {grown:.0f} MB, a child had {children:.0f}."
    )
    return failures


def summary(rows: Rows, say: Callable[[str], None]) -> int:
    """The table of all files so far; their failures."""
    say("| seed | files | values | refused | child died | slowest, s | failures |\n|" + " --- |" * 7)
    for name in dict.fromkeys(row["seed"] for row in rows.all):
        of_it = [row for row in rows.all if row["seed"] == name]
        counts = [sum(row[column] for row in of_it) for column in ("value", "refused", "died", "failure")]
        slowest = max(row["slowest"] for row in of_it)
        say(f"| {name} | {BATCH * len(of_it)} | {' | '.join(map(str, counts[:3]))} | {slowest} | {counts[3]} |")
    say(f"{BATCH * len(rows.all)} files")
    return sum(row["failure"] for row in rows.all)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--files", type=int, default=300)
    arguments.add_argument("--models", type=int, default=100)
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--rows", type=Path)
    given = arguments.parse_args()
    sys.exit(1 if main(given.files, given.models, given.seed, Rows(given.rows)) else 0)
