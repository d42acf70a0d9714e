"""Shards: the part of a batch that this process handles, from `--shard K/N` or a scheduler's environment."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from polcap.errors import SettingError

T = TypeVar("T")
COUNT = "POLCAP_SHARDS"  # set by the user where a scheduler states the index of a task only


@dataclass(frozen=True)
class Shard:
    """One of `count` equal parts of a list."""

    index: int  # from 0
    count: int

    def __str__(self) -> str:
        return f"{self.index + 1}/{self.count}"

    def of(self, items: Sequence[T]) -> list[T]:
        """Every `count`-th item, so that large captures spread over all parts."""
        return list(items[self.index :: self.count])


WHOLE = Shard(0, 1)


def parse(text: str) -> Shard:
    """Read K/N; K counts from 1.

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
    """The shard assigned by Slurm, AWS Batch, Kubernetes or PBS; `WHOLE` without such a scheduler.

    Slurm and AWS Batch state index and count. Kubernetes indexed jobs and PBS arrays state the index only, so
    `POLCAP_SHARDS` must hold the count; job files written by polcap set it. PBS counts from 1, and Torque from the
    first number of its option -t, which must be 1.

    Raises
    ------
    SettingError
        The count is missing, or the index is not below it.
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
                raise SettingError(f"{name}={known[name]} gives the shard, but not the number of shards; set {COUNT}")
            return _checked(name, _number(known, name) - first, _number(known, COUNT))
    return WHOLE


def _number(known: Mapping[str, str], name: str, otherwise: int | None = None) -> int:
    if name not in known and otherwise is not None:
        return otherwise
    try:
        return int(known[name])
    except ValueError:
        raise SettingError(f"{name}={known[name]} is not a whole number; give --shard K/N") from None


def _checked(name: str, index: int, count: int) -> Shard:
    if not 0 <= index < count:
        raise SettingError(f"{name} means shard {index + 1} of {count}; number the tasks 1 to {count}")
    return Shard(index, count)
