"""The package's metadata: one list of dependencies, one version."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CONDA_NAMES = {"py-opencv": "opencv-contrib-python-headless", "py-openimageio": "openimageio"}


def test_conda_recipe_has_the_dependencies_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    package = {
        name.lower(): version
        for name, version in re.findall(r"([\w.-]+)>=([\d.]+)", "\n".join(project["dependencies"]))
    }
    recipe = (
        (ROOT / ".ci/conda/recipe.yaml").read_text(encoding="utf-8").partition("  run:\n")[2].partition("tests:")[0]
    )
    conda = {CONDA_NAMES.get(name, name): version for name, version in re.findall(r"- ([\w-]+) >=([\d.]+)", recipe)}
    assert conda.pop("python") == project["requires-python"].removeprefix(">=")
    assert conda == package


def test_version_is_written_once():
    import polcap

    for name in ("pyproject.toml", ".ci/conda/recipe.yaml"):
        assert f'"{polcap.__version__}"' not in (ROOT / name).read_text(encoding="utf-8"), name


def test_the_citation_names_version_and_date() -> None:
    import polcap

    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {polcap.__version__}\n" in citation
    assert re.search(r'^date-released: "\d{4}-\d\d-\d\d"$', citation, re.MULTILINE)


@pytest.mark.parametrize(
    ("module", "words"),
    [
        ('__version__ = "4.10.0"', "the module cv2 is OpenCV 4.10.0; polcap needs OpenCV 5"),
        ('raise ImportError("libGL.so.1: cannot open")', "cannot be imported (libGL.so.1: cannot open)"),
    ],
)
def test_another_opencv_is_one_clear_line(tmp_path: Path, module: str, words: str) -> None:
    (tmp_path / "cv2.py").write_text(module)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    command = [sys.executable, "-m", "polcap", "process", str(ROOT / "examples/capture"), "--dry-run"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and words in done.stderr and "pip uninstall" in done.stderr
