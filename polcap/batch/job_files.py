"""Job files: the shards of a batch as a job of Slurm, Open Job Description, OpenCue, Snakemake or Kubernetes.

`templates/` holds one file per scheduler. Every shard runs `polcap batch ROOT … --shard K/N`. Exit code 3, a failed
quality gate, counts as success: the asset was written.
"""

import getpass
import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any, Literal
from xml.sax.saxutils import escape

from polcap import __version__
from polcap.batch.shards import COUNT
from polcap.formats import atomic

Scheduler = Literal["slurm", "openjd", "opencue", "snakemake", "kubernetes"]
_FILES: dict[Scheduler, str] = {
    "slurm": "slurm.sh",
    "openjd": "openjd.json",
    "opencue": "opencue.xml",
    "snakemake": "Snakefile",
    "kubernetes": "kubernetes.json",
}
_SUBMIT: dict[Scheduler, str] = {
    "slurm": "sbatch {file}",
    "openjd": "openjd run {file}, or a farm that takes Open Job Description",
    "opencue": "launch it with OpenCue's API: opencue.api.launchSpec(open({literal}).read())",
    "snakemake": "snakemake --snakefile {file} --cores all",
    "kubernetes": "set its image and volume, then kubectl apply -f {file}",
}
_NOT_FOR_SHARDS = ("context", "root", "shard", "write_jobs", "jobs", "json", "scheduler")  # options of the command
_DEFAULTS = {"threads": 0, "memory": 0, "workers": 0}


@dataclass(frozen=True)
class BatchJob:
    """One job of a scheduler: the batch command, split into shards."""

    command: tuple[str, ...]  # polcap batch ROOT …, without --shard
    root: Path
    shards: int
    cores: int = 2
    memory_gb: float = 4.0

    @property
    def name(self) -> str:
        """Name of the job: letters, digits and dashes, which every scheduler accepts."""
        return "polcap-" + (re.sub(r"[^a-z0-9]+", "-", self.root.name.lower()).strip("-")[:40] or "batch")

    def shell(self, shard: str = "") -> str:
        """Shell command (/bin/sh) of one shard K/N; "" if environment variables state the shard.

        Exit code 3 of polcap becomes 0.
        """
        return f"{shlex.join(self.command)}{shard and ' --shard ' + shard} || test $? -eq 3"


def batch_command(root: Path, options: Mapping[str, Any]) -> tuple[str, ...]:
    """The command line `polcap batch ROOT …` with its options, named as in `cli.batch_command`."""
    words = ["polcap", "batch", str(root.resolve())]
    for name, value in options.items():
        if name == "keep_going":
            words += [] if value else ["--fail-fast"]
            continue
        unset = value is None or value is False or value in ([], ()) or value == _DEFAULTS.get(name)
        if unset or name in _NOT_FOR_SHARDS:
            continue
        flag = "--set" if name == "assignments" else "--" + name.replace("_", "-")
        if isinstance(value, list | tuple):
            words += [word for one in value for word in (flag, str(one))]
        elif value is True:
            words.append(flag)
        else:
            words += [flag, str(value.resolve() if isinstance(value, Path) else value)]
    return tuple(words)


def submit_hint(scheduler: Scheduler, file: Path) -> str:
    """A sentence that explains how to submit the job file to the scheduler."""
    return _SUBMIT[scheduler].format(file=shlex.quote(str(file)), literal=repr(str(file)))


def write(scheduler: Scheduler, job: BatchJob, folder: Path) -> Path:
    """Write a job file from the scheduler's template; returns its path."""
    template = files("polcap.batch").joinpath("templates", _FILES[scheduler]).read_text(encoding="utf-8")
    text = Template(template).substitute(_fields(scheduler, job, folder))
    atomic.write(folder / _FILES[scheduler], text)
    return folder / _FILES[scheduler]


def _fields(scheduler: Scheduler, job: BatchJob, folder: Path) -> dict[str, Any]:
    """Values of the job template's placeholders, escaped for the template's language."""
    return {
        "name": job.name,
        "shards": job.shards,
        "cores": job.cores,
        "memory_gb": f"{job.memory_gb:g}",
        "memory_mb": round(job.memory_gb * 1000),
        "memory_mib": round(job.memory_gb * 1024),
        "command": _command(scheduler, job),
        "root": _json(str(job.root)),
        "log": shlex.quote(str(folder / "%x-%a.log")),
        "mark": _json(str(folder / "done" / "{k}-of-").replace('"', '\\"') + str(job.shards)),
        "user": escape(_user()),
        "version": __version__,
        "count_variable": COUNT,
    }


def _command(scheduler: Scheduler, job: BatchJob) -> str:
    """The shell command of a shard, escaped for the template's language."""
    if scheduler == "openjd":
        return _json(job.shell("{{Task.Param.Shard}}/" + str(job.shards)))
    if scheduler == "opencue":  # it replaces #IFRAME# by the frame number, here the shard
        return escape(f"/bin/sh -c {shlex.quote(job.shell(f'#IFRAME#/{job.shards}'))}")
    if scheduler == "snakemake":  # braces are its placeholders, so all but the shard's are doubled
        before, _, after = job.shell("@/" + str(job.shards)).replace("{", "{{").replace("}", "}}").rpartition("@/")
        return _json(f"{before}{{wildcards.k}}/{after}")
    return job.shell() if scheduler == "slurm" else _json(job.shell())


def _json(text: str) -> str:
    """Escape text for the inside of a JSON string, or of a Python string literal."""
    return json.dumps(text, ensure_ascii=False)[1:-1]


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container without a name for its user
        return "polcap"
