"""Foreign files, links and captures in and around results; then commands in any order: every foreign byte stays.

python -m tests.campaigns.users_files [--sequences 1000] [--seed 0] [--rows FILE]

Each sequence starts from a capture, with or without a result. Files, folders and links that polcap did not write are
put at random places, also under polcap's own names. After one to four commands all of them must be as they were, and
no command may end with exit code 1.
"""

import contextlib
import io
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polcap import cli
from polcap.formats import own_files
from polcap.synth import scenes, shooting
from tests.experiments import Rows, arguments

_PLACES = (
    ".", "maps", "work", "asset", "work/01-hdr", "work/04-mask", "work/10-app", "asset/web", "asset/C_iiif",
    "../polcap-batch", "../polcap-batch/records", "../polcap-batch/thumbnails", "..", "../pol000",
)  # fmt: skip
_NAMES = (
    "notes.txt", "IMG_1.DNG", ".bashrc.old", ".ssh.old", ".maps.7.part", ".report.7.part.html", "report.json",
    "report.html", "color.toml", "compare.html", "maps.json", "manifest.json", "normal.png", "C.glb", "value.npy",
    "run.json", "unchanged.json", "lock", "owner", "batch.json", "summary.html", "summary.csv", "hdr.png", "light.webp",
    "value.value.npy", "C.provenance.json", "info.json", "polcap-files.txt", "desktop.ini",
)  # fmt: skip
_LINKED = ("maps", "asset", "work", "work/01-hdr", "asset/web", "../polcap-batch", "../polcap-batch/records")
Snapshot = dict[str, str | bytes]  # content, or a link's target, by path


def run(*words: object) -> tuple[int, str]:
    """Exit code and messages of a command that runs in this process."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(printed):
        try:
            cli.app([*map(str, words), "-q"])
        except SystemExit as ended:
            return int(ended.code or 0), printed.getvalue()
    return 0, printed.getvalue()


def make_template(folder: Path) -> None:
    """A capture of 96 × 96 px, C, with a result that polcap has finished."""
    shoot = shooting.Shoot(seed=1, width=96, height=96, samples=1, exposures=1)
    shooting.write(folder / "C", scenes.random_scene(1, "bumps"), shoot)
    assert run("process", folder / "C", "--no-chart", "--estimator", "analytic")[0] in (0, 3)


def plant(root: Path, random: np.random.Generator) -> None:
    """Put foreign files, folders and links at random places around the result root/C/polcap."""
    result = root / "C" / "polcap"
    for _ in range(int(random.integers(1, 9))):
        place = result / _PLACES[random.integers(len(_PLACES))]
        name = _NAMES[random.integers(len(_NAMES))]
        with contextlib.suppress(OSError):  # the place is a link, or the name is taken
            place.mkdir(parents=True, exist_ok=True)
            with (place / name).open("xb") as file:
                file.write(random.bytes(20))
    if random.random() < 0.3:  # a link in a result
        link = result / _LINKED[random.integers(len(_LINKED))]
        target = root / "elsewhere" / link.name
        if link.is_dir():
            target.parent.mkdir(exist_ok=True)
            link.rename(target)
        target.mkdir(parents=True, exist_ok=True)
        (target / "foreign").write_bytes(random.bytes(20))
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(target)
    if random.random() < 0.2:  # a single file replaced by a link
        files = [path for path in result.rglob("*") if path.is_file()] if result.is_dir() else []
        if files:
            link = files[random.integers(len(files))]
            link.rename(root / "linked")
            link.symlink_to(root / "linked")
    if random.random() < 0.2:  # a capture within
        with contextlib.suppress(FileExistsError):
            shutil.copytree(root / "C" / "pol000", result / "maps" / "pol000")


def foreign(root: Path, recorded: set[str]) -> Snapshot:
    """All files and links below a folder that polcap has not recorded."""
    found: Snapshot = {}
    for place, folders, files in os.walk(root):
        for name in [*folders, *files]:
            path = Path(place, name)
            relative = path.relative_to(root).as_posix()
            if path.is_symlink():
                found[relative] = f"link to {os.readlink(path)}"
            elif path.is_file() and relative not in recorded:
                found[relative] = path.read_bytes()
    return found


def commands(root: Path, random: np.random.Generator) -> Iterator[tuple[object, ...]]:
    """Commands on the capture, its result and their surroundings, in any order."""
    capture, result, out = root / "C", root / "C" / "polcap", root / "out"
    quick = ("--no-chart", "--estimator", "analytic")
    profile = result / "color.toml"
    choices: list[tuple[object, ...]] = [
        ("process", capture, *quick), ("process", capture, *quick, "--set", "mask.margin=0.1"),
        ("process", capture, *quick, "--until", "mask"), ("process", capture, *quick, "-o", root),
        ("process", capture, *quick, "-o", out), ("process", capture, *quick, "-o", capture / "pol000" / "x"),
        ("process", result / "maps", "-o", result, *quick), ("process", capture, "--chart", profile),
        ("export", result, "--obj"), ("export", result, "--preset", "web"), ("export", capture, "--iiif", "http://a.b"),
        ("clean", result), ("clean", root), ("clean", result, "--dry-run"), ("batch", root, *quick),
        ("batch", root, "--out", out, *quick), ("fuse", root), ("fuse", root, "--out", root), ("report", result),
        ("report", result, "--compare", result), ("show", result, "mask"), ("show", result, "--all"),
        ("show", result, "--animate", "light"), ("board", result), ("status", result), ("check", capture),
        ("synth", result, "--set", "width=64", "--set", "height=64"),
    ]  # fmt: skip
    slow = np.array([words[0] in ("batch", "fuse") for words in choices])  # they start processes
    share = np.where(slow, 0.2, 1.0)
    for number in random.choice(len(choices), int(random.integers(1, 5)), p=share / share.sum()):
        yield choices[number]


def sequence(template: Path, seed: int) -> list[str]:
    """Faults of one sequence: foreign files that changed, and commands that ended with a bug."""
    random = np.random.default_rng([seed, 44])
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        shutil.copytree(template, root, dirs_exist_ok=True)
        result, recorded = root / "C" / "polcap", set[str]()
        if random.random() < 0.4:
            shutil.rmtree(result)
        else:
            lines = (result / own_files.RECORD).read_text().splitlines()[1:]
            names = [*(line.partition("\t")[0] for line in lines), own_files.RECORD]
            recorded = {f"C/polcap/{name}" for name in names}
        plant(root, random)
        before, done, faults = foreign(root, recorded), [], []
        for words in commands(root, random):
            done.append(" ".join(str(word).replace(name, "") for word in words))
            code, printed = run(*words)
            if code == 1:
                faults.append(f"seed {seed}: exit 1 after {done}: {printed}")
        after = foreign(root, set())
        faults += [f"seed {seed}: {file} changed by {done}" for file in before if after.get(file) != before[file]]
        return faults


def main() -> None:
    """Run the campaign."""
    stated = arguments(__doc__, sequences=1000, seed=0, rows=Rows())
    with tempfile.TemporaryDirectory() as name:
        make_template(Path(name))
        ended = stated.rows.done("seed")
        for seed in range(stated.seed, stated.seed + stated.sequences):
            if (seed,) not in ended:
                faults = sequence(Path(name), seed)
                stated.rows.add({"seed": seed, "faults": faults})
                for fault in faults:
                    print(fault, flush=True)
        count = sum(bool(row["faults"]) for row in stated.rows.all)
        print(f"{len(stated.rows.all)} sequences, {count} with a fault")
        sys.exit(count > 0)


if __name__ == "__main__":
    main()
