"""A changed file of a result ends in one line or is made again; no command ends with a bug."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from polcap.pipeline import manifest
from tests.campaigns.changed_results import complete, tried
from tests.conftest import TINY, Command, made_once


@pytest.fixture(scope="module")
def template(tiny: Path, tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Path:
    """The tiny capture C with its finished result C/polcap, of a batch; read only."""
    return made_once(tmp_path_factory, worker_id, "batch", lambda folder: complete(Path(shutil.copytree(tiny, folder))))


@pytest.fixture
def root(template: Path, tmp_path: Path) -> Path:
    """A copy of that batch, to be changed."""
    return Path(shutil.copytree(template, tmp_path / "batch"))


def change(file: Path, edit: Callable[[Any], Any], sealed: bool = False) -> None:
    about = edit(json.loads(file.read_text(encoding="utf-8")))
    if sealed:
        about["digest"] = manifest.seal(about)
    file.write_text(json.dumps(about), encoding="utf-8")


def test_a_stage_with_another_number_of_inputs_is_of_another_polcap(root: Path, polcap: Command) -> None:
    result = root / "C" / "polcap"
    manifest = result / "work" / "05-selfcal" / "manifest.json"
    change(manifest, lambda about: {**about, "inputs": [*about["inputs"], "0"]}, sealed=True)
    for words in (("report", result), ("show", result, "surface")):
        done = polcap(*words)
        assert done.returncode == 2 and done.stderr.count("\n") == 1 and "05-selfcal" in done.stderr


@pytest.mark.parametrize("content", ["[]", "7", '{"files": [], "stages": {}}', '{"stages": 3}', "[" * 9999])
def test_a_provenance_of_another_shape_counts_as_that_of_another_export(
    root: Path, polcap: Command, content: str
) -> None:
    asset = root / "C" / "polcap" / "asset"
    (asset / "C.provenance.json").write_text(content)
    assert polcap("export", asset.parent, "--obj").returncode == 0
    assert "C.glb" not in json.loads((asset / "C.provenance.json").read_text())["files"]
    (asset / "web").mkdir()
    (asset / "web" / "C.provenance.json").write_text(content)
    done = polcap("process", root / "C", *TINY)
    assert done.returncode in (0, 3) and "asset/web in" in done.stderr
    assert (asset / "web" / "C.provenance.json").read_text() == content


@pytest.mark.parametrize(
    ("name", "edit"),
    [
        ("maps/maps.json", lambda about: {**about, "exports": []}),
        ("maps/maps.json", lambda about: {**about, "exports": {"asset": {"glb": 3}}}),
        ("maps/maps.json", lambda about: {**about, "scale": 1e-300}),
        ("maps/maps.json", lambda about: []),
        ("report.json", lambda about: {**about, "versions": 3}),
        ("report.json", lambda about: {**about, "expected_error_deg": "small"}),
        ("report.json", lambda about: {**about, "keys": None}),
        ("report.json", lambda about: {**about, "figures": {"mesh": {"metric": 10**400}}}),
    ],
)
def test_a_record_of_another_shape_is_one_line(
    root: Path, polcap: Command, name: str, edit: Callable[[Any], Any]
) -> None:
    result = root / "C" / "polcap"
    change(result / name, edit)
    done = polcap("export", result)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and Path(name).name in done.stderr
    assert polcap("process", root / "C", *TINY).returncode in (0, 3) and polcap("export", result).returncode == 0


@pytest.mark.parametrize(
    "edit",
    [
        lambda about: {**about, "versions": None},
        lambda about: {**about, "capture": {**about["capture"], "shots": {}}},
        lambda about: {key: value for key, value in about.items() if key != "model"},
    ],
)
def test_a_run_of_another_polcap_is_one_line(root: Path, polcap: Command, edit: Callable[[Any], Any]) -> None:
    result = root / "C" / "polcap"
    change(result / "work" / "run.json", edit, sealed=True)
    for words in (("report", result), ("show", result, "mask")):
        done = polcap(*words)
        assert done.returncode == 2 and done.stderr.count("\n") == 1 and "run.json" in done.stderr


@pytest.mark.parametrize("number", range(4))
def test_no_command_ends_with_a_bug_after_a_random_change(template: Path, number: int) -> None:
    assert tried(template, number, seed=45)["faults"] == []
