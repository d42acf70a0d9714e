"""In: training data, and a model to start from. Out: one small folder that trains where there is no network, in pieces.

    python -m polcap.training.pack DATA PACK [--start MODEL.onnx] [--wheels FOLDER] [--minutes 30] [--piece 9] …
    python PACK/run.py OUT      there, again and again: each run goes on where the one before it stopped

The folder holds polcap's own source, meshes, texture sets of at most 512², the model and the wheels that were given;
run.py unpacks those, names what is missing before it begins, and leaves the checkpoint in parts that fit through a
narrow door. A folder OUT that came back as its parts alone is put together again.
"""

import argparse
import hashlib
import importlib.util
import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2

import polcap
from polcap.errors import InputError
from polcap.formats import atomic, shipped_data
from polcap.training import train

LARGEST = 60_000_000  # bytes of a pack
PART = 16 * 2**20  # bytes of a part of a checkpoint
SIDE = 512  # px of a texture, at most
NEEDED = (
    "torch", "numpy", "scipy", "cv2", "colour", "embreex", "onnx", "msgspec", "array_api_compat", "filelock", "tomli_w",
)  # fmt: skip
_RUN = '''"""Train from this pack until one piece is over: python run.py OUT"""

import sys
import zipfile
from pathlib import Path

here = Path(__file__).resolve().parent
for wheel in sorted((here / "wheels").glob("*.whl")):
    if not (here / "site" / wheel.stem).exists():
        zipfile.ZipFile(wheel).extractall(here / "site")
        (here / "site" / wheel.stem).touch()
sys.path[:0] = [str(here)]
sys.path.append(str(here / "site"))

from polcap.training import pack

print(pack.go_on(here, Path(sys.argv[1])))
'''


@dataclass(frozen=True)
class Plan:
    """How a pack trains; stands in pack.json."""

    preset: str = "gpu"
    minutes: float = 30.0  # all pieces together
    piece: float = 9.0
    views: int = 12  # of each mesh: tracing them all is part of the first piece
    procedural: int = 100
    samples: int | None = None  # the budget in pictures instead of minutes
    threads: int = 1


def make(data: Path, out: Path, plan: Plan, start: Path | None = None, wheels: Path | None = None) -> int:
    """Write the pack; returns its size in bytes.

    Parameters
    ----------
    data
        Holds meshes/train, meshes/test (to look at) and materials/train.
    out
        Folder of the pack, which is not there yet.
    plan
        Preset, minutes and number of views.
    start
        ONNX model whose weights are the first.
    wheels
        Folder of *.whl for the machine that trains.

    Raises
    ------
    InputError
        There is no mesh, the folder is there, or the pack would be too large.
    """
    if out.exists():
        raise InputError(f"{out} is there already; name a new folder for the pack")
    for split in ("train", "test"):
        if not any((data / "meshes" / split).glob("*.npz")):
            raise InputError(f"{data / 'meshes' / split} holds no mesh; the pack needs some to train on and to look at")
    with atomic.folder(out) as beside:
        shutil.copytree(
            Path(polcap.__file__).parent, beside / "polcap", ignore=shutil.ignore_patterns("__pycache__", "*.onnx")
        )
        copied = Path("polcap", "_calib", "colorchecker")
        if not (beside / copied).exists():  # a checkout has them beside the package
            shutil.copytree(shipped_data.data_path("colorchecker"), beside / copied)
        for split in ("train", "test"):
            shutil.copytree(data / "meshes" / split, beside / "data" / "meshes" / split)
        for picture in sorted((data / "materials" / "train").glob("*/*.jpg")):
            _smaller(picture, beside / "data" / "materials" / "train" / picture.parent.name / picture.name)
        if start is not None:
            shutil.copyfile(start, beside / "start.onnx")
        for wheel in sorted(wheels.glob("*.whl")) if wheels is not None else []:
            (beside / "wheels").mkdir(exist_ok=True)
            shutil.copy(wheel, beside / "wheels")
        (beside / "pack.json").write_text(json.dumps(asdict(plan), indent=1) + "\n", encoding="utf-8")
        (beside / "run.py").write_text(_RUN, encoding="utf-8")
        size = sum(file.stat().st_size for file in beside.rglob("*") if file.is_file())
        if size > LARGEST:
            raise InputError(
                f"the pack would have {size / 1e6:.0f} MB, more than {LARGEST / 1e6:.0f}; give fewer wheels"
            )
    return size


