"""How often `polcap check` is right on simulated captures, half of which have one planted fault.

python tests/benchmarks/bench_check.py FOLDER [--good 20] [--faulty 20] [--first-seed 100] [--width 640]

FOLDER keeps the captures, outside the repository. Prints a table and the score in Markdown.
"""

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from polcap import check, pipeline
from polcap.config import Config
from polcap.errors import InputError
from polcap.formats import capture as captures
from tests import faulty


def main() -> None:
    parse = argparse.ArgumentParser()
    parse.add_argument("folder", type=Path)
    parse.add_argument("--good", type=int, default=20)
    parse.add_argument("--faulty", type=int, default=20)
    parse.add_argument("--first-seed", type=int, default=100)
    parse.add_argument("--width", type=int, default=640)
    parse.add_argument("--only", default="")
    told = parse.parse_args()
    kinds = list(faulty.FAULTS)
    plan = ["" for _ in range(told.good)] + [kinds[i % len(kinds)] for i in range(told.faulty)]
    network = pipeline.load_network(None, None, "cpu", 2)
    print("| seed | planted | | said | because of | right |\n| --- | --- | --- | --- | --- | --- |")
    verdicts = reasons = asked = 0
    for seed, fault in enumerate(plan, told.first_seed):
        if told.only and fault != told.only:
            continue
        place = told.folder / f"{seed}-{fault or 'good'}-{told.width}"
        note = place / "planted.txt"
        if not note.exists():
            note.parent.mkdir(parents=True, exist_ok=True)
            note.write_text(faulty.shoot(place, seed, fault, told.width))
        said, because, figures = judge(place, network)
        right = (said == "keep") == (not fault)
        reason = right and (not fault or not faulty.FAULTS[fault] or bool(set(because) & set(faulty.FAULTS[fault])))
        asked, verdicts, reasons = asked + 1, verdicts + right, reasons + reason
        done = note.read_text() if fault else ""
        mark = "yes" if reason else "verdict only" if right else "NO"
        print(f"| {seed} | {fault} | {done} | {said} | {'; '.join(figures)} | {mark} |", flush=True)
    print(f"\nright verdict {verdicts} of {asked}, for the right reason {reasons} of {asked}")


def judge(place: Path, network: object) -> tuple[str, list[str], list[str]]:
    """What is said, the lines that say it, and their words."""
    try:
        verdict = check.inspect(captures.read(place), network, Config())  # type: ignore[arg-type]
    except InputError as error:
        return "bad input", [], [str(error).replace(str(place), "…")[:90]]
    bad = [line for line in verdict.lines if line.state == "reshoot"]
    return "keep" if verdict.keep else "reshoot", [b.name for b in bad], [f"{b.name}: {b.says[:70]}" for b in bad]


if __name__ == "__main__":
    main()
