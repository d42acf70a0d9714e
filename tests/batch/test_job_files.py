"""Job files follow the rules of each scheduler; its own validator runs where it is installed."""

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from polcap.batch import job_files
from polcap.batch.job_files import BatchJob

ROOT = Path("/shows/An object's {raw}")


@pytest.fixture
def job() -> BatchJob:
    return BatchJob(job_files.batch_command(ROOT, {"assignments": ["hdr.clip=0.9"], "keep_going": True}), ROOT, 12)


def test_submit_commands_quote_any_folder_name() -> None:
    file = ROOT / "slurm.sh"
    assert shlex.split(job_files.submit_hint("slurm", file)) == ["sbatch", str(file)]
    assert repr(str(file)) in job_files.submit_hint("opencue", file)


def written(kind: job_files.Scheduler, job: BatchJob, folder: Path) -> str:
    return job_files.write(kind, job, folder).read_text()


def test_options_reach_the_command(job: BatchJob) -> None:
    assert job.command == ("polcap", "batch", str(ROOT), "--set", "hdr.clip=0.9")


def test_an_option_of_zero_reaches_the_command() -> None:
    words = job_files.batch_command(ROOT, {"retries": 0, "threads": 0, "keep_going": False, "no_chart": True})
    assert words[3:] == ("--retries", "0", "--fail-fast", "--no-chart")


def test_slurm_script_is_shell(job: BatchJob, tmp_path: Path) -> None:
    text = written("slurm", job, tmp_path)
    assert "#SBATCH --array=1-12" in text and "--shard" not in text  # the array's variables say it
    subprocess.run(["sh", "-n"], input=text, text=True, check=True)


def test_openjd_template_is_valid(job: BatchJob, tmp_path: Path) -> None:
    template = json.loads(written("openjd", job, tmp_path))
    model = pytest.importorskip("openjd.model")
    assert model.decode_job_template(template=template).name == job.name


def test_opencue_specification_is_well_formed(job: BatchJob, tmp_path: Path) -> None:
    spec = ElementTree.fromstring(written("opencue", job, tmp_path))
    assert spec.findtext("job/layers/layer/range") == "1-12"
    assert "--shard #IFRAME#/12" in (spec.findtext("job/layers/layer/cmd") or "").replace("'\"'\"'", "'")


def test_kubernetes_job_is_valid(job: BatchJob, tmp_path: Path) -> None:
    document = json.loads(written("kubernetes", job, tmp_path))
    assert document["spec"]["completions"] == 12 and document["spec"]["completionMode"] == "Indexed"
    validate = pytest.importorskip("kubernetes_validate")
    validate.validate(document, validate.latest_version(), strict=True)


def test_snakefile_quotes_the_name_of_the_root(tmp_path: Path) -> None:
    root = Path("/shows/me@/raw")
    text = written("snakemake", BatchJob(job_files.batch_command(root, {}), root, 12), tmp_path)
    assert f"polcap batch {root} --shard {{wildcards.k}}/12" in text


def test_snakefile_plans_every_shard(job: BatchJob, tmp_path: Path) -> None:
    written("snakemake", job, tmp_path)
    tool = shutil.which("snakemake", path=str(Path(sys.executable).parent)) or shutil.which("snakemake")
    if tool is None:
        pytest.skip("snakemake is not installed")
    file = str(tmp_path / "Snakefile")
    done = subprocess.run([tool, "-s", file, "--dry-run", "--cores", "1"], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "shard" in done.stdout and "12" in done.stdout
