"""The package's metadata: one list of dependencies, one version."""

import re
import tomllib
from pathlib import Path

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

    for name in ("pyproject.toml", "CITATION.cff", ".ci/conda/recipe.yaml"):
        assert f'"{polcap.__version__}"' not in (ROOT / name).read_text(encoding="utf-8"), name
