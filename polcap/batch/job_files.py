"""In: a batch command and how many shards. Out: the file that a farm's scheduler starts them from.

Each shard runs `polcap batch ROOT … --shard K/N`; a quality gate that failed (exit code 3) is a result, not a
failure of the job.
"""

import getpass
import json
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from xml.sax.saxutils import escape

from polcap import __version__
from polcap.batch.shards import COUNT
from polcap.formats import atomic

Kind = Literal["slurm", "openjd", "opencue", "snakemake", "kubernetes"]
_NAMES: dict[Kind, str] = {
    "slurm": "slurm.sh",
    "openjd": "openjd.json",
    "opencue": "opencue.xml",
    "snakemake": "Snakefile",
    "kubernetes": "kubernetes.json",
}
_SUBMIT: dict[Kind, str] = {
    "slurm": "sbatch {file}",
    "openjd": "openjd run {file}, or a farm that takes Open Job Description",
    "opencue": "launch it with OpenCue's API: opencue.api.launchSpec(open({literal}).read())",
    "snakemake": "snakemake --snakefile {file} --cores all",
    "kubernetes": "set its image and volume, then kubectl apply -f {file}",
}
_OK = "|| test $? -eq 3"


_LEFT_OUT = ("context", "root", "shard", "write_jobs", "jobs", "json", "scheduler")  # of the command's options


_UNSAID = {"threads": 0, "memory": 0, "workers": 0}  # defaults that need no word


def submit(kind: Kind, file: Path) -> str:
    """How a job file is handed to its farm, whatever is in its name."""
    return _SUBMIT[kind].format(file=shlex.quote(str(file)), literal=repr(str(file)))


def command(root: Path, options: Mapping[str, Any]) -> tuple[str, ...]:
    """`polcap batch ROOT …` with the options that were given, by their names in `cli.batch_command`."""
    words = ["polcap", "batch", str(root.resolve())]
    for name, value in options.items():
        if name == "keep_going":
            words += [] if value else ["--fail-fast"]
            continue
        if name in _LEFT_OUT or value is None or value is False or value in ([], ()) or value == _UNSAID.get(name):
            continue
        flag = "--set" if name == "assignments" else "--" + name.replace("_", "-")
        if isinstance(value, list | tuple):
            words += [word for one in value for word in (flag, str(one))]
        elif isinstance(value, bool):
            words.append(flag)
        else:
            words += [flag, str(value.resolve() if isinstance(value, Path) else value)]
    return tuple(words)


@dataclass(frozen=True)
class Job:
    """What the scheduler is asked for."""

    command: tuple[str, ...]  # polcap batch ROOT …, without --shard
    root: Path
    shards: int
    cores: int = 2
    memory_gb: float = 4.0

    @property
    def name(self) -> str:
        """Of letters, digits and dashes, as every scheduler takes it."""
        return "polcap-" + (re.sub(r"[^a-z0-9]+", "-", self.root.name.lower()).strip("-")[:40] or "batch")

    def shell(self, shard: str | None = None) -> str:
        """The command for /bin/sh; `shard` K/N where the environment does not tell it."""
        flags = "" if shard is None else f" --shard {shard}"
        return f"{shlex.join(self.command)}{flags} {_OK}"


def write(kind: Kind, job: Job, folder: Path) -> Path:
    """Write the job file; returns its path. Raises StorageError."""
    text = {
        "slurm": _slurm, "openjd": _openjd, "opencue": _opencue, "snakemake": _snakemake, "kubernetes": _kubernetes
    }[kind](job, folder)  # fmt: skip
    with atomic.path(folder / _NAMES[kind]) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return folder / _NAMES[kind]


def _slurm(job: Job, folder: Path) -> str:
    """Slurm, sbatch(1); the shard comes from SLURM_ARRAY_TASK_ID."""
    return "\n".join(
        [
            "#!/bin/sh",
            f"#SBATCH --job-name={job.name}",
            f"#SBATCH --array=1-{job.shards}",
            "#SBATCH --ntasks=1",
            f"#SBATCH --cpus-per-task={job.cores}",
            f"#SBATCH --mem={round(job.memory_gb * 1000)}M",
            f"#SBATCH --output={shlex.quote(str(folder / '%x-%a.log'))}",
            "#SBATCH --requeue",
            job.shell(),
            "",
        ]
    )


