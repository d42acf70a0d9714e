"""In: `--shard K/N`, or what a cluster's scheduler put into the environment. Out: which captures are this process's."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from polcap.errors import SettingError

T = TypeVar("T")
COUNT = "POLCAP_SHARDS"  # for schedulers that tell a task its index, but not how many there are


@dataclass(frozen=True)
class Shard:
    """One of `count` equal parts of a list."""

    index: int  # from 0
    count: int

    def __str__(self) -> str:
        return f"{self.index + 1}/{self.count}"

    def of(self, items: Sequence[T]) -> list[T]:
        """Every `count`-th item, so that parts stay equal whatever the order means."""
        return list(items[self.index :: self.count])


WHOLE = Shard(0, 1)


def parse(text: str) -> Shard:
    """K/N, counted from 1.

    Raises
    ------
    SettingError
        Not two whole numbers, or K outside 1…N.
    """
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise SettingError(f"--shard {text}: give K/N with K from 1 to N, as 3/16")
    return Shard(int(found[1]) - 1, int(found[2]))


def from_environment(environment: Mapping[str, str]) -> Shard:
    """The part that Slurm, AWS Batch, Kubernetes or PBS gave this process; the whole where none did.

    Slurm tells an array task its id, the least id, the step and the count; AWS Batch index and size. A task of a
    Kubernetes indexed job or of a PBS array knows its index only: `POLCAP_SHARDS` says of how many, and job
    files written by polcap set it. PBS counts from 1 (Torque from whatever `-t` says: take 1 there).

    Raises
    ------
    SettingError
        An index without a count, or beyond it.
    """
    known = {name: value for name, value in environment.items() if value}
    if "SLURM_ARRAY_TASK_ID" in known and "SLURM_ARRAY_TASK_COUNT" in known:
        first, step = _number(known, "SLURM_ARRAY_TASK_MIN", 0), _number(known, "SLURM_ARRAY_TASK_STEP", 1)
        index = (_number(known, "SLURM_ARRAY_TASK_ID") - first) // max(step, 1)
        return _checked("SLURM_ARRAY_TASK_ID", index, _number(known, "SLURM_ARRAY_TASK_COUNT"))
    if "AWS_BATCH_JOB_ARRAY_INDEX" in known and "AWS_BATCH_JOB_ARRAY_SIZE" in known:
        name = "AWS_BATCH_JOB_ARRAY_INDEX"
        return _checked(name, _number(known, name), _number(known, "AWS_BATCH_JOB_ARRAY_SIZE"))
    for name, first in (("JOB_COMPLETION_INDEX", 0), ("PBS_ARRAY_INDEX", 1), ("PBS_ARRAYID", 1)):
        if name in known:
            if COUNT not in known:
                raise SettingError(f"{name}={known[name]} says which shard, nothing says of how many; set {COUNT}")
            return _checked(name, _number(known, name) - first, _number(known, COUNT))
    return WHOLE


def _number(known: Mapping[str, str], name: str, otherwise: int | None = None) -> int:
    if name not in known and otherwise is not None:
        return otherwise
    try:
        return int(known[name])
    except ValueError:
        raise SettingError(f"{name}={known[name]} is no whole number; give --shard K/N") from None


def _checked(name: str, index: int, count: int) -> Shard:
    if not 0 <= index < count:
        raise SettingError(f"{name} stands for shard {index + 1} of {count}; number the tasks 1 to {count}")
    return Shard(index, count)
