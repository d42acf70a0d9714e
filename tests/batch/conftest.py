"""Two small captures and a broken one, below one folder."""

import os
from pathlib import Path

import pytest

from polcap.synth import scenes
from polcap.synth import shooting as synthetic

OPTIONS = ("--estimator", "analytic", "--no-chart")


@pytest.fixture(scope="package")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """obj0, deeper/obj1 and broken; never written to: give --out."""
    root = tmp_path_factory.mktemp("captures")
    for seed, name in enumerate(("obj0", "deeper/obj1")):
        shoot = synthetic.Shoot(seed=seed, width=96, height=96, samples=1, exposures=1)
        synthetic.write(root / name, scenes.random_scene(seed, "bumps"), shoot)
    for angle in ("pol000", "pol045", "pol090"):
        (root / "broken" / angle).mkdir(parents=True)
        whole = next((root / "obj0" / angle).iterdir())
        (root / "broken" / angle / whole.name).write_bytes(whole.read_bytes()[:2000])
    for file in root.rglob("*.*"):  # as photographs that were taken a while ago
        os.utime(file, (1e9, 1e9))
    return root