def _openjd(job: Job, folder: Path) -> str:
    """Open Job Description, template schemas 2023-09."""
    run = {"command": "/bin/sh", "args": ["-c", job.shell("{{Task.Param.Shard}}/" + str(job.shards))]}
    amounts = [
        {"name": "amount.worker.vcpu", "min": job.cores},
        {"name": "amount.worker.memory", "min": round(job.memory_gb * 1024)},  # MiB
    ]
    step = {
        "name": "Captures",
        "parameterSpace": {"taskParameterDefinitions": [{"name": "Shard", "type": "INT", "range": f"1-{job.shards}"}]},
        "hostRequirements": {"amounts": amounts},
        "script": {"actions": {"onRun": run}},
    }
    return _json({"specificationVersion": "jobtemplate-2023-09", "name": job.name, "steps": [step]})


def _opencue(job: Job, folder: Path) -> str:
    """OpenCue, job specification cjsl-1.13; #IFRAME# becomes the frame, which is the shard."""
    command = f"/bin/sh -c {shlex.quote(job.shell(f'#IFRAME#/{job.shards}'))}"
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            '<!DOCTYPE spec PUBLIC "SPI Cue Specification Language" "http://localhost:8080/spcue/dtd/cjsl-1.13.dtd">',
            "<spec>",
            "  <facility>local</facility>",
            "  <show>testing</show>",  # the show that every OpenCue is set up with
            "  <shot>polcap</shot>",
            f"  <user>{escape(_user())}</user>",
            f'  <job name="{job.name}">',
            "    <paused>False</paused>",
            "    <maxretries>2</maxretries>",
            "    <layers>",
            '      <layer name="captures" type="Render">',
            f"        <cmd>{escape(command)}</cmd>",
            f"        <range>1-{job.shards}</range>",
            "        <chunk>1</chunk>",
            f"        <cores>{job.cores}</cores>",
            f"        <memory>{job.memory_gb:g}g</memory>",
            "        <services><service>shell</service></services>",
            "      </layer>",
            "    </layers>",
            "  </job>",
            "</spec>",
            "",
        ]
    )


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container without a name for its user
        return "polcap"


def _snakemake(job: Job, folder: Path) -> str:
    """Snakemake; one rule instance per shard, done when its mark is there."""
    mark = str(folder / "done" / "{k}-of-").replace('"', '\\"') + str(job.shards)
    before, _, after = job.shell("@/" + str(job.shards)).replace("{", "{{").replace("}", "}}").rpartition("@/")
    shell = f"{before}{{wildcards.k}}/{after}"
    return "\n".join(
        [
            "rule all:",
            f"    input: expand({json.dumps(mark)}, k=range(1, {job.shards} + 1))",
            "",
            "rule shard:",
            f"    output: touch({json.dumps(mark)})",
            f"    threads: {job.cores}",
            f"    resources: mem_mb={round(job.memory_gb * 1000)}",
            "    retries: 2",
            f"    shell: {json.dumps(shell)}",
            "",
        ]
    )


def _kubernetes(job: Job, folder: Path) -> str:
    """Kubernetes, batch/v1 indexed job; the shard comes from JOB_COMPLETION_INDEX."""
    container = {
        "name": "polcap",
        "image": f"polcap:{__version__}",
        "command": ["/bin/sh", "-c", job.shell()],
        "env": [{"name": COUNT, "value": str(job.shards)}],
        "resources": {
            "requests": {"cpu": str(job.cores), "memory": f"{round(job.memory_gb * 1000)}M"},
            "limits": {"memory": f"{round(job.memory_gb * 1000)}M"},
        },
        "volumeMounts": [{"name": "captures", "mountPath": str(job.root)}],
    }
    template = {
        "spec": {
            "restartPolicy": "Never",
            "containers": [container],
            "volumes": [{"name": "captures", "persistentVolumeClaim": {"claimName": "captures"}}],
        }
    }
    spec = {
        "completionMode": "Indexed",
        "completions": job.shards,
        "parallelism": job.shards,
        "backoffLimitPerIndex": 2,
        "template": template,
    }
    return _json({"apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": job.name}, "spec": spec})


def _json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"
