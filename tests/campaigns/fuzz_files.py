"""Mutated RAW files, pictures and models, each through the door that polcap opens it by.

python tests/campaigns/fuzz_files.py [--files 300] [--models 100] [--seed 0]

Seeds are made here (DNG, TIFF, PNG, JPEG, EXR, models) and, where POLCAP_DATA is set, its smaller RAW files. Outcomes
allowed: a value that is finite and of a bounded size, or an InputError of one line. Prints a table: outcomes, deaths
of the child, slowest call, growth of this process. Anything else is printed and ends with exit code 1.
"""

import argparse
import os
import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import onnx
from onnx import TensorProto, helper

sys.path.insert(0, str(Path(__file__).parents[2]))

from polcap.errors import InputError
from polcap.formats import exr, photo, plausible, png, probe, raw
from polcap.formats import onnx as models
from tests.campaigns.mutations import Random, mutated
from tests.formats import headers

MOST_MB = 2e6  # bytes of a RAW taken as a seed
LIMIT_S = 200.0  # of one call: the worker's own is 180
Door = Callable[[Path], object]


def photographs(folder: Path) -> list[tuple[str, bytes, Door]]:
    """Kind, sound bytes and door of each seed."""
    random = np.random.default_rng(7)
    picture = random.integers(0, 65535, (40, 60, 3), np.uint16)
    cv2.imwrite(str(folder / "a.png"), picture)
    cv2.imwrite(str(folder / "a.tif"), picture)
    cv2.imwrite(str(folder / "a.jpg"), (picture >> 8).astype(np.uint8))
    exr.write(folder / "a.exr", {name: random.random((40, 60), np.float32) for name in "RGB"}, half=True)
    mosaic = random.integers(500, 16000, (60, 84))
    seeds: list[tuple[str, bytes, Door]] = [
        ("DNG", headers.dng(mosaic, black=[[500, 500], [500, 500]]), _raw),
        ("linear DNG", headers.dng(picture, photometric=34892), _raw),
        ("PNG", (folder / "a.png").read_bytes(), _photo),
        ("TIFF", (folder / "a.tif").read_bytes(), _photo),
        ("JPEG", (folder / "a.jpg").read_bytes(), _photo),
        ("EXR", (folder / "a.exr").read_bytes(), _photo),
        ("map", (folder / "a.exr").read_bytes(), exr.read),
        ("mask", (folder / "a.png").read_bytes(), png.read),
    ]
    data = Path(os.environ.get("POLCAP_DATA") or "/nonexistent")
    for file in sorted((data / "real").glob("raw_*/*")):
        if file.suffix.lower() in (".dng", ".crw", ".kdc", ".cr2", ".nef") and file.stat().st_size < MOST_MB:
            seeds.append((file.suffix[1:].upper() + " of a camera", file.read_bytes(), _raw))
    return seeds


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
    assert np.isfinite(image.value).all() and image.value[..., 0].size <= plausible.MOST_PIXELS
    assert np.isfinite(image.black).all() and np.isfinite(image.white)
    return image


def _photo(path: Path) -> object:
    found = probe.read(path)
    if found.kind != "photo":
        return _raw(path) if found.kind == "raw" else found
    image = photo.read(path, digest=found.digest)
    assert np.isfinite(image.value).all() and image.value[..., 0].size <= plausible.MOST_PIXELS
    return image


def _model(path: Path) -> object:
    network = models.load(path, "cpu", 1)
    answer = network.run(np.zeros((1, len(network.channels), 64, 64), np.float32))
    assert all(np.isfinite(value).all() for value in answer.values())
    return answer


def attack(
    name: str, data: bytes, door: Door, count: int, random: Random, folder: Path, say: Callable[[str], None]
) -> int:
    """Send `count` mutations through a door; prints its row, returns the failures."""
    seen: Counter[str] = Counter()
    slowest = 0.0
    for _ in range(count):
        file = folder / "fuzz.dng"
        file.write_bytes(mutated(data, random, most=3))
        start = time.perf_counter()
        try:
            door(file)
            seen["value"] += 1
        except InputError as error:
            seen["died" if "the decoder" in str(error) or "not decoded within" in str(error) else "refused"] += 1
            if "\n" in str(error):
                seen["failure"] += 1
                say(f"{name}: not one line: {error}")
        except Exception:
            seen["failure"] += 1
            kept = folder.parent / f"polcap-fuzz-{name.replace(' ', '-')}-{time.time_ns()}"
            kept.write_bytes(file.read_bytes())
            say(f"{name}: {kept}\n{traceback.format_exc()}")
        took = time.perf_counter() - start
        slowest = max(slowest, took)
        seen["failure"] += took > LIMIT_S
    row = [name, count, seen["value"], seen["refused"], seen["died"], f"{slowest:.1f}", seen["failure"]]
    say("| " + " | ".join(map(str, row)) + " |")
    return seen["failure"]


def main(files: int, count: int, seed: int, say: Callable[[str], None] = print) -> int:
    """Failures of the campaign."""
    random = np.random.default_rng(seed)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    say("| seed | files | values | refused | child died | slowest, s | failures |\n|" + " --- |" * 7)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        seeds = photographs(folder)
        failures = sum(attack(*one, -(-files // len(seeds)), random, folder, say) for one in seeds)
        failures += attack("ONNX", model(folder), _model, count, random, folder, say)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    say(f"This process grew by {grown:.0f} MB.")
    return failures


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--files", type=int, default=300)
    arguments.add_argument("--models", type=int, default=100)
    arguments.add_argument("--seed", type=int, default=0)
    given = arguments.parse_args()
    sys.exit(1 if main(given.files, given.models, given.seed) else 0)