def go_on(pack: Path, out: Path) -> str:
    """Train one piece from a pack; says how far it is.

    Raises
    ------
    InputError
        A module is missing on this machine, or a part of the checkpoint is lost or damaged.
    """
    missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
    if missing:
        raise InputError(f"this machine lacks {', '.join(missing)}; put their wheels into {pack / 'wheels'}")
    plan = Plan(**json.loads((pack / "pack.json").read_text(encoding="utf-8")))
    last, parts, start = out / "last.pt", out / "parts", pack / "start.onnx"
    if not last.exists() and parts.exists():
        join(parts, last)
    made = train.main(
        train.Params(
            preset=plan.preset, data=pack / "data", out=out, minutes=plan.minutes, samples=plan.samples,
            piece=plan.piece, resume=last.exists(), start=start if start.exists() and not last.exists() else None,
            threads=plan.threads, views=plan.views, procedural=plan.procedural,
        )
    )  # fmt: skip
    split(last, parts)
    if made == last:
        return f"a piece is done, its checkpoint in {parts}; run this again to go on"
    return f"done: {made}"


def split(file: Path, parts: Path, size: int = PART) -> int:
    """Cut a file into parts.000, … of at most `size` bytes, with their digests in parts.json; returns how many."""
    with atomic.folder(parts) as beside:
        digests: list[str] = []
        with file.open("rb") as whole:
            while data := whole.read(size):
                (beside / f"{len(digests):03d}").write_bytes(data)
                digests.append(hashlib.sha256(data).hexdigest())
        (beside / "parts.json").write_text(json.dumps(digests), encoding="utf-8")
    return len(digests)


def join(parts: Path, file: Path) -> None:
    """Put a file together again.

    Raises
    ------
    InputError
        A part is missing or not what was cut.
    """
    index = parts / "parts.json"
    if not index.exists():
        raise InputError(f"{index} is missing: copy the whole folder of parts")
    with atomic.path(file) as beside, beside.open("wb") as whole:
        for number, digest in enumerate(json.loads(index.read_text(encoding="utf-8"))):
            part = parts / f"{number:03d}"
            data = part.read_bytes() if part.exists() else b""
            if hashlib.sha256(data).hexdigest() != digest:
                raise InputError(f"{part} is missing or damaged; copy it again")
            whole.write(data)


def _smaller(picture: Path, out: Path) -> None:
    """A texture with its longer side at most SIDE px."""
    out.parent.mkdir(parents=True, exist_ok=True)
    image = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{picture} is no picture; leave its texture set out")
    shrink = SIDE / max(image.shape[:2])
    if shrink >= 1:
        shutil.copyfile(picture, out)
        return
    size = (round(image.shape[1] * shrink), round(image.shape[0] * shrink))
    cv2.imwrite(str(out), cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("pack", type=Path)
    parser.add_argument("--start", type=Path)
    parser.add_argument("--wheels", type=Path)
    parser.add_argument("--preset", choices=sorted(train.PRESETS), default=Plan.preset)
    parser.add_argument("--minutes", type=float, default=Plan.minutes)
    parser.add_argument("--piece", type=float, default=Plan.piece)
    options = parser.parse_args()
    plan = Plan(preset=options.preset, minutes=options.minutes, piece=options.piece)
    size = make(options.data, options.pack, plan, options.start, options.wheels)
    print(f"{options.pack}: {size / 1e6:.1f} MB; there: python run.py OUT, again and again")


if __name__ == "__main__":
    main()
