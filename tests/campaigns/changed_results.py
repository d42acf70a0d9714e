"""Changed files of a result: every command then ends by one line or goes on, never with a bug.

python -m tests.campaigns.changed_results [--changes 300] [--seed 0] [--rows FILE]

The result is one of a batch, with an export and the pictures of `show`. Each change concerns one of its files or
folders, in turn: bytes flipped, cut, emptied, replaced by other bytes, by a folder, by a link or by another file,
without permissions; a key of a JSON file with a value of another type, or without one; an array or picture of another
shape, type or with NaN. A changed manifest or run.json gets the digest of its new content in half of the cases. Then
the six commands that read a result run in this process.
"""

import json
import os
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np

from polcap.formats.maps import exr
from polcap.pipeline import manifest
from polcap.results import STAGES
from tests.campaigns.mutations import mutated
from tests.campaigns.users_files import make_template, run
from tests.experiments import Rows, arguments, table

QUICK = ("--no-chart", "--estimator", "analytic")
_OTHER: tuple[Any, ...] = (None, True, -1, 0, 1e300, "text", "\ud800", [], {}, [None], {"a": 1}, [[[]]], "9" * 5000)
_NOT_FINITE = ("NaN", "Infinity", "1e999")
_SWAPPED = "work/04-mask/value.mask.npy"
Change = Callable[[Path, Random], None]


def complete(folder: Path) -> None:
    """Make of a capture with its result, folder/C, a batch of one capture with everything that can be in a result."""
    result = folder / "C" / "polcap"
    for words in (("batch", folder, *QUICK), ("export", result, "--obj"), ("show", result, "--all")):
        assert run(*words)[0] in (0, 3)


def places(template: Path) -> list[str]:
    """Files and folders of the result and of the batch, by name."""
    roots = (template / "C" / "polcap", template / "polcap-batch")
    return sorted(path.relative_to(template).as_posix() for root in roots for path in [root, *root.rglob("*")])


def commands(root: Path, random: Random) -> list[tuple[object, ...]]:
    """The commands that read a result; `report` and `process` repair much, so they are late."""
    capture, result = root / "C", root / "C" / "polcap"
    export = random.choice([(), ("--obj", "--lod", "1"), ("--preset", "archive"), ("--preset", "web")])
    return [
        ("status", result), ("status", root), ("show", result, random.choice(STAGES)), ("export", result, *export),
        ("report", result, "--compare", result), ("report", result), ("process", capture, *QUICK),
        ("clean", root, "-n"), ("clean", result),
    ]  # fmt: skip


def changes(path: Path) -> list[dict[str, Change]]:
    """Changes that a file or folder can undergo, by name: of any, of bytes, of the content."""
    found: dict[str, Change] = {
        "removed": _removed, "looping link": _looping, "dangling link": _dangling, "link elsewhere": _linked,
        "other kind": _other_kind, "no permissions": lambda place, _: place.chmod(0),
    }  # fmt: skip
    if path.is_dir():
        return [found]
    of_bytes: dict[str, Change] = {
        "emptied": lambda place, _: _write(place, b""),
        "flipped": lambda place, random: _write(place, mutated(place.read_bytes(), random, 4, in_place=True)),
        "cut": lambda place, random: _write(place, place.read_bytes()[: random.randrange(place.stat().st_size or 1)]),
        "mixed": lambda place, random: _write(place, mutated(place.read_bytes(), random)),
        "swapped": lambda place, _: _write(place, (_result(place) / _SWAPPED).read_bytes()),
    }
    of_content: dict[str, dict[str, Change]] = {
        ".json": {"value": _value, "key": _key, "document": _document, "not finite": _not_finite},
        ".npy": {"array": _array},
        ".png": {"picture": _picture},
        ".exr": {"channels": _channels},
    }
    kinds = of_content.get(path.suffix)
    return [found, of_bytes] if kinds is None else [found, of_bytes, kinds, kinds, kinds]


def _result(place: Path) -> Path:
    """The result in the tree of a changed file."""
    root = next(parent for parent in place.parents if (parent / "C").is_dir())
    return root / "C" / "polcap"


def _write(place: Path, data: bytes) -> None:
    place.write_bytes(data)


def _removed(place: Path, random: Random) -> None:
    shutil.rmtree(place) if place.is_dir() else place.unlink()


def _other_kind(place: Path, random: Random) -> None:
    """A folder in place of a file, or a file in place of a folder."""
    was_folder = place.is_dir()
    _removed(place, random)
    place.write_bytes(b"x") if was_folder else (place / "inside").mkdir(parents=True)


def _looping(place: Path, random: Random) -> None:
    _removed(place, random)
    place.symlink_to(place.name)


def _dangling(place: Path, random: Random) -> None:
    _removed(place, random)
    place.symlink_to("nowhere")


def _linked(place: Path, random: Random) -> None:
    target = place.with_name(f"{place.name}.elsewhere")
    place.rename(target)
    place.symlink_to(target)


