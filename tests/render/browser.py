"""Pictures of exported meshes by three.js in a headless Chromium."""

import base64
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polcap.formats.export import gltf
from polcap.image_values import Floats, View
from polcap.mesh_values import ReliefMesh
from tests.render import devtools


@dataclass(frozen=True)
class Job:
    """One file seen through the camera of its photograph; a light is a direction to it, None is everywhere."""

    name: str
    file: Path
    mesh: ReliefMesh
    view: View
    lights: tuple[tuple[float, float, float] | None, ...]


def require() -> None:
    """Skip the test where Chromium or three.js is missing."""
    devtools.find()
    if not (devtools.MODULES / "three").is_dir():
        pytest.skip("needs `npm ci` in tests/gltf")


def render(folder: Path, jobs: list[Job]) -> dict[str, list[Floats]]:
    """Linear pictures (H, W, 3) of each job, on the grid of its maps; `folder` holds the files."""
    require()
    (folder / "jobs.json").write_text(json.dumps([_described(job, folder) for job in jobs]))
    shutil.copy(Path(__file__).parent / "page.html", folder / "page.html")
    with devtools.served(folder) as address, devtools.visited(f"{address}/page.html") as page:
        page.wait("window.answer !== undefined")
        answer = page.evaluate("answer")
    assert "error" not in answer, answer["error"]
    return {job.name: [_picture(text, job) for text in answer[job.name]] for job in jobs}


def _described(job: Job, folder: Path) -> dict[str, Any]:
    height, width = job.mesh.depth.shape
    camera = {
        "focal": job.view.focal,
        "center": job.view.center,
        "size": [width, height],
        "position": [float(-x) for x in gltf.center(job.mesh.vertices)],
    }
    file = "/" + job.file.relative_to(folder).as_posix()
    return {"name": job.name, "file": file, "camera": camera, "lights": job.lights}


def _picture(text: str, job: Job) -> Floats:
    height, width = job.mesh.depth.shape
    pixels = np.frombuffer(base64.b64decode(text), dtype=np.uint8).reshape(height, width, 4)
    return pixels[::-1, :, :3] / 255.0  # WebGL counts rows from below
