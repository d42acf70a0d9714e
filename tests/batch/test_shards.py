"""Every capture belongs to exactly one shard, under every scheduler."""

import re
import subprocess
from pathlib import Path

import pytest
import yaml

from polcap.batch import shards
from polcap.errors import SettingError


def test_shards_cover_everything_once() -> None:
    items = list(range(23))
    parts = [shards.parse(f"{k}/5").of(items) for k in range(1, 6)]
    assert sorted(item for part in parts for item in part) == items
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@pytest.mark.parametrize("text", ["0/4", "5/4", "1/0", "2", "a/b", "-1/3", "1/2/3"])
def test_wrong_shard_is_refused(text: str) -> None:
    with pytest.raises(SettingError, match="give K/N"):
        shards.parse(text)


@pytest.mark.parametrize(
    "environment",
    [
        # Slurm: array=10-40:10
        {
            "SLURM_ARRAY_TASK_ID": "30", "SLURM_ARRAY_TASK_MIN": "10",
            "SLURM_ARRAY_TASK_STEP": "10", "SLURM_ARRAY_TASK_COUNT": "4",
        },
        {"AWS_BATCH_JOB_ARRAY_INDEX": "2", "AWS_BATCH_JOB_ARRAY_SIZE": "4"},
        {"JOB_COMPLETION_INDEX": "2", "POLCAP_SHARDS": "4"},
        {"PBS_ARRAY_INDEX": "3", "POLCAP_SHARDS": "4"},
    ],
)  # fmt: skip
def test_every_scheduler_environment_gives_shard_three_of_four(environment: dict[str, str]) -> None:
    assert str(shards.from_environment(environment)) == "3/4"


def test_no_scheduler_means_the_whole_batch() -> None:
    assert shards.from_environment({"SLURM_JOB_ID": "7"}) == shards.WHOLE


@pytest.mark.parametrize(
    "environment",
    [{"JOB_COMPLETION_INDEX": "2"}, {"PBS_ARRAY_INDEX": "0", "POLCAP_SHARDS": "4"}, {"PBS_ARRAY_INDEX": "x"}],
)
def test_index_without_count_or_beyond_it_is_refused(environment: dict[str, str]) -> None:
    with pytest.raises(SettingError):
        shards.from_environment(environment)


PAGE = Path(__file__).parents[2].joinpath("docs/how-to/array-jobs.md").read_text(encoding="utf-8")


def snippet(language: str) -> str:
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE, flags=re.DOTALL)
    return found


def kubernetes_command() -> str:
    (container,) = yaml.safe_load(snippet("yaml"))["spec"]["template"]["spec"]["containers"]
    return container["command"][-1]


@pytest.mark.parametrize("script", [snippet("sh"), kubernetes_command()], ids=["slurm", "kubernetes"])
def test_snippets_of_array_jobs_fail_as_polcap_fails_except_by_a_gate(script: str, tmp_path: Path) -> None:
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    stub = tmp_path / "polcap"
    for code, expected in ((0, 0), (2, 1), (3, 0)):
        stub.write_text(f"#!/bin/sh\necho $@\nexit {code}\n")
        stub.chmod(0o755)
        path = {"PATH": f"{tmp_path}:/usr/bin:/bin"}
        done = subprocess.run(["bash"], input=script, text=True, capture_output=True, env=path)
        assert (done.returncode, done.stdout) == (expected, "batch /shows/shoot --threads 2\n")


def test_the_kubernetes_snippet_states_each_task_its_shard() -> None:
    job = yaml.safe_load(snippet("yaml"))["spec"]
    pod = job["template"]["spec"]
    environment = {one["name"]: one["value"] for one in pod["containers"][0]["env"]}
    assert job["completionMode"] == "Indexed" and job["completions"] == job["parallelism"]
    last = str(job["completions"] - 1)
    assert str(shards.from_environment({"JOB_COMPLETION_INDEX": last, **environment})) == "16/16"
    mounted = {mount["name"]: mount["mountPath"] for mount in pod["containers"][0]["volumeMounts"]}
    assert [volume["name"] for volume in pod["volumes"]] == list(mounted)
    assert mounted["captures"] in kubernetes_command()