def _document(place: Path, random: Random) -> None:
    place.write_text(random.choice(["[]", "{}", "null", "7", '"text"', "NaN", "[" * 30_000, "[{}]"]))


def _not_finite(place: Path, random: Random) -> None:
    """A number that is not finite in place of a value."""
    about = json.loads(place.read_text("utf-8"))
    parent, key = _position(about, random)
    parent[key] = "@"
    place.write_text(json.dumps(about).replace('"@"', random.choice(_NOT_FINITE), 1))


def _value(place: Path, random: Random) -> None:
    """A value of another type."""
    about = json.loads(place.read_text("utf-8"))
    parent, key = _position(about, random)
    parent[key] = random.choice([other for other in _OTHER if type(other) is not type(parent[key])])
    _seal(place, about, random)


def _key(place: Path, random: Random) -> None:
    """A value less, or one more."""
    about = json.loads(place.read_text("utf-8"))
    parent, key = _position(about, random)
    if isinstance(parent, list):
        parent.append(parent[key])
    elif random.random() < 0.7:
        del parent[key]
    else:
        parent[f"{key}2"] = parent[key]
    _seal(place, about, random)


def _seal(place: Path, about: Any, random: Random) -> None:
    if place.name in ("manifest.json", "run.json") and random.random() < 0.5:
        about["digest"] = manifest.seal(about)
    place.write_text(json.dumps(about))


def _position(tree: Any, random: Random) -> tuple[Any, Any]:
    """A random container in plain data, and a key or index of it."""
    keys = list(tree) if isinstance(tree, dict) else range(len(tree))
    key = random.choice(keys)
    if isinstance(tree[key], (dict, list)) and tree[key] and random.random() < 0.8:
        return _position(tree[key], random)
    return tree, key


def _array(place: Path, random: Random) -> None:
    """An array of another shape or type, or with NaN."""
    array = np.load(place)
    others: Sequence[Any] = (
        array[None], array.ravel(), array[:0], array.T, array.astype(np.float64), array.astype(np.int8),
        np.full(array.shape, np.nan), np.array("text"), np.float32(1),
    )  # fmt: skip
    np.save(place, random.choice(others))


def _picture(place: Path, random: Random) -> None:
    """A picture of another size or type."""
    other = random.choice([np.zeros((3, 5, 3), np.uint8), np.zeros((1, 1), np.uint16), np.zeros((96, 96, 4), np.uint8)])
    _write(place, cv2.imencode(".png", other)[1].tobytes())


def _channels(place: Path, random: Random) -> None:
    """Channels of another size or name, or with NaN."""
    found = exr.read(place)
    name, plane = next(iter(found.items()))
    others = ({key: np.full_like(one, np.nan) for key, one in found.items()}, {name: plane}, {"odd": plane},
              {key: np.ascontiguousarray(one[1:]) for key, one in found.items()})  # fmt: skip
    place.unlink()
    exr.write(place, random.choice(others), half=False)


def tried(template: Path, number: int, seed: int) -> dict[str, Any]:
    """One change, and the faults of the commands after it."""
    random = Random(f"{seed} {number}")
    every = places(template)
    every += [place for place in every if place.endswith(".json")] * 2  # with many keys each
    order = Random(seed).sample(every, len(every))
    with tempfile.TemporaryDirectory() as name:
        root, what = Path(name) / "tree", order[number % len(order)]
        shutil.copytree(template, root)
        kind, change = random.choice(list(random.choice(changes(root / what)).items()))
        change(root / what, random)
        codes, faults = [], []
        for words in commands(root, random):
            code, printed = run(*words)
            codes.append(code)
            lines = [line for line in printed.splitlines() if line.startswith(("polcap: error", "polcap: bug"))]
            if code not in (0, 2, 3) or "Traceback" in printed or "polcap: bug" in printed or len(lines) > 1:
                faults.append(f"{what} {kind}: {words[0]}: exit {code}: {printed[-300:]}")
        for place, folders, _ in os.walk(root):  # the temporary folder is removed
            for folder in folders:
                if not os.path.islink(os.path.join(place, folder)):
                    os.chmod(os.path.join(place, folder), 0o755)
        return {"seed": seed, "number": number, "what": what, "kind": kind, "codes": codes, "faults": faults}


def main() -> None:
    """Run the campaign."""
    stated = arguments(__doc__, changes=300, seed=0, rows=Rows())
    with tempfile.TemporaryDirectory() as name:
        make_template(Path(name))
        complete(Path(name))
        ended = stated.rows.done("seed", "number")
        for number in range(stated.changes):
            if (stated.seed, number) not in ended:
                row = tried(Path(name), number, stated.seed)
                stated.rows.add(row)
                for fault in row["faults"]:
                    print(f"{number}: {fault}", flush=True)
    codes = Counter(code for row in stated.rows.all for code in row["codes"])
    print(table(sorted(codes.items()), ("exit code", "commands")))
    count = sum(bool(row["faults"]) for row in stated.rows.all)
    print(f"{len(stated.rows.all)} changes, {count} with a fault")
    sys.exit(count > 0)


if __name__ == "__main__":
    main()
