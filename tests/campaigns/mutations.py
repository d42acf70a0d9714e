"""Mutation campaigns: sound bytes are damaged as by a bad card, cable or attacker, and go through polcap's parsers.

A parser may return a value or raise one of its declared errors, within its time limit.
"""

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

from polcap.errors import PolcapError
from tests.experiments import Rows, processor_s, table

_TOKENS = (
    b"nan", b"inf", b"-1", b"1e999", b"9" * 40, b"null", b"[[[[", b"{", b'"', b"\\", b"\n", b"\0", b"../", b"\x1b[2J",
    b"\xff", b"true", b"''", b"0x", b"=", b"\xed\xa0\x80", b"9" * 5000,
)  # fmt: skip
_EDGES = (0, 1, 0x7F, 0x80, 0xFF)
_ANY, _IN_PLACE = range(8), (0, 1, 2, 5)


def mutated(data: bytes, random: Random, most: int = 8, in_place: bool = False) -> bytes:
    """One to `most` changes: bytes flipped or set to an edge, parts cut, doubled, filled, swapped, tokens put in.

    `in_place` changes move no byte, so that offsets in a binary file stay correct.
    """
    out = bytearray(data)
    for _ in range(random.randint(1, most)):
        if not out:
            return bytes(out)
        at = _position(len(out), random)
        length = min(int(2 ** (12 * random.random())), len(out) - at)
        kind = random.choice(_IN_PLACE if in_place else _ANY)
        if kind == 0:
            out[at] ^= 1 << random.randrange(8)
        elif kind == 1:
            out[at] = random.choice(_EDGES)
        elif kind == 2:
            out[at : at + 4] = random.randbytes(4)
        elif kind == 3:
            del out[at : at + length]
        elif kind == 4:
            out[at:at] = out[at : at + length]
        elif kind == 5:
            out[at : at + length] = bytes([random.choice(_EDGES)]) * length
        elif kind == 6:
            out[at:at] = random.choice(_TOKENS)
        else:
            del out[at : None if random.random() < 0.3 else at + 1]
    return bytes(out)


def _position(size: int, random: Random) -> int:
    """A random position, mostly near the beginning, where headers are."""
    reach = min(size, 600) if random.random() < 0.7 else size
    return random.randrange(reach)


@dataclass(frozen=True)
class Target:
    """Sound bytes, and a parser for them."""

    seeds: tuple[bytes, ...]
    run: Callable[[bytes, Path], object]  # may write into the folder
    declared: tuple[type[Exception], ...] = (PolcapError,)
    limit_s: float = 1.0  # of one execution
    share: float = 1.0  # of the executions: less for a slow parser
    mend: Callable[[bytes], bytes] = bytes  # correction after a mutation, so that a decoder reads further


def campaign(
    targets: dict[str, Target], runs: int, seed: int, rows: Rows, batch: int, clock: Callable[[], float]
) -> int:
    """Run mutations by the targets' shares, print a table; returns the number of failures."""
    done = rows.done("seed", "target", "batch")
    each = runs / sum(target.share for target in targets.values())
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as place:
        for name, target in targets.items():
            for sound in target.seeds:
                target.run(sound, Path(place))
            for number in range(ceil(target.share * each / batch)):
                if (seed, name, number) not in done:
                    random = Random(f"{seed} {name} {number}")
                    found = _batch(target, batch, random, Path(place), clock)
                    rows.add({"seed": seed, "target": name, "batch": number, **found})
    columns = ("runs", "value", "refused", "died", "failure")
    lines = []
    for name in dict.fromkeys(row["target"] for row in rows.all):
        of_it = [row for row in rows.all if row["target"] == name]
        slowest = max(row["slowest"] for row in of_it)
        lines.append((name, *(sum(row[column] for row in of_it) for column in columns), f"{1e3 * slowest:.0f}"))
    print(table(lines, ("target", *columns, "slowest, ms")))
    failures = sum(int(row["failure"]) for row in rows.all)
    print(
        f"{sum(row['runs'] for row in rows.all)} runs, {failures} failures, now {processor_s():.0f} s of processor time"
    )
    return failures


def _batch(target: Target, runs: int, random: Random, folder: Path, clock: Callable[[], float]) -> dict[str, Any]:
    """Numbers of outcomes, and the time of the slowest execution [s]."""
    seen = Counter({"runs": runs, "value": 0, "refused": 0, "died": 0, "failure": 0})
    slowest = 0.0
    for _ in range(runs):
        data = target.mend(mutated(random.choice(target.seeds), random, most=4, in_place=random.random() < 0.5))
        start, failure = clock(), ""
        try:
            target.run(data, folder)
            seen["value"] += 1
        except target.declared as error:
            seen["died" if "the decoder" in str(error) or "not decoded within" in str(error) else "refused"] += 1
        except Exception:
            failure = traceback.format_exc()
        slowest = max(slowest, clock() - start)
        if clock() - start > target.limit_s:
            failure += f"{clock() - start:.1f} s"
        if failure:
            seen["failure"] += 1
            stored = Path(tempfile.gettempdir()) / f"polcap-fuzz-{time.time_ns()}"
            stored.write_bytes(data)
            print(f"{stored}\n{failure}")
    return {**seen, "slowest": round(slowest, 4)}
