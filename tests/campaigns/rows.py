"""A campaign's rows in a file, one JSON object a line, so that it can be stopped and gone on with."""

import json
import os
import resource
from pathlib import Path
from typing import Any


class Rows:
    """What has been done so far; without a file it is forgotten at the end."""

    def __init__(self, file: Path | None) -> None:
        self._file = file
        lines = file.read_text(encoding="utf-8").splitlines() if file is not None and file.exists() else []
        self.all: list[dict[str, Any]] = [json.loads(line) for line in lines]

    def add(self, row: dict[str, Any]) -> None:
        """Keep a row, safe from whatever ends the campaign."""
        self.all.append(row)
        if self._file is None:
            return
        with self._file.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")
            stream.flush()
            os.fsync(stream.fileno())

    def done(self, *keys: str) -> set[tuple[Any, ...]]:
        """What stands in these columns."""
        return {tuple(row.get(key) for key in keys) for row in self.all}


def processor_s() -> float:
    """Processor time of this process and of its children that ended."""
    spent = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in spent)
