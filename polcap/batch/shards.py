"""Shards: the part of a batch that this process handles, from `--shard K/N` or a scheduler's environment."""

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

from polcap.errors import SettingError

T = TypeVar("T")
COUNT = "POLCAP_SHARDS"  # set by the user where a scheduler states the index of a task only
# variable of a task's index, the first index, variable of the number of tasks
_SCHEDULERS = (
    ("SLURM_ARRAY_TASK_ID", 0, "SLURM_ARRAY_TASK_COUNT"),
    ("AWS_BATCH_JOB_ARRAY_INDEX", 0, "AWS_BATCH_JOB_ARRAY_SIZE"),
    ("JOB_COMPLETION_INDEX", 0, COUNT),  # Kubernetes
    ("PBS_ARRAY_INDEX", 1, COUNT),
    ("PBS_ARRAYID", 1, COUNT),  # Torque; its option -t must begin with 1
)


class Shard(NamedTuple):
    """Part `place` of `total` equal parts of a list of captures."""

    place: int  # from 0
    total: int

    def __str__(self) -> str:
        return f"{self.place + 1}/{self.total}"

    def of(self, items: Sequence[T]) -> list[T]:
        """The items of this shard: every `total`-th item, so that large captures spread over all shards."""
        return list(items[self.place :: self.total])


WHOLE = Shard(0, 1)


def parse(text: str) -> Shard:
    """Parse a shard from text K/N; K counts from 1. Raises SettingError."""
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise SettingError(f"--shard {text}: give K/N with K from 1 to N, as 3/16")
    return Shard(int(found[1]) - 1, int(found[2]))


def from_environment(environment: Mapping[str, str]) -> Shard:
    """The shard assigned by Slurm, AWS Batch, Kubernetes or PBS; `WHOLE` without such a scheduler.

    Kubernetes indexed jobs and PBS arrays do not state the number of tasks: `POLCAP_SHARDS` must hold it.

    Raises SettingError: the number of tasks is missing, or the index is not below it.
    """
    for name, first, total in _SCHEDULERS:
        if not environment.get(name):
            continue
        if not environment.get(total):
            raise SettingError(f"{name}={environment[name]} gives the shard, but not the number of shards; set {total}")
        place = _number(environment, name) - first
        if name.startswith("SLURM"):  # --array=10-40:10
            start = _number(environment, "SLURM_ARRAY_TASK_MIN", "0")
            place = (place - start) // max(_number(environment, "SLURM_ARRAY_TASK_STEP", "1"), 1)
        shard = Shard(place, _number(environment, total))
        if not 0 <= shard.place < shard.total:
            raise SettingError(f"{name} means shard {place + 1} of {shard.total}; number the tasks 1 to {shard.total}")
        return shard
    return WHOLE


def _number(environment: Mapping[str, str], name: str, default: str = "") -> int:
    """A whole number from an environment variable. Raises SettingError: its value is none."""
    text = environment.get(name) or default
    try:
        return int(text)
    except ValueError:
        raise SettingError(
            f"the environment variable {name}={text} is not a whole number; correct it, or give --shard K/N"
        ) from None
