"""Rows of a campaign in a file, one JSON object a line, so that the campaign can be stopped and continued."""

import argparse
import json
import os
import resource
from pathlib import Path
from typing import Any

from polcap.synth import scenes, shooting


class Rows:
    """Results so far; without a file they are lost at the end."""

    def __init__(self, file: Path | None) -> None:
        self._file = file
        lines = file.read_text(encoding="utf-8").splitlines() if file is not None and file.exists() else []
        self.all: list[dict[str, Any]] = [json.loads(line) for line in lines]

    def add(self, row: dict[str, Any]) -> None:
        """Store a row on the disk, whatever ends the campaign."""
        self.all.append(row)
        if self._file is None:
            return
        with self._file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            os.fsync(stream.fileno())

    def done(self, *keys: str) -> set[tuple[Any, ...]]:
        """Values of these columns in all rows."""
        return {tuple(row.get(key) for key in keys) for row in self.all}


def arguments(text: str | None, *flags: str, **usual: Any) -> argparse.Namespace:
    """Options of a campaign from the command line: flags, numbers and texts with their defaults, and --rows FILE."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in flags:
        parser.add_argument(f"--{name}", action="store_true")
    for name, value in usual.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=type(value), default=value)
    parser.add_argument("--rows", type=lambda file: Rows(Path(file)), default=Rows(None))
    return parser.parse_args()


def processor_s() -> float:
    """Processor time of this process and of its children that ended."""
    spent = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in spent)


def table(rows: list[tuple[Any, ...]], names: tuple[str, ...]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(names) + " |", "|" + " --- |" * len(names)]
    return "\n".join([*lines, *("| " + " | ".join(map(str, row)) + " |" for row in rows)])


def small_capture(folder: Path, seed: int = 0) -> None:
    """Write a capture of 320 × 240 px in one exposure, which `polcap process` finishes in three seconds."""
    shoot = shooting.Shoot(seed=seed, width=320, height=240, samples=1, exposures=1)
    shooting.write(folder, scenes.random_scene(seed, "bumps"), shoot)
